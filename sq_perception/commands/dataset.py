"""``sq-perception dataset``: make a fixed set of images on disk, or finish one."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from sq_perception.commands.console import SUCCESS, fail, parser, progress

_HELP = "Make a fixed set of images on disk.  The same command finishes a set and makes damaged parts again."
_EPILOG = """\
170 000 full frames take 0.5 GB, as many views of 64 pixels 0.35 GB.

examples:
  sq-perception dataset sets/thesis --full-frame
  sq-perception dataset sets/views --pixels 64 --train 50000 --test 2000
"""
_FULL_PIXELS, _PIXELS = 256, 64
"""Pixels a side of the thesis' images, and of the views of the shipped networks."""


def main(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception dataset``; the exit code."""
    command = parser("dataset", _HELP, _EPILOG)
    add = command.add_argument
    add("folder", type=Path, help="of the set")
    add("--full-frame", action="store_true", help="images of the whole cube instead of cropped views")
    add("--pixels", type=int, help=f"side of the images ({_PIXELS}; {_FULL_PIXELS} if full)")
    add("--train", type=int, default=150_000, help="bodies to train on (default %(default)s)")
    add("--test", type=int, default=20_000, help="bodies to test on (default %(default)s)")
    add("--seed", type=int, default=1, help="default %(default)s")
    given = command.parse_args(arguments)

    from sq_perception.learning.fixed_set import FixedSetError, Settings, generate

    framing, pixels = ("full", _FULL_PIXELS) if given.full_frame else ("cropped", _PIXELS)
    pixels = pixels if given.pixels is None else given.pixels
    try:
        settings = Settings(framing, pixels, given.train, given.test, given.seed)  # type: ignore[arg-type]
    except ValueError as error:
        command.error(f"--{error}")
    folder = given.folder
    try:
        with progress() as bar:
            task = bar.add_task("drawing", total=settings.train + settings.test)
            generate(folder, settings, partial(bar.advance, task))
    except FixedSetError as error:
        return fail(f"dataset: {error}")
    size = sum(path.stat().st_size for path in folder.glob("*.safetensors"))
    print(f"{folder}: {settings.train} + {settings.test} images, {size / 1e6:.1f} MB, all checksums right")
    return SUCCESS
