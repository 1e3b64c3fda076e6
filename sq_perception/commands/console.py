"""What all commands have in common: exit codes, complaints of one line, help texts, and checks of what was given."""

from __future__ import annotations

import argparse
import logging
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from sq_perception.files import output_file

if TYPE_CHECKING:
    from rich.progress import Progress

    from sq_perception.recordings.cloud_frame import CloudFrame

SUCCESS, FAILURE, USAGE, INTERRUPTED = 0, 1, 2, 130
STANDARD_OUTPUT = "-"
_NEGATIVE = re.compile(r"-(\d+\.?\d*|\.\d+)(e[-+]?\d+)?(,[-+.\de]*)*|-inf(inity)?", re.IGNORECASE)


def complain(message: str) -> None:
    """One line on the standard error; text of a recording must not steer the terminal."""
    print(f"sq-perception: {printable(' '.join(message.split()))}", file=sys.stderr)


class _Complaints(logging.Handler):
    """What the package logs, as complaints."""

    def emit(self, record: logging.LogRecord) -> None:
        complain(record.getMessage())


def show_log() -> None:
    """Print the package's warnings from now on."""
    log = logging.getLogger("sq_perception")
    if not log.handlers:
        log.addHandler(_Complaints())


def printable(text: str) -> str:
    """A text with question marks for what cannot be shown, such as bytes of a file's name that are no UTF-8."""
    return "".join(c if c.isprintable() else "?" for c in text)


def fail(message: str) -> int:
    """Complain of something that could not be done; returns its exit code."""
    complain(message)
    return FAILURE


def reject_usage(message: str) -> int:
    """Complain of wrong usage; returns its exit code."""
    complain(message)
    return USAGE


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without twenty lines of usage before it."""

    def error(self, message: str) -> NoReturn:
        self.exit(USAGE, f"{self.prog}: {message}; {self.prog} --help shows all options\n")


def parser(command: str, description: str, epilog: str | None = None) -> argparse.ArgumentParser:
    """The parser of one command, whose texts keep their lines."""
    return Parser(
        prog=f"sq-perception {command}",
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def with_negatives(arguments: Sequence[str]) -> list[str]:
    """Arguments of a command that takes negative numbers, such that argparse takes none of them for an option.

    It does so with -1e-3, -1., -1,2,3 and -inf.  Each gets a blank in front, which ``float`` ignores.
    """
    return [f" {argument}" if _NEGATIVE.fullmatch(argument) else argument for argument in arguments]


def at_least(least: int, most: int | None = None) -> Callable[[str], int]:
    """The type of an argument that is a whole number from ``least`` to ``most``, or to no end."""

    def checked(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"expected a whole number, got {text!r}") from None
        if value < least:
            raise argparse.ArgumentTypeError(f"expected at least {least}, got {value}")
        if most is not None and value > most:
            raise argparse.ArgumentTypeError(f"expected {least} to {most}, got {value}")
        return value

    return checked


def number(wanted: str, holds: Callable[[float], bool]) -> Callable[[str], float]:
    """The type of an argument that is a number for which ``holds`` is true; ``wanted`` names it in complaints."""

    def checked(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not holds(value):
            raise argparse.ArgumentTypeError(f"expected {wanted}, got {text}")
        return value

    return checked


positive = number("a positive number", lambda value: 0 < value < math.inf)


def target(text: str) -> Path:
    """The type of an argument that names a file to be written, which is tried."""
    if not Path(text).resolve().parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text}: its folder does not exist")
    try:
        output_file.check(text)
    except OSError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return Path(text)


def text_target(text: str) -> str:
    """The type of an argument that names a file to be written, or is - for the standard output."""
    if text == STANDARD_OUTPUT and sys.stdout is None:
        raise argparse.ArgumentTypeError("the standard output is closed")
    return text if text == STANDARD_OUTPUT else str(target(text))


def folder(text: str) -> Path:
    """The type of an argument that names a folder for results, which is made if need be, and tried."""
    try:
        output_file.check_folder(text)
    except OSError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return Path(text)


def replaced_input(
    inputs: Sequence[Path],
    files: Mapping[str, str | Path | None],
    folders: Mapping[str, tuple[Path | None, str]] | None = None,
) -> str:
    """A complaint if an output would replace an input; empty if none would.

    Parameters
    ----------
    files
        The files that are written, by the option that names each; None if it was not given.
    folders
        The folders that are written to, likewise, each with the suffix of the files there.
    """
    for name, file in files.items():
        path = None if file is None or str(file) == STANDARD_OUTPUT else Path(file)
        if path and path.exists() and any(given.exists() and path.samefile(given) for given in inputs):
            return f"--{name}: {path}: this is an input"
    for name, (folder, suffix) in (folders or {}).items():
        if folder and any(given.suffix.lower() == suffix and given.parent.samefile(folder) for given in inputs):
            return f"--{name}: {folder}: the {suffix} files in this folder are inputs; choose another one"
    return ""


def add_frames(command: argparse.ArgumentParser) -> None:
    """Add the arguments that tell which recorded frames are read, and how bodies are recovered from them."""
    add = command.add_argument
    add("frames", nargs="+", metavar="FRAME", help="recorded depth images, folders or bags of them")
    add("--projection", choices=("pinhole", "orthographic"), default="pinhole")
    add(
        "--camera-info",
        metavar="FILE",
        help="intrinsics of images and bags, before their own: a file of K, or fx,fy,cx,cy",
    )
    add("--topic", metavar="NAME", help="depth images of a bag, where it has several such topics")
    add("--camera-info-topic", metavar="NAME", help="their camera_info, where it is not beside them")
    add_depth(command)
    add("--every", type=at_least(1), default=1, metavar="N", help="only every Nth frame of a bag or folder")
    methods = ("auto", "network", "symmetry", "classic")
    add("--method", choices=methods, default="auto", help="how bodies are found: the methods of recover --help")
    add_ignore_masks(command)


def add_depth(command: argparse.ArgumentParser) -> None:
    """Add the options that tell what the numbers of depth images mean."""
    command.add_argument(
        "--depth-scale",
        type=positive,
        metavar="N",
        help="units a metre (as a camera file states, else 1000 of whole numbers, 1 of floats)",
    )
    command.add_argument(
        "--depth-kind",
        choices=("z", "range"),
        default="z",
        help="range: images hold the distance to the camera's centre (Isaac's distance_to_camera), not z",
    )
    command.add_argument(
        "--frame",
        type=_cloud_frame,
        metavar="POSE",
        help="for clouds in another frame, where the camera is in it: X,Y,Z (it looks at the middle), "
        "X,Y,Z,QX,QY,QZ,QW, or link (x forward, z up) or graphics (y up, z backward)",
    )


def _cloud_frame(text: str) -> CloudFrame:
    from sq_perception.recordings.cloud_frame import CloudFrame

    try:
        return CloudFrame.parse(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def add_ignore_masks(command: argparse.ArgumentParser) -> None:
    """Add the option that leaves the labels of frames unread."""
    command.add_argument("--ignore-masks", action="store_true", help="segment, even where a frame brings labels")


def progress() -> Progress:
    """A bar on the standard error, where that is a terminal; to be used as a context manager."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    is_hidden = not sys.stderr.isatty()
    # Quiet as well: rich before 14.3 ends a bar that is disabled with an empty line.
    return Progress(*columns, console=Console(stderr=True, quiet=is_hidden), transient=True, disable=is_hidden)
