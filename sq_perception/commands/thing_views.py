"""``sq-perception thing-views``: views of simulated household things, to train the network of things on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sq_perception.commands.console import SUCCESS, at_least, failed, parser

_HELP = """\
Draw canonical views of simulated household things into a folder, shard by shard.

Shard k follows from the seed and k alone; those that are there already stay.  Several processes may fill one folder
with other --first; a training reads what it finds.
"""
_EPILOG = "example:\n  sq-perception thing-views sets/things --shards 200 && sq-perception train-things sets/things"


def main(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception thing-views``; the exit code."""
    command = parser("thing-views", _HELP, _EPILOG)
    add = command.add_argument
    add("folder", type=Path, help="of the shards")
    add("--shards", type=at_least(1), default=100, help="how many there shall be (100)")
    add("--first", type=at_least(0), default=0, help="number of the first one (0)")
    add("--views", type=at_least(1), default=512, help="views a shard (512)")
    add("--seed", type=at_least(0), default=0, help="default 0")
    add("--meshes", type=Path, metavar="FOLDER", help="things of your own, in metres, for half of the views")
    given = command.parse_args(arguments)

    from sq_perception.learning.thing_training import write_views
    from sq_perception.simulation.scanned_things import read_things

    shards = range(given.first, given.first + given.shards)
    try:
        own = read_things(given.meshes) if given.meshes is not None else ()
        write_views(given.folder, shards, given.views, given.seed, print, own)
    except ValueError as error:
        return failed(f"thing-views: {error}")
    except OSError as error:
        return failed(f"thing-views: {given.folder}: {error}")
    return SUCCESS
