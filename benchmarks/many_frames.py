"""Many frames in several processes against one core: frames a second, and processor time a frame.

    python benchmarks/many_frames.py [--frames 1000] [--jobs 2] [--name many_frames]

The VGA frames of 5 bodies of :mod:`frame_time` through the first of its sensors, own masks, again and again.  ``one``
is a Recoverer of one thread in this process, ``jobs`` what ``recover --jobs`` does without files
(:mod:`sq_perception.recovery.workers`).  Its frames a second leave out the first tenth of the frames, while processes
start; its processor time is that of this process and its children, starts included.  The ratio of frames a second says
something on an idle machine alone; that of processor time holds on a busy one.
"""

from __future__ import annotations

import os

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

import multiprocessing
import time
from typing import Any

import frame_time
import torch
from common import report

from sq_perception.recovery import workers
from sq_perception.recovery.options import RecoveryOptions
from sq_perception.recovery.recoverer import Recoverer

SCENES = 20
HEADER = ["", "frames / s", "processor ms a frame"]


def processor_time() -> float:
    """Seconds of this process and of its children that ended."""
    return sum(os.times()[:4])


def of_one(works: list[workers.Work]) -> dict[str, float]:
    """The frames one after the other."""
    recoverer = Recoverer(threads=1)
    recoverer.warm_up(works[0].camera)
    began, spent = time.perf_counter(), processor_time()
    for work in works:
        recoverer.recover(work.depth, work.camera, work.labels, work.options)
    return _figures(len(works), time.perf_counter() - began, len(works), processor_time() - spent)


def of_many(works: list[workers.Work], jobs: int) -> dict[str, float]:
    """The same by so many processes."""
    spent, moments = processor_time(), []
    executor = workers.Processes(None, "auto", jobs)
    for _ in workers.recover_all(enumerate(works), executor):
        moments.append(time.perf_counter())
    for process in multiprocessing.active_children():
        process.join()
    warm = len(moments) // 10
    return _figures(len(moments) - 1 - warm, moments[-1] - moments[warm], len(moments), processor_time() - spent)


def _figures(frames: int, seconds: float, all_frames: int, processor: float) -> dict[str, float]:
    return {"frames_per_second": frames / seconds, "processor_ms": 1e3 * processor / all_frames}


def main() -> None:
    parser = report.parser(__doc__, "many_frames")
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(1)
    camera = frame_time.camera(*frame_time.IMAGES[0])
    seen = [frame_time.frame(5, number, camera, frame_time.SENSORS[0]) for number in range(SCENES)]
    works = [workers.Work(seen[k % SCENES].depth, camera, None, RecoveryOptions()) for k in range(options.frames)]
    rows: dict[str, Any] = {"one": of_one(works), f"jobs {options.jobs}": of_many(works, options.jobs)}
    lines = [[name, f"{row['frames_per_second']:.2f}", f"{row['processor_ms']:.0f}"] for name, row in rows.items()]
    one, many = rows.values()
    ratios = {name: many[name] / one[name] for name in one}
    lines.append(["ratio", f"{ratios['frames_per_second']:.2f}", f"{ratios['processor_ms']:.2f}"])
    report.write(options.name, {"options": vars(options), "rows": rows, "ratio": ratios}, report.table(HEADER, lines))


if __name__ == "__main__":
    main()
