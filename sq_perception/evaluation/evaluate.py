"""Tables 6.1 to 6.3 and 7.1 to 7.4 of the thesis and its plots, for every network and every fit, in one run.

All contestants see the same images (:mod:`sq_perception.evaluation.thesis_images`), fits the first ``--fit-bodies`` of
them.  What is counted is in :mod:`sq_perception.evaluation.figures_of_merit`, who takes part in
:mod:`sq_perception.evaluation.contestants`, and how to read the result in docs/evaluation.md.

    sq-perception evaluate
    sq-perception evaluate --models runs/*/model.safetensors --methods classic --bodies 2000 --output runs/losses
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numba
import torch

from sq_perception.evaluation import report
from sq_perception.evaluation.contest import Advance, compare
from sq_perception.evaluation.contestants import FITS, Contestant, FittingMethod, Network, unique_names
from sq_perception.evaluation.thesis_images import DEFAULT_SEED, ThesisImages
from sq_perception.files import provenance
from sq_perception.learning.checkpoint import CheckpointError, shipped

BODIES, FIT_BODIES = 20_000, 2000

_DESCRIPTION = """\
Compare networks and fits on one test set of the thesis' protocol, and write its tables 6.1 to 6.3 and 7.1 to 7.4 with
the thesis' figures beside ours, IoU histograms, angles of the rotations (figure 6.3), examples, and training curves.

A network takes part alone, unrefined, from the 256 x 256 image on; the loss in its file's header says which row of the
thesis it answers.  Fits: auto (network and surface fit), symmetry (surface fit alone), classic (Solina and Bajcsy).
"""
_EPILOG = """\
writes into --output:
  report.html    all tables and pictures in one file that needs no other and no network
  report.md      the tables
  results.json   every figure, the command, versions, processor, commit and seeds
  *.png          the pictures

A model file that cannot be read is reported and left out; the exit code is then 1.  The bodies are those of no
training, and the first n are the same for every --bodies.  Expect 7 ms a body to draw the images, and 10 ms for each
network and 15 ms for each fit; times of execution mean something on a quiet machine only.

examples:
  sq-perception evaluate
  sq-perception evaluate --models runs/*/model.safetensors --bodies 2000 --fit-bodies 300 --output runs/losses
  sq-perception evaluate --models new.safetensors --methods
"""


def default_models() -> list[Path]:
    """All weights that ship with the package."""
    return list(shipped().values())


def main(arguments: list[str] | None = None) -> int:
    """Entry of ``sq-perception evaluate``; 0, or 1 if a model could not be read."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    parser = _parser()
    options = parser.parse_args(given)
    for name in ("bodies", "fit_bodies"):
        if getattr(options, name) < 1:
            parser.error(f"--{name.replace('_', '-')}: expected at least 1, got {getattr(options, name)}")
    if options.seed < 0:
        parser.error(f"--seed: expected a number of at least 0, got {options.seed}")
    paths = default_models() if options.models is None else options.models
    methods = list(dict.fromkeys(FITS if options.methods is None else options.methods))
    if not paths and not methods:
        parser.error("nothing to evaluate: --models and --methods are both empty")
    try:
        options.output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        parser.error(f"--output: {error}")

    torch.set_num_threads(1)  # the network's layers are so small that threads cost more than they save
    contestants: list[tuple[Contestant, int]] = []
    failures: list[str] = []
    for path, name in zip(paths, unique_names(paths), strict=True):
        try:
            contestants.append((Network.read(path, name), options.bodies))
            if options.consensus:
                contestants.append((Network.read(path, f"{name} x 8", consensus=True), options.bodies))
        except CheckpointError as error:
            failures.append(str(error))
    for method in methods:
        try:
            contestants.append((FittingMethod.of(method), min(options.fit_bodies, options.bodies)))
        except CheckpointError as error:
            failures.append(f"{method}: {error}")
    for failure in failures:
        print(f"sq-perception: {failure}", file=sys.stderr)
    if not contestants:
        print("sq-perception: nothing is left to evaluate", file=sys.stderr)
        return 1

    images = ThesisImages(max(count for _, count in contestants), options.seed)
    with _progress() as advance:
        outcomes = compare(contestants, images, advance=advance)
    facts = {
        **provenance.facts(shlex.join(["sq-perception", "evaluate", *given])),
        "threads": {"torch": torch.get_num_threads(), "numba": numba.get_num_threads()},
        "seed": options.seed,
        "spawn_key": "(6, block), blocks of 500 bodies",
    }
    written = report.write(options.output, outcomes, images, facts, failures)
    print("\n\n".join(table.markdown() for table in report.overview(outcomes)))
    print(f"written: {written}")
    return 1 if failures else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sq-perception evaluate",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--consensus", action="store_true", help="each network a second time, asked in 8 positions of each view"
    )
    parser.add_argument(
        "--models", type=Path, nargs="*", metavar="FILE", help="weights to compare (default: all that are shipped)"
    )
    parser.add_argument(
        "--methods", nargs="*", choices=FITS, metavar="FIT", help=f"fits to compare (default: {' '.join(FITS)})"
    )
    parser.add_argument("--bodies", type=int, default=BODIES, metavar="N", help=f"bodies for networks ({BODIES})")
    parser.add_argument(
        "--fit-bodies", type=int, default=FIT_BODIES, metavar="N", help=f"the first N of them for fits ({FIT_BODIES})"
    )
    parser.add_argument("--seed", type=int, default=DEFAULT_SEED, help=f"of the test set ({DEFAULT_SEED})")
    parser.add_argument(
        "--output", type=Path, default=Path("runs/evaluation"), metavar="DIR", help="folder (runs/evaluation)"
    )
    return parser


@contextmanager
def _progress() -> Iterator[Advance | None]:
    """A bar a contestant, on a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars:
        tasks: dict[str, int] = {}

        def advance(name: str, done: int, of: int) -> None:
            if name not in tasks:
                tasks[name] = bars.add_task(name, total=of)
            bars.update(tasks[name], completed=done)  # type: ignore[arg-type]

        yield advance
