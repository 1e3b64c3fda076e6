"""``sq-perception train``: run or continue a training."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from sq_perception.commands.console import INTERRUPTED, SUCCESS, fail, parser, progress
from sq_perception.learning import training_config
from sq_perception.learning.training_config import CHOICES, TrainingConfig

_HELP = """\
Train the network with any loss of the thesis.  Defaults of the options come from --config if given.

The output folder holds state.safetensors, from which the same command continues, log.jsonl,
last.safetensors (the newest validated network) and model.safetensors (the best one so far).
"""
_EPILOG = """\
examples:
  sq-perception train --steps 20000 --output runs/compact
  sq-perception train --config render --output runs/render
"""


def main(arguments: Sequence[str]) -> int:
    """Run ``sq-perception train``; return the exit code."""
    command = parser("train", _HELP, _EPILOG)
    command.add_argument("--output", type=Path, default=Path("runs/compact"), help="folder of the run (runs/compact)")
    shipped = ", ".join(training_config.shipped_names())
    command.add_argument("--config", metavar="FILE", help=f"YAML file, or one of {shipped}")
    for field in fields(TrainingConfig):
        name = "--" + field.name.replace("_", "-")
        default, text = argparse.SUPPRESS, f"{field.metadata['help']} (default {field.default!r})"
        if isinstance(field.default, bool):
            command.add_argument(name, action=argparse.BooleanOptionalAction, default=default, help=text)
        else:
            choices = CHOICES.get(field.name)
            command.add_argument(name, type=type(field.default), choices=choices, default=default, help=text)
    options = vars(command.parse_args(arguments))
    output, file = options.pop("output"), options.pop("config")
    try:
        config = TrainingConfig(**options) if file is None else training_config.read(file, **options)
    except ValueError as error:
        command.error(str(error))

    from sq_perception.learning.checkpoint import CheckpointError
    from sq_perception.learning.train import Stopped, train

    try:
        with progress() as bar:
            task = bar.add_task("training", total=config.steps)
            train(
                config,
                output,
                advance=lambda step, loss: bar.update(task, completed=step, description=f"loss {loss:.4f}"),
            )
    except Stopped as stopped:
        print(stopped, file=sys.stderr)
        return INTERRUPTED
    except (CheckpointError, ValueError, ArithmeticError, OSError) as error:
        return fail(f"train: {error}")
    return SUCCESS
