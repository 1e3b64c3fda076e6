"""``sq-perception train-things`` and ``train-masks``: train a network on views that a folder holds."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from sq_perception.commands.console import SUCCESS, at_least, failed, parser, positive
from sq_perception.learning.training_config import MASK_RUN, THING_RUN, ShardTraining

_HELP = """\
Train the network that {what}, on {views} (or still writes).

The same command goes on with a run that was stopped.  The output folder holds the state, a log, and the newest network,
{weights}.
"""


def things(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception train-things``; the exit code."""
    text = _HELP.format(
        what="predicts the unseen side of things",
        views="views that `thing-views` wrote",
        weights="things.safetensors, which `recover --model` takes",
    )
    example = "sq-perception train-things sets/things --output runs/things --minutes 120 --start robust"
    command = _parser("things", text, example, THING_RUN)
    command.add_argument("--bfloat16", action="store_true", help="half the bits, faster on processors that have them")
    options = vars(command.parse_args(arguments))

    from sq_perception.learning.thing_training import THINGS

    return _train(THINGS, THING_RUN, options)


def masks(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception train-masks``; the exit code."""
    text = _HELP.format(
        what="finds strays in segments", views="those that `segment-views` wrote", weights="masks.safetensors"
    )
    example = "sq-perception train-masks sets/segments --output runs/masks --minutes 60"
    options = vars(_parser("masks", text, example, MASK_RUN).parse_args(arguments))

    from sq_perception.learning.mask_training import MASKS

    return _train(MASKS, MASK_RUN, options)


def _parser(subject: str, text: str, example: str, run: ShardTraining) -> argparse.ArgumentParser:
    """What both commands take."""
    command = parser(f"train-{subject}", text, f"example:\n  {example}")
    command.set_defaults(**asdict(run))
    add = command.add_argument
    add("views", type=Path, metavar="FOLDER", help="of the shards of views")
    add("--output", "-o", type=Path, default=Path(f"runs/{subject}"), help="folder (%(default)s)")
    add("--minutes", type=positive, help="training time, over which the rate falls (%(default)s)")
    add("--batch", type=at_least(1), help="views a step (%(default)s)")
    add("--rate", type=positive, help="largest learning rate (%(default)s)")
    add("--threads", type=at_least(0), help="of torch; 0: its own choice")
    add("--held", type=at_least(1), help="shards that are kept for validation (%(default)s)")
    add("--seed", type=at_least(0), help="default %(default)s")
    add("--start", metavar="MODEL", help="weights to begin with: a file, or shipped ones")
    return command


def _train(subject: Any, run: ShardTraining, options: dict[str, Any]) -> int:
    from sq_perception.learning.checkpoint import CheckpointError
    from sq_perception.learning.shard_training import train

    views, output = options.pop("views"), options.pop("output")
    try:
        train(subject, replace(run, **options), views, output)
    except (CheckpointError, ValueError, ArithmeticError, OSError) as error:
        return failed(f"train-{subject.name}: {error}")
    except KeyboardInterrupt:
        return failed(f"train-{subject.name}: stopped; the same command goes on from the last validation")
    return SUCCESS
