"""The command line: parses, calls stages, prints, and ends with an exit code."""
