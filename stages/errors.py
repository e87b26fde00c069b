"""The errors of the project, each with the exit code of the command line."""

from __future__ import annotations


class VorolightError(Exception):
    """One sentence for the user: what is wrong, in which file, what to do."""

    exit_code = 1


class UsageError(VorolightError):
    """An option or argument is out of range or does not fit the others."""

    exit_code = 2


class InputError(VorolightError):
    """The input file or field cannot be used."""

    exit_code = 3


class ArtifactError(VorolightError):
    """A file of the run folder is missing, corrupt or stale."""

    exit_code = 4


class GateFailure(VorolightError):
    """A quality gate failed."""

    exit_code = 5


class NumericalFailure(VorolightError):
    """The computation found no valid result, such as no certificate."""

    exit_code = 6


class BackendMissing(VorolightError):
    """An optional library that this request needs is not installed."""

    exit_code = 69


class Locked(VorolightError):
    """Another process is working on the run folder."""

    exit_code = 75


class Stopped(VorolightError):
    """Stopped at a checkpoint on SIGUSR1; the same command continues."""

    exit_code = 85
