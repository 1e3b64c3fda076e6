"""``sq-perception train-things``: train the network that predicts the unseen side of things."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sq_perception.commands.console import SUCCESS, at_least, failed, parser, positive

_HELP = """\
Train the network that predicts the unseen side of things, on views that `thing-views` wrote (or still writes).

The same command goes on with a run that was stopped.  The output folder holds the state, a log, and the newest network,
things.safetensors, which `recover --model` takes.
"""
_EPILOG = """\
example:
  sq-perception train-things sets/things --output runs/things --minutes 120 --start robust
"""


def main(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception train-things``; the exit code."""
    command = parser("train-things", _HELP, _EPILOG)
    add = command.add_argument
    add("views", type=Path, metavar="FOLDER", help="of the shards of views")
    add("--output", "-o", type=Path, default=Path("runs/things"), help="folder (runs/things)")
    add("--minutes", type=positive, default=120.0, help="training time, over which the rate falls (120)")
    add("--batch", type=at_least(1), default=64, help="views a step (64)")
    add("--rate", type=positive, default=8e-4, help="largest learning rate (0.0008)")
    add("--threads", type=at_least(0), default=0, help="of torch; 0: its own choice")
    add("--held", type=at_least(1), default=2, help="shards that are kept for validation (2)")
    add("--seed", type=at_least(0), default=0, help="default 0")
    add("--start", default="", metavar="MODEL", help="weights to begin with: a file, or shipped ones")
    add("--bfloat16", action="store_true", help="half the bits, faster on processors that have them")
    options = vars(command.parse_args(arguments))
    views, output = options.pop("views"), options.pop("output")

    from sq_perception.learning.checkpoint import CheckpointError
    from sq_perception.learning.thing_training import ThingTraining, train

    try:
        train(ThingTraining(**options), views, output)
    except (CheckpointError, ValueError, ArithmeticError, OSError) as error:
        return failed(f"train-things: {error}")
    except KeyboardInterrupt:
        return failed("train-things: stopped; the same command goes on from the last validation")
    return SUCCESS
