"""``sq-perception segment-views``: segments of simulated tables, to train the network of masks on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sq_perception.commands.console import SUCCESS, at_least, failed, parser

_HELP = """\
Draw segments of simulated tables, and which of their readings are of their object, into a folder, shard by shard.

Shard k follows from the seed and k alone; those that are there already stay.  Several processes may fill one folder
with other --first; a training reads what it finds.
"""
_EPILOG = "example:\n  sq-perception segment-views sets/segments && sq-perception train-masks sets/segments"


def main(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception segment-views``; the exit code."""
    command = parser("segment-views", _HELP, _EPILOG)
    add = command.add_argument
    add("folder", type=Path, help="of the shards")
    add("--shards", type=at_least(1), default=40, help="how many there shall be (40)")
    add("--first", type=at_least(0), default=0, help="number of the first one (0)")
    add("--scenes", type=at_least(1), default=200, help="scenes a shard, of some four segments each (200)")
    add("--seed", type=at_least(0), default=0, help="default 0")
    given = command.parse_args(arguments)

    from sq_perception.learning.mask_training import write_views

    shards = range(given.first, given.first + given.shards)
    try:
        write_views(given.folder, shards, given.scenes, given.seed, print)
    except OSError as error:
        return failed(f"segment-views: {given.folder}: {error}")
    return SUCCESS
