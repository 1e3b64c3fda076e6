"""The command ``sq-perception``; ``sq-perception --help`` lists its commands.

Every command is a function of a module, ``(arguments) -> exit code``.  It is imported when it is called, and imports
numeric modules only after parsing its arguments, so that every ``--help`` answers at once.

Exit codes: 0 success, 1 something could not be read, written or found, 2 wrong usage, 130 interrupted.
"""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Sequence
from pkgutil import resolve_name

from sq_perception.commands.console import FAILURE, INTERRUPTED, SUCCESS, USAGE, Parser, complain, show_log
from sq_perception.files import __version__
from sq_perception.learning.choices import NEEDS_TORCH

COMMANDS = {
    "sample": ("rendering:sample", "write a simulated depth image to begin with"),
    "recover": ("recover:recover", "depth images in, superquadrics out"),
    "fit": ("fit:main", "clouds or meshes of single objects in, superquadrics out"),
    "grasp": ("recover:grasp", "depth images in, grasps of a parallel gripper out"),
    "render": ("rendering:render", "draw a superquadric as a depth image"),
    "demo": ("demo:main", "a simulated camera and real ROS 2 nodes (extra 'ros')"),
    "train": ("training:train", "train a network"),
    "thing-views": ("training:thing_views", "draw views of household things to train on"),
    "train-things": ("training:train_things", "train the network that predicts the unseen side of things"),
    "segment-views": ("training:segment_views", "draw segments of simulated scenes to train on"),
    "train-masks": ("training:train_masks", "train the network that finds outliers in segments"),
    "evaluate": ("training:evaluate", "the thesis' tables and plots, for networks and fits"),
    "doctor": ("installation:doctor", "versions, extras, kernels, cores, and what is missing"),
    "warm-up": ("installation:warm_up", "compile all kernels in advance"),
}
"""Name, module of this folder and its function, and summary."""

_EPILOG = """\
examples:
  sq-perception sample table.npz
  sq-perception recover table.npz --json out.json --pictures pictures/
  sq-perception render 0.25 0.15 0.1  0.2 0.8  0.5 0.5 0.5  0 0 0 1 --output view.png
  sq-perception demo
  sq-perception train --help
  sq-perception evaluate --help
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # before it is imported: what a file lacks is said here
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # the name of a file need not be UTF-8, nor the terminal
    code = _run(list(sys.argv[1:] if arguments is None else arguments))
    try:
        # Here and not at the interpreter's end, which prints a failure as an exception and has an exit code of its own.
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            complain(f"the standard output: {error.strerror}")
        return code or FAILURE
    return code


def _run(given: list[str]) -> int:
    try:
        if not given or given[0] not in COMMANDS:
            _parser().parse_args(given)
        if given[0] != "warm-up":  # which says how far it is
            show_log()
        return resolve_name(f"sq_perception.commands.{COMMANDS[given[0]][0]}")(given[1:])
    except SystemExit as stop:  # argparse: help was shown, or the usage was wrong
        if isinstance(stop.code, int):
            return stop.code
        return SUCCESS if stop.code is None else USAGE
    except KeyboardInterrupt:
        return complain("interrupted", INTERRUPTED)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != "torch":
            raise
        return complain(f"{given[0]} {NEEDS_TORCH}")
    except BrokenPipeError:
        return FAILURE
    except OSError as error:
        return complain(f"{given[0]}: {error}")


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="sq-perception",
        description="Superquadrics from depth images: size, shape, pose and uncertainty of the objects in them.",
        epilog=_EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"sq-perception {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, (_, summary) in COMMANDS.items():
        commands.add_parser(name, help=summary, add_help=False)
    return parser
