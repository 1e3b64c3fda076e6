"""What all commands have in common: exit codes, complaints of one line, and how their help is laid out."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress

SUCCESS, FAILURE, USAGE, INTERRUPTED = 0, 1, 2, 130


def complain(message: str) -> None:
    """One line on the standard error; what a recording says of itself must not steer the terminal."""
    line = "".join(c if c.isprintable() else "?" for c in " ".join(message.split()))
    print(f"sq-perception: {line}", file=sys.stderr)


def failed(message: str) -> int:
    """The exit code of something that could not be done, with the reason."""
    complain(message)
    return FAILURE


def misused(message: str) -> int:
    """The exit code of wrong usage, with the reason."""
    complain(message)
    return USAGE


def parser(command: str, description: str, epilog: str | None = None) -> argparse.ArgumentParser:
    """The parser of one command, whose texts keep their lines."""
    return argparse.ArgumentParser(
        prog=f"sq-perception {command}",
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def progress() -> Progress:
    """A bar on the standard error, where that is a terminal; to be used as a context manager."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty())
