"""``sq-perception thing-views`` and ``segment-views``: draw views into a folder to train on, shard by shard."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from sq_perception.commands.console import SUCCESS, at_least, failed, parser

_HELP = """\
Draw {what} into a folder, shard by shard.

Shard k follows from the seed and k alone; those that are there already stay.  Several processes may fill one folder
with other --first; a training reads what it finds.
"""


def things(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception thing-views``; the exit code."""
    example = "sq-perception thing-views sets/things --shards 200 && sq-perception train-things sets/things"
    command = _parser("thing-views", "canonical views of simulated household things", example, shards=100)
    command.add_argument("--views", type=at_least(1), default=512, help="views a shard (512)")
    command.add_argument(
        "--meshes", type=Path, metavar="FOLDER", help="your own things, in metres, for half of the views"
    )
    given = command.parse_args(arguments)

    from sq_perception.learning.shard_training import write_views
    from sq_perception.simulation.scanned_things import read_things
    from sq_perception.simulation.thing_views import draw_thing_views

    try:
        own = read_things(given.meshes) if given.meshes is not None else ()
        write_views(given.folder, _shards(given), lambda rng: draw_thing_views(given.views, rng, own=own), given.seed)
    except ValueError as error:
        return failed(f"thing-views: {error}")
    except OSError as error:
        return failed(f"thing-views: {given.folder}: {error}")
    return SUCCESS


def segments(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception segment-views``; the exit code."""
    example = "sq-perception segment-views sets/segments && sq-perception train-masks sets/segments"
    what = "segments of simulated tables, and which of their readings are of their object,"
    command = _parser("segment-views", what, example, shards=40)
    command.add_argument("--scenes", type=at_least(1), default=200, help="a shard, of some four segments each (200)")
    command.add_argument("--pieces", action="store_true", help="and compact pieces of segments")
    given = command.parse_args(arguments)

    from sq_perception.learning.shard_training import write_views
    from sq_perception.simulation.segment_views import draw_segment_views

    try:
        drawn = partial(draw_segment_views, given.scenes, with_pieces=given.pieces)
        write_views(given.folder, _shards(given), drawn, given.seed)
    except OSError as error:
        return failed(f"segment-views: {given.folder}: {error}")
    return SUCCESS


def _parser(name: str, what: str, example: str, shards: int) -> argparse.ArgumentParser:
    """What both commands take."""
    command = parser(name, _HELP.format(what=what), f"example:\n  {example}")
    add = command.add_argument
    add("folder", type=Path, help="of the shards")
    add("--shards", type=at_least(1), default=shards, help="how many there shall be (%(default)s)")
    add("--first", type=at_least(0), default=0, help="number of the first one (0)")
    add("--seed", type=at_least(0), default=0, help="default 0")
    return command


def _shards(given: argparse.Namespace) -> range:
    return range(given.first, given.first + given.shards)
