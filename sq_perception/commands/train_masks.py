"""``sq-perception train-masks``: train the network that finds strays in segments."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sq_perception.commands.console import SUCCESS, at_least, failed, parser, positive

_HELP = """\
Train the network that finds strays in segments, on those that `segment-views` wrote (or still writes).

The same command goes on with a run that was stopped.  The output folder holds the state, a log, and the newest network,
masks.safetensors.
"""
_EPILOG = "example:\n  sq-perception train-masks sets/segments --output runs/masks --minutes 60"


def main(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception train-masks``; the exit code."""
    command = parser("train-masks", _HELP, _EPILOG)
    add = command.add_argument
    add("views", type=Path, metavar="FOLDER", help="of the shards of segments")
    add("--output", "-o", type=Path, default=Path("runs/masks"), help="folder (runs/masks)")
    add("--minutes", type=positive, default=60.0, help="training time, over which the rate falls (60)")
    add("--batch", type=at_least(1), default=64, help="segments a step (64)")
    add("--rate", type=positive, default=3e-3, help="largest learning rate (0.003)")
    add("--threads", type=at_least(0), default=0, help="of torch; 0: its own choice")
    add("--held", type=at_least(1), default=2, help="shards that are kept for validation (2)")
    add("--seed", type=at_least(0), default=0, help="default 0")
    add("--start", default="", metavar="MODEL", help="weights to begin with: a file, or masks, the shipped ones")
    options = vars(command.parse_args(arguments))
    views, output = options.pop("views"), options.pop("output")

    from sq_perception.learning.checkpoint import CheckpointError
    from sq_perception.learning.mask_training import MaskTraining, train

    try:
        train(MaskTraining(**options), views, output)
    except (CheckpointError, ValueError, ArithmeticError, OSError) as error:
        return failed(f"train-masks: {error}")
    except KeyboardInterrupt:
        return failed("train-masks: stopped; the same command goes on from the last validation")
    return SUCCESS
