"""``sq-perception dataset``: make a fixed set of images on disk, go on with one, or verify one."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from sq_perception.commands.console import FAILURE, SUCCESS, failed, parser
from sq_perception.learning.fixed_set_settings import Settings

_HELP = "Make a fixed set of images on disk, go on with an interrupted one, or verify one."
_EPILOG = """\
170 000 full frames take 0.5 GB, as many views of 64 pixels 0.35 GB.

examples:
  sq-perception dataset sets/thesis --full-frame
  sq-perception dataset sets/views --pixels 64 --train 50000 --test 2000
  sq-perception dataset sets/thesis --verify
"""
_FULL_PIXELS, _FULL_BITS = 256, 8
"""Of the thesis' images."""


def main(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception dataset``; the exit code."""
    command = _parser()
    given = command.parse_args(arguments)
    full = given.full_frame
    try:
        settings = Settings(
            "full" if full else "cropped",
            given.pixels if given.pixels is not None else _FULL_PIXELS if full else Settings.pixels,
            given.bits if given.bits is not None else _FULL_BITS if full else Settings.bits,
            given.train,
            given.test,
            given.shard,
            given.seed,
            given.pinhole_share,
        )
    except ValueError as error:
        command.error(f"--{str(error).replace('_', '-')}")

    from sq_perception.learning.fixed_set import FixedSetError
    from sq_perception.learning.fixed_set_writer import most_threads

    if not 0 <= given.threads <= most_threads():
        command.error(f"--threads: expected 0 to {most_threads()}, got {given.threads}")
    try:
        return _run(given, settings)
    except FixedSetError as error:
        return failed(f"dataset: {error}")
    except OSError as error:
        return failed(f"dataset: {given.folder}: {error}")


def _parser() -> argparse.ArgumentParser:
    command = parser("dataset", _HELP, _EPILOG)
    command.add_argument("folder", type=Path, help="of the set")
    command.add_argument("--full-frame", action="store_true", help="images of the whole cube instead of cropped views")
    command.add_argument("--pixels", type=int, help=f"side of the images ({Settings.pixels}; {_FULL_PIXELS} if full)")
    command.add_argument(
        "--bits", type=int, choices=(8, 16), help=f"of a pixel ({Settings.bits}; {_FULL_BITS} for full frames)"
    )
    command.add_argument("--train", type=int, default=Settings.train, help=f"bodies to train on ({Settings.train})")
    command.add_argument("--test", type=int, default=Settings.test, help=f"bodies to test on ({Settings.test})")
    command.add_argument("--shard", type=int, default=Settings.shard, help=f"bodies a file ({Settings.shard})")
    command.add_argument("--seed", type=int, default=Settings.seed, help=f"default {Settings.seed}")
    command.add_argument("--pinhole-share", type=float, default=0.0, help="share of views of a pinhole camera")
    command.add_argument("--threads", type=int, default=0, help="default: all that numba may use")
    command.add_argument("--verify", action="store_true", help="check all checksums and make nothing")
    return command


def _run(given: argparse.Namespace, settings: Settings) -> int:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from sq_perception.learning.fixed_set import read_manifest, verify
    from sq_perception.learning.fixed_set_writer import generate

    if given.verify:
        settings, _ = read_manifest(given.folder)
    total = settings.train + settings.test
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("verifying" if given.verify else "drawing", total=total)
        advance = partial(bar.advance, task)
        if given.verify:
            complaints = verify(given.folder, advance)
        else:
            complaints = []
            generate(given.folder, settings, given.threads, advance)
    for complaint in complaints:
        failed(f"dataset: {complaint}")
    if complaints:
        return FAILURE
    size = sum(path.stat().st_size for path in given.folder.glob("*.safetensors"))
    print(f"{given.folder}: {settings.train} + {settings.test} images, {size / 1e6:.1f} MB, all checksums right")
    return SUCCESS
