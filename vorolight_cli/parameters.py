"""Convert dataclasses of parameters to command-line options and back, so that nothing is declared
twice."""

from __future__ import annotations

import inspect
import tomllib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import typer

from vorolight.stages.engine.params import Option, StageParams, options
from vorolight.stages.engine.stage import Stage
from vorolight.stages.errors import UsageError

from . import completion

Function = Callable[..., Any]


def parameter_names(stages: Sequence[Stage]) -> dict[str, dict[str, str]]:
    """For each stage, the name of each of its options on a command line that runs ``stages``.

    An option that several of them have gets the name of its stage in front.
    """
    uses: dict[str, int] = {}
    for stage in stages:
        for option in options(stage.params):
            uses[option.name] = uses.get(option.name, 0) + 1
    return {
        stage.name: {
            option.name: option.name
            if uses[option.name] == 1
            else f"{stage.name.replace('-', '_')}_{option.name}"
            for option in options(stage.params)
        }
        for stage in stages
    }


def _annotation(option: Option, name: str, group: str) -> Any:
    if option.positional:
        meaning = f"{option.meaning} [{'|'.join(get_args(option.type))}]"
        return Annotated[str, typer.Argument(help=meaning, autocompletion=_completion(option))]
    flag = "--" + name.replace("_", "-")
    if option.type is bool:
        flags = [f"{flag}/--no-{flag[2:]}"]
    else:
        flags = [flag] + ([option.short] if option.short and name == option.name else [])
    meaning = option.meaning
    if get_origin(option.type) is not None:
        meaning += f" [{'|'.join(get_args(option.type))}]"
    elif option.limits is not None:
        meaning += f" ({option.limits})"
    if option.default not in (None, ""):
        shown = option.default
        if option.type is bool:
            shown = "yes" if shown else "no"
        meaning += f" [default: {shown:g}]" if option.type is float else f" [default: {shown}]"
    # Choices and limits are checked by the parameters, so that every caller gets the same sentence.
    plain = option.type if option.type in (int, float, bool) and option.length is None else str
    return Annotated[
        plain | None,
        typer.Option(
            *flags, help=meaning, show_default=False, rich_help_panel=f"Options of {group}",
            autocompletion=_completion(option),
        ),
    ]  # fmt: skip


def _completion(option: Option) -> completion.Completion | None:
    """Offers the choices of an option that has some."""
    if get_origin(option.type) is not Literal:
        return None
    return completion.choices(partial(get_args, option.type))


def add_options(
    function: Function, templates: Sequence[Function], stages: Sequence[Stage]
) -> Function:
    """``function(**given)`` with the parameters of ``templates`` and the options of ``stages``.

    A stage option that was not given arrives as None.
    """
    parameters: list[inspect.Parameter] = []
    hints: dict[str, Any] = {}
    for template in templates:
        hints |= inspect.get_annotations(template, eval_str=True)
        parameters += list(inspect.signature(template).parameters.values())
    names = parameter_names(stages)
    for stage in stages:
        for option in options(stage.params):
            name = names[stage.name][option.name]
            hints[name] = _annotation(option, name, stage.name)
            if option.positional:  # required, and before the INPUT
                parameters.insert(0, inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY))
            else:
                parameters.append(
                    inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None)
                )
    hints.pop("return", None)
    function.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [
            p.replace(annotation=hints[p.name], kind=inspect.Parameter.KEYWORD_ONLY)
            for p in parameters
        ]
    )
    function.__annotations__ = hints
    return function


def read_config(path: Path | None, stages: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Options by stage from a TOML file with one table per stage.

    Raises UsageError when it is not readable or names something unknown.
    """
    if path is None:
        return {}
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(f"{path}: cannot be read as TOML ({error}); correct it") from error
    for name, values in content.items():
        if name not in stages or not isinstance(values, dict):
            raise UsageError(
                f"{path}: [{name}] is not a stage; the stages are "
                f"{', '.join(f'[{s}]' for s in stages)}"
            )
    return content


def build(
    stage: Stage,
    given: dict[str, Any],
    config: dict[str, dict[str, Any]],
    names: dict[str, str],
    recorded: dict[str, Any] | None = None,
) -> StageParams:
    """A stage's parameters, in this order: command line, config file, recorded values, defaults.

    Raises UsageError for values that do not fit.
    """
    known = {option.name: option for option in options(stage.params)}
    values = {key: value for key, value in (recorded or {}).items() if key in known}
    for key, value in config.get(stage.name, {}).items():
        name = key.replace("-", "_")
        if name not in known:
            raise UsageError(
                f"[{stage.name}] {key}: no such option; vorolight {stage.name} -h lists the options"
            )
        values[name] = value
    for name in known:
        if given.get(names[name]) is not None:
            values[name] = given[names[name]]
    return stage.params(**values)
