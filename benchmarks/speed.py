"""What a frame costs, in units that hold on a busy machine: processor time over that of a fixed loop and a classic fit.

    python benchmarks/speed.py [--repeats 5] [--record]

Frames: the first of frame_time's VGA scenes of 1, 5 and 20 bodies through the first of its sensors, own masks and given
ones, and one 256 x 256 image of the thesis' protocol.  One thread for everything.  Every repetition measures the loop,
the classic fits of all objects (Solina and Bajcsy's, 1000 points each) and the frame after each other, so that what
slows the processor slows all three; ratios are medians.  Processor time leaves out what others take, not
that their work empties the caches.

    loops     processor time of the frame / that of ``arithmetic``
    classic   the same / that of the classic fits of its objects
    stages    shares of the frame, the network's under ``fit`` where the fit asks for it
    compiled  share in kernels, in libraries (NumPy, OpenCV, torch), and in the interpreter: what these leave of a frame
              without a profiler
    IoU       of volumes, mean over the true bodies at least half visible

Printed beside the ratios in ``results/speed.json``, those last recorded: at a release, or where something was made
faster; ``--record`` replaces them and keeps what they replace.  Under two minutes on an idle core.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

import cProfile
import pstats
import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any
from unittest import mock

import frame_time
import numpy as np
import single_body
from common import report
from synthetic_tabletop import STAGES, scored

from sq_perception.fitting import solina_bajcsy
from sq_perception.geometry import metrics
from sq_perception.imaging.camera import Camera
from sq_perception.recovery import readings, recoverer, recovery
from sq_perception.recovery.options import Method, RecoveryOptions
from sq_perception.recovery.recovery import FrameRecovery

STEPS, LENGTH = 300, 2000
"""Of the loop: as much interpreter as NumPy, some milliseconds."""
KINDS = ("compiled", "libraries", "interpreter")


@dataclass(frozen=True)
class Work:
    """One row: a frame, how it is recovered, and how good the answer is."""

    name: str
    depth: np.ndarray
    camera: Camera
    labels: np.ndarray | None
    masks: np.ndarray
    method: Method
    seen: frame_time.SensedScene | None
    truth: Any

    def iou(self, found: FrameRecovery) -> float:
        if self.seen is not None:
            return float(np.mean(scored(self.seen, found).ious))
        return float(metrics.volume_iou(found.bodies[0].superquadric, self.truth)) if found.bodies else 0.0


def works() -> list[Work]:
    """The rows, in their order."""
    body = single_body.cube_bodies(1, np.random.default_rng(single_body.SEED))[0]
    image = single_body.orthographic(body)
    methods: tuple[Method, ...] = ("symmetry", "auto", "network")
    ones = image.mask.astype(np.int32)
    rows = [Work(f"thesis, {m}", image.depth, image.camera, None, ones, m, None, body) for m in methods]
    camera = frame_time.camera(*frame_time.IMAGES[0])
    for count in frame_time.GOALS:
        frame = frame_time.frame(count, 0, camera, frame_time.SENSORS[0])
        for name, labels in (("own", None), ("given", frame.labels)):
            row = Work(f"VGA, {count}, {name}", frame.depth, camera, labels, frame.labels, "auto", frame, None)
            rows.append(row)
    return rows


def arithmetic() -> float:
    """The loop that everything is measured in."""
    values, total = np.linspace(0.1, 1.0, LENGTH), 0.0
    for step in range(STEPS):
        values = np.sqrt(values * values + 1e-9 * step)
        total += sum(number * 0.5 for number in (1.0, 2.0, 3.0, float(values[0])))
    return total


def classic(work: Work) -> None:
    """The classic fit of every object."""
    for label in range(1, int(work.masks.max()) + 1):
        rows, columns = np.nonzero((work.masks == label) & np.isfinite(work.depth))
        chosen = np.linspace(0, len(rows) - 1, min(len(rows), 1000)).astype(int)
        rows, columns = rows[chosen], columns[chosen]
        solina_bajcsy.fit(work.camera.unproject(columns, rows, work.depth[rows, columns]))


def measured(chain: recoverer.Recoverer, work: Work, repeats: int) -> dict[str, Any]:
    """A row's ratios."""
    options = RecoveryOptions(method=work.method)

    def frame() -> FrameRecovery:
        return chain.recover(work.depth, work.camera, work.labels, options)

    found, times, stages = frame(), [], []
    for _ in range(repeats):
        moments = [time.process_time()]
        arithmetic()
        moments.append(time.process_time())
        classic(work)
        moments.append(time.process_time())
        found = frame()
        moments.append(time.process_time())
        times.append(np.diff(moments))
        stages.append([found.milliseconds[stage] for stage in STAGES if stage != "total"])
    loop, old, new = np.array(times).T
    spent = np.median(stages, axis=0)
    return {
        "loops": float(np.median(new / loop)),
        "classic": float(np.median(new / old)),
        "ms": 1e3 * float(np.min(new)),
        "stages": dict(zip((s for s in STAGES if s != "total"), (spent / spent.sum()).tolist(), strict=True)),
        "kinds": kinds(frame, float(np.min(new))),
        "iou": work.iou(found),
    }


def kinds(frame: Any, seconds: float) -> dict[str, float]:
    """Shares of compiled code, libraries and interpreter in a frame of so many seconds.

    The profiler slows the interpreter alone, so that is what the others leave; operators and ufuncs it does not see,
    and products of matrices are the longest of these.
    """
    profile = cProfile.Profile(time.thread_time)
    with mock.patch.object(np, "matmul", multiplied):
        profile.runcall(frame)
    kernels = {
        (code.co_filename, code.co_firstlineno)
        for name, module in list(sys.modules.items())
        if name.startswith("sq_perception.")
        for each in vars(module).values()
        if hasattr(each, "py_func") and (code := each.py_func.__code__)
    }
    multiplying = multiplied.__code__.co_filename, multiplied.__code__.co_firstlineno
    spent = dict.fromkeys(KINDS, 0.0)
    statistics: dict[tuple[str, int, str], tuple[int, int, float, float, Any]] = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    for (file, line, name), (_, _, own, _, _) in statistics.items():
        spent["compiled"] += own if (file, line) in kernels else 0.0
        is_library = file == "~" and "builtins." not in name
        spent["libraries"] += own if is_library or (file, line) == multiplying else 0.0
    spent["interpreter"] = max(seconds - sum(spent.values()), 0.0)
    return {kind: own / sum(spent.values()) for kind, own in spent.items()}


def multiplied(*parts: np.ndarray, product: Any = np.matmul, **more: Any) -> Any:
    """A product of matrices by a function, which a profiler sees."""
    return product(*parts, **more)


HEADER = ["frame", "loops", "recorded", "classic fits", "recorded", "of which " + " / ".join(STAGES[:-1]) + " %"]
HEADER += [" / ".join(KINDS) + " %", "IoU %"]


def line(name: str, row: dict[str, Any], before: dict[str, Any]) -> list[str]:
    """A row of the table."""
    then = [f"{before[name][key]:.1f}" if name in before else "-" for key in ("loops", "classic")]
    shares = [" / ".join(f"{100 * share:.0f}" for share in row[part].values()) for part in ("stages", "kinds")]
    return [name, f"{row['loops']:.1f}", then[0], f"{row['classic']:.1f}", then[1], *shares, f"{100 * row['iou']:.1f}"]


def main() -> None:
    parser = report.parser(__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--record", action="store_true", help="keep the figures")
    options = parser.parse_args()
    before = report.previous("speed", "rows")
    rows: dict[str, dict[str, Any]] = {}
    chain = recoverer.Recoverer(threads=1)
    by_processor = SimpleNamespace(perf_counter=time.process_time)
    with ExitStack() as clocks:
        for module in (readings, recoverer, recovery):
            clocks.enter_context(mock.patch.object(module, "time", by_processor))
        for work in works():
            chain.warm_up(work.camera)
            rows[work.name] = measured(chain, work, options.repeats)
            print(" | ".join(line(work.name, rows[work.name], before)), flush=True)
    text = report.table(HEADER, [line(name, row, before) for name, row in rows.items()])
    if options.record:
        report.write("speed", {"rows": rows, "before": before}, text)
    else:
        print(text)


if __name__ == "__main__":
    main()
