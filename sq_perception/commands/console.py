"""Common parts of all commands: exit codes, one-line complaints, help texts, and checks of arguments."""

from __future__ import annotations

import argparse
import logging
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from sq_perception.files import output_file

if TYPE_CHECKING:
    from rich.progress import Progress

    from sq_perception.recordings.cloud_file import CloudFrame

_Value = TypeVar("_Value")
SUCCESS, FAILURE, USAGE, INTERRUPTED = 0, 1, 2, 130
STANDARD_OUTPUT = "-"
_NEGATIVE = re.compile(r"-(\d+\.?\d*|\.\d+)(e[-+]?\d+)?(,[-+.\de]*)*|-inf(inity)?", re.IGNORECASE)


def complain(message: str, code: int = FAILURE) -> int:
    """Print one line to standard error, without control characters from recordings; return the exit code."""
    print(f"sq-perception: {replace_unprintable(' '.join(message.split()))}", file=sys.stderr)
    return code


class _Complaints(logging.Handler):
    """Log handler that prints what the package logs as complaints."""

    def emit(self, record: logging.LogRecord) -> None:
        complain(record.getMessage())


def show_log() -> None:
    """Print the package's warnings from now on."""
    log = logging.getLogger("sq_perception")
    if not log.handlers:
        log.addHandler(_Complaints())


def replace_unprintable(text: str) -> str:
    """Replace characters that cannot be printed, such as file name bytes that are no UTF-8, by question marks."""
    return "".join(c if c.isprintable() else "?" for c in text)


class Parser(argparse.ArgumentParser):
    """Parser that reports an error in one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(USAGE, f"{self.prog}: {message}; {self.prog} --help shows all options\n")


def parser(command: str, description: str, epilog: str | None = None) -> argparse.ArgumentParser:
    """Make the parser of one command, whose texts keep their lines."""
    return Parser(
        prog=f"sq-perception {command}", description=description, epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def mark_negatives(arguments: Sequence[str]) -> list[str]:
    """Prepare arguments with negative numbers, so that argparse takes none of them for an option.  It does so with
    -1e-3, -1., -1,2,3 and -inf.  Each gets a blank in front, which ``float`` ignores."""
    return [f" {argument}" if _NEGATIVE.fullmatch(argument) else argument for argument in arguments]


def argument(convert: Callable[[str], _Value]) -> Callable[[str], _Value]:
    """Return the argument type of a conversion whose ValueError or OSError says what is wrong."""

    def check(text: str) -> _Value:
        try:
            return convert(text)
        except (ValueError, OSError) as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return check


def number(
    wanted: str, holds: Callable[[Any], bool], kind: Callable[[str], Any] = float
) -> Callable[[str], Any]:
    """Return the argument type of a number for which ``holds`` is true; ``wanted`` names it in complaints."""

    def check(text: str) -> Any:
        with suppress(ValueError):
            if holds(value := kind(text)):
                return value
        raise argparse.ArgumentTypeError(f"expected {wanted}, got {text}")

    return check


def at_least(least: int, most: float = math.inf) -> Callable[[str], int]:
    """Return the argument type of a whole number from ``least`` to ``most``."""
    wanted = f"a whole number of at least {least}" if most == math.inf else f"a whole number from {least} to {most}"
    return number(wanted, lambda value: least <= value <= most, int)


positive = number("a positive number", lambda value: 0 < value < math.inf)


@argument
def target(text: str) -> Path:
    """Check an output file name, which is tried; an argument type."""
    if not Path(text).resolve().parent.is_dir():
        raise ValueError(f"{text}: its folder does not exist")
    output_file.check(text)
    return Path(text)


@argument
def text_target(text: str) -> str:
    """Check an output file name, or - for standard output; an argument type."""
    if text not in (STANDARD_OUTPUT, "/dev/stdout"):
        return str(target(text))
    if sys.stdout is None:
        raise ValueError("the standard output is closed")
    return STANDARD_OUTPUT


@argument
def folder(text: str) -> Path:
    """Make and check a folder for results; an argument type."""
    output_file.check_folder(text)
    return Path(text)


def write_document(option: str, path: str, text: str, is_whole: bool = True) -> str:
    """Write a document to a file or, for -, to the standard output; return where else it is, if it is unfinished."""
    if path == STANDARD_OUTPUT:
        sys.stdout.write(text)
        return ""
    # Names of files need not be UTF-8.
    written = output_file.write(path, text.encode(errors="backslashreplace"), is_whole)
    return "" if written == Path(path) else f"--{option}: unfinished, so {path} stays as it is: see {written}"


def replaced_input(
    inputs: Sequence[Path], files: Mapping[str, str | Path | None],
    folders: Mapping[str, tuple[Path | None, str]] | None = None,
) -> str:
    """Complain if an output would replace an input; empty if none would.  ``files`` and ``folders`` are by the option
    that names each; None if it was not given; of a folder with the suffix of what is written there."""
    for name, file in files.items():
        path = None if file is None or str(file) == STANDARD_OUTPUT else Path(file)
        if path and path.exists() and any(given.exists() and path.samefile(given) for given in inputs):
            return f"--{name}: {path}: this is an input"
    for name, (folder, suffix) in (folders or {}).items():
        if folder and any(given.suffix.lower() == suffix and given.parent.samefile(folder) for given in inputs):
            return f"--{name}: {folder}: the {suffix} files in this folder are inputs; choose another one"
    return ""


def add_depth(command: argparse.ArgumentParser) -> None:
    """Add the options for the meaning of depth values and masks."""
    command.add_argument(
        "--depth-scale", type=positive, metavar="N",
        help="units per metre (default: from a camera file, else 1000 for integers, 1 for floats)",
    )
    command.add_argument(
        "--depth-kind", choices=("z", "range"), default="z",
        help="range: images hold the distance to the camera's centre (Isaac's distance_to_camera), not z",
    )
    command.add_argument(
        "--frame", type=_cloud_frame, metavar="POSE",
        help="for clouds in another frame, where the camera is in it: X,Y,Z (it looks at the middle), "
        "X,Y,Z,QX,QY,QZ,QW, or link (x forward, z up) or graphics (y up, z backward)",
    )
    command.add_argument("--ignore-masks", action="store_true", help="segment frames even if they have labels")


@argument
def _cloud_frame(text: str) -> CloudFrame:
    from sq_perception.recordings.cloud_file import CloudFrame

    return CloudFrame.parse(text)


def progress() -> Progress:
    """Return a context manager for a progress bar on standard error, if that is a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    is_hidden = not sys.stderr.isatty()
    # Quiet as well: rich before 14.3 ends a bar that is disabled with an empty line.
    return Progress(*columns, console=Console(stderr=True, quiet=is_hidden), transient=True, disable=is_hidden)
