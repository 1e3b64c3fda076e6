"""Commands about networks: ``train`` and ``evaluate``; ``thing-views`` and ``segment-views`` draw views into shards,
``train-things`` and ``train-masks`` train on them.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sq_perception.commands import console
from sq_perception.evaluation import BODIES, DEFAULT_SEED, FIT_BODIES, FITS
from sq_perception.learning import training_config
from sq_perception.learning.training_config import CHOICES, MASK_RUN, THING_RUN, ShardTraining, TrainingConfig

if TYPE_CHECKING:
    from sq_perception.evaluation.contest import Contestant
    from sq_perception.recovery.recoverer import Method


_TRAIN_HELP = """\
Train the network with any loss of the thesis.  Defaults of the options come from --config if given.

The output folder holds state.safetensors, from which the same command continues, log.jsonl,
last.safetensors (the newest validated network) and model.safetensors (the best one so far).
"""
_TRAIN_EPILOG = """\
examples:
  sq-perception train --steps 20000 --output runs/compact
  sq-perception train --config render --output runs/render
"""


def train(arguments: Sequence[str]) -> int:
    """Run ``sq-perception train``; return the exit code."""
    command = console.parser("train", _TRAIN_HELP, _TRAIN_EPILOG)
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

    from sq_perception.learning import train as training

    with console.progress() as bar:
        task = bar.add_task("training", total=config.steps)

        def advance(step: int, loss: float) -> None:
            bar.update(task, completed=step, description=f"loss {loss:.4f}")

        return _end_of("train", lambda: training.train(config, output, advance=advance))


def _end_of(name: str, work: Callable[[], object]) -> int:
    """Train or draw; return the exit code."""
    from sq_perception.learning.training import Stopped

    try:
        work()
    except Stopped as stopped:
        return console.complain(f"{name}: {stopped}", console.INTERRUPTED)
    except (ValueError, ArithmeticError, OSError) as error:
        return console.complain(f"{name}: {error}")
    return console.SUCCESS


_DRAW = """\
Draw {what} into a folder, shard by shard.

Shard k depends only on the seed and k; existing shards are kept.  Several processes may fill one folder with different
--first; a training reads what it finds.
"""
_TRAIN = """\
Train the network that {what} (or still writes).

The same command continues a stopped run.  The output folder holds the state, a log, and the newest network,
{weights}.
"""


def thing_views(arguments: Sequence[str]) -> int:
    """Run ``sq-perception thing-views``; return the exit code."""
    example = "sq-perception thing-views sets/things --shards 200 && sq-perception train-things sets/things"
    command = _make_drawing_parser("thing-views", "canonical views of simulated household objects", example, shards=100)
    command.add_argument("--views", type=console.at_least(1), default=512, help="views per shard (512)")
    command.add_argument(
        "--meshes", type=Path, metavar="FOLDER", help="your own objects, in metres, for half of the views"
    )
    given = command.parse_args(arguments)

    from sq_perception.simulation.thing import read_things
    from sq_perception.simulation.thing_views import draw_thing_views

    def drawing() -> Callable[[Any], Any]:
        return partial(draw_thing_views, given.views, own=read_things(given.meshes) if given.meshes else ())

    return _draw("thing-views", given, drawing)


def segment_views(arguments: Sequence[str]) -> int:
    """Run ``sq-perception segment-views``; return the exit code."""
    example = "sq-perception segment-views sets/segments && sq-perception train-masks sets/segments"
    what = "segments of simulated scenes, and which of their readings are of their object,"
    command = _make_drawing_parser("segment-views", what, example, shards=40)
    command.add_argument("--scenes", type=console.at_least(1), default=200, help="per shard, about 11 views each (200)")
    given = command.parse_args(arguments)

    from sq_perception.simulation.segment_views import draw_segment_views

    return _draw("segment-views", given, lambda: partial(draw_segment_views, given.scenes))


def _make_drawing_parser(name: str, what: str, example: str, shards: int) -> argparse.ArgumentParser:
    """Make the common parser of both commands that draw."""
    command = console.parser(name, _DRAW.format(what=what), f"example:\n  {example}")
    add = command.add_argument
    add("folder", type=Path, help="of the shards")
    add("--shards", type=console.at_least(1), default=shards, help="total number of shards (%(default)s)")
    add("--first", type=console.at_least(0), default=0, help="number of the first one (0)")
    add("--seed", type=console.at_least(0), default=0, help="default 0")
    return command


def _draw(name: str, given: argparse.Namespace, drawing: Callable[[], Callable[[Any], Any]]) -> int:
    """Write the shards that ``drawing`` gives, which may first read something."""
    from sq_perception.geometry.threads import one_kernel_thread
    from sq_perception.learning.shard_training import write_views

    shards = range(given.first, given.first + given.shards)
    with one_kernel_thread():  # a process a core draws
        return _end_of(name, lambda: write_views(given.folder, shards, drawing(), given.seed))


def _train(
    subject: str, run: ShardTraining, what: str, weights: str, example: str, arguments: Sequence[str]
) -> int:
    """Run ``sq-perception train-SUBJECT``; return the exit code."""
    text, example = _TRAIN.format(what=what, weights=weights), f"sq-perception train-{subject} {example}"
    command = console.parser(f"train-{subject}", text, f"example:\n  {example}")
    command.set_defaults(**asdict(run))
    add = command.add_argument
    add("views", type=Path, metavar="FOLDER", help="of the shards of views")
    add("--output", "-o", type=Path, default=Path(f"runs/{subject}"), help="folder (%(default)s)")
    add("--minutes", type=console.positive, help="training time, over which the learning rate falls (%(default)s)")
    add("--batch", type=console.at_least(1), help="views per step (%(default)s)")
    add("--rate", dest="learning_rate", metavar="RATE", type=console.positive, help="largest one (%(default)s)")
    add("--threads", type=console.at_least(0), help="threads of torch; 0: its own choice")
    add("--device", help="cpu or cuda (%(default)s)")
    add("--validation", type=console.at_least(1), help="steps between two validations (%(default)s)")
    add("--held", type=console.at_least(1), help="shards that are kept for validation (%(default)s)")
    add("--seed", type=console.at_least(0), help="default %(default)s")
    add("--start", metavar="MODEL", help="weights to begin with: a file, or shipped ones")
    add("--bfloat16", action="store_true", help="bfloat16 arithmetic, twice as fast on processors that have it")
    options = vars(command.parse_args(arguments))

    from sq_perception.learning import shard_training

    views, output, kind = options.pop("views"), options.pop("output"), getattr(shard_training, subject.upper())
    return _end_of(f"train-{subject}", lambda: shard_training.train(kind, replace(run, **options), views, output))


train_things = partial(
    _train, "things", THING_RUN, "predicts the unseen side of objects, on views that `thing-views` wrote",
    "things.safetensors, which `recover --model` takes",
    "sets/things --output runs/things --minutes 120 --start things",
)
train_masks = partial(
    _train, "masks", MASK_RUN, "finds outliers in segments, on those that `segment-views` wrote", "masks.safetensors",
    "sets/segments --output runs/masks --minutes 60",
)


_EVALUATE_HELP = """\
Compare networks and fits on one test set of the thesis' protocol, and write its tables 6.1 to 6.3 and 7.1 to 7.4 with
the thesis' figures beside ours, IoU histograms, angles of the rotations (figure 6.3), and examples.

Networks are evaluated without a fit, from the 256 x 256 image; the loss in the file's header selects the row of the
thesis.  Fits: auto (network and surface fit), symmetry (surface fit only), classic (Solina and Bajcsy).
"""
_EVALUATE_EPILOG = """\
writes into --output:
  report.md      the tables and pictures
  results.json   every figure, the command, versions, processor, commit and seeds
  *.png          the pictures

Unreadable model files are reported and skipped; the exit code is then 1.  No training uses these bodies, and the first
n are the same for every --bodies.  Expect 7 ms per body for the images, 10 ms per network and 15 ms per fit; execution
times are meaningful only on an idle machine.

examples:
  sq-perception evaluate
  sq-perception evaluate --models runs/*/model.safetensors --bodies 2000 --fit-bodies 300 --output runs/losses
  sq-perception evaluate --models new.safetensors --methods
"""


def evaluate(arguments: Sequence[str]) -> int:
    """Run ``sq-perception evaluate``; return the exit code, a failure if a model could not be read."""
    command = console.parser("evaluate", _EVALUATE_HELP, _EVALUATE_EPILOG)
    add = command.add_argument
    add("--models", type=Path, nargs="*", metavar="FILE", help="weights to compare (default: all that are shipped)")
    add("--methods", nargs="*", choices=FITS, metavar="FIT", help=f"fits to compare (default: {' '.join(FITS)})")
    add("--bodies", type=console.at_least(1), default=BODIES, metavar="N", help=f"bodies for networks ({BODIES})")
    add("--fit-bodies", type=console.at_least(1), default=FIT_BODIES, metavar="N", help=f"and for fits ({FIT_BODIES})")
    add("--seed", type=console.at_least(0), default=DEFAULT_SEED, help=f"of the test set ({DEFAULT_SEED})")
    add("--output", type=console.folder, default="runs/evaluation", metavar="DIR", help="folder (runs/evaluation)")
    options = command.parse_args(arguments)
    methods: list[Method] = list(dict.fromkeys(FITS if options.methods is None else options.methods))
    if options.models == [] and not methods:
        command.error("nothing to evaluate: --models and --methods are both empty")
    return _run_evaluation(options, methods, ["sq-perception", "evaluate", *arguments])


def _run_evaluation(options: argparse.Namespace, methods: list[Method], command: list[str]) -> int:
    import numba
    import torch

    from sq_perception.evaluation import thesis_report
    from sq_perception.evaluation.contest import ThesisImages, compare
    from sq_perception.files import provenance

    torch.set_num_threads(1)  # the network's layers are so small that threads cost more than they save
    contestants, failures = _contestants(options, methods)
    for failure in failures:
        console.complain(failure)
    if not contestants:
        return console.complain("nothing is left to evaluate")
    images = ThesisImages(max(count for _, count in contestants), options.seed)
    with console.progress() as bar:
        tasks = {contestant.name: bar.add_task(contestant.name, total=count) for contestant, count in contestants}
        outcomes = compare(contestants, images, advance=lambda name, done: bar.update(tasks[name], completed=done))
    facts = {
        **provenance.facts(shlex.join(command)),
        "threads": {"torch": torch.get_num_threads(), "numba": numba.get_num_threads()},
        "seed": options.seed,
        "spawn_key": "(6, block), blocks of 500 bodies",
    }
    written, entries = thesis_report.write(options.output, outcomes, images, facts, failures)
    print("\n\n".join(table.markdown() for table in thesis_report.overview(entries)))
    print(f"written: {written}")
    return console.FAILURE if failures else console.SUCCESS


def _contestants(options: argparse.Namespace, methods: list[Method]) -> tuple[list[tuple[Contestant, int]], list[str]]:
    """Return the contestants with their number of bodies, and the errors of those that cannot take part."""
    from sq_perception.evaluation.contest import fit, network, unique_names
    from sq_perception.learning.checkpoint import CheckpointError, shipped_regressors

    contestants: list[tuple[Contestant, int]] = []
    failures: list[str] = []
    paths = list(shipped_regressors().values()) if options.models is None else options.models
    for path, name in zip(paths, unique_names(paths), strict=True):
        try:
            contestants.append((network(path, name), options.bodies))
        except CheckpointError as error:
            failures.append(str(error))
    for method in methods:
        try:
            contestants.append((fit(method), min(options.fit_bodies, options.bodies)))
        except CheckpointError as error:
            failures.append(f"{method}: {error}")
    return contestants, failures
