"""``sq-perception evaluate``: tables 6.1 to 6.3 and 7.1 to 7.4 of the thesis, for every network and every fit."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sq_perception.commands.console import FAILURE, SUCCESS, at_least, complain, fail, folder, parser, progress
from sq_perception.evaluation.protocol import BODIES, DEFAULT_SEED, FIT_BODIES, FITS

if TYPE_CHECKING:
    from sq_perception.evaluation.contest import Contestant
    from sq_perception.recovery.recoverer import Method

_HELP = """\
Compare networks and fits on one test set of the thesis' protocol, and write its tables 6.1 to 6.3 and 7.1 to 7.4 with
the thesis' figures beside ours, IoU histograms, angles of the rotations (figure 6.3), and examples.

Networks are evaluated without a fit, from the 256 x 256 image; the loss in the file's header selects the row of the
thesis.  Fits: auto (network and surface fit), symmetry (surface fit only), classic (Solina and Bajcsy).
"""
_EPILOG = """\
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


def main(arguments: Sequence[str]) -> int:
    """Run ``sq-perception evaluate``; return the exit code, a failure if a model could not be read."""
    command = parser("evaluate", _HELP, _EPILOG)
    add = command.add_argument
    add("--models", type=Path, nargs="*", metavar="FILE", help="weights to compare (default: all that are shipped)")
    add("--methods", nargs="*", choices=FITS, metavar="FIT", help=f"fits to compare (default: {' '.join(FITS)})")
    add("--bodies", type=at_least(1), default=BODIES, metavar="N", help=f"bodies for networks ({BODIES})")
    add("--fit-bodies", type=at_least(1), default=FIT_BODIES, metavar="N", help=f"the first N for fits ({FIT_BODIES})")
    add("--seed", type=at_least(0), default=DEFAULT_SEED, help=f"of the test set ({DEFAULT_SEED})")
    add("--output", type=folder, default="runs/evaluation", metavar="DIR", help="folder (runs/evaluation)")
    options = command.parse_args(arguments)
    methods: list[Method] = list(dict.fromkeys(FITS if options.methods is None else options.methods))
    if options.models == [] and not methods:
        command.error("nothing to evaluate: --models and --methods are both empty")
    return _evaluate(options, methods, ["sq-perception", "evaluate", *arguments])


def _evaluate(options: argparse.Namespace, methods: list[Method], command: list[str]) -> int:
    import numba
    import torch

    from sq_perception.evaluation import thesis_report
    from sq_perception.evaluation.contest import ThesisImages, compare
    from sq_perception.files import provenance

    torch.set_num_threads(1)  # the network's layers are so small that threads cost more than they save
    contestants, failures = _contestants(options, methods)
    for failure in failures:
        complain(failure)
    if not contestants:
        return fail("nothing is left to evaluate")
    images = ThesisImages(max(count for _, count in contestants), options.seed)
    with progress() as bar:
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
    return FAILURE if failures else SUCCESS


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
