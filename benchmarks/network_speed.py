"""How long the network takes, by what computes it, batch and threads; and the whole recovery around it.

    python benchmarks/network_speed.py [--rounds 100] [--images 100] [--threads 1 2] [--networks compact]

The network alone: NumPy views to NumPy bodies, checks and decoding included.  compact is the shipped network on 64 x 64
views of thesis bodies; resnet18 is the thesis' network on 256 x 256 with random weights, whose speed is that of trained
ones.  "forward" is what the package itself takes for compact networks, on one thread whatever the number.  The whole
recovery: a 256 x 256 image of one thesis body to its result, segmentation to score, with the shipped network.

Every number of threads has a process of its own, in which all libraries know it before they are imported.  The engines
take turns, so that what else the machine does meets all of them.  Figures are median / 5th / 95th percentile of a call,
all of its views together; the ratio to torch is that of the processor time, its least tenth, on one thread.

The thesis reports 2.88 +- 0.92 ms for its network on its graphics card (table 6.3).
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import report

BATCHES = (1, 2, 10, 20)
NETWORKS = ("compact", "resnet18")
WARM_UP = 3
LEAST = 10
"""Percentile of the processor times that is compared: a busy machine only ever adds."""
RIVAL = "torch, folded"
THESIS = "The thesis reports 2.88 +- 0.92 ms for its ResNet-18 on 256 x 256 views on a graphics card (table 6.3)."


def engines(model: Any) -> dict[str, Callable[[np.ndarray], Any]]:
    """Every way to compute ``model`` that is there, by name."""
    import torch

    from sq_perception.learning.forward import CompactRegressor

    ways: dict[str, Callable[[np.ndarray], Any]] = {}
    if model.config.backbone == "compact":
        weights = {name: tensor.numpy() for name, tensor in model.state_dict().items()}
        ways["forward"] = CompactRegressor(model.config, weights).predict
    ways[RIVAL] = model.for_inference().predict
    if torch.cuda.is_available():
        ways["GPU, folded"] = model.for_inference().to("cuda").predict
    return ways


def measure_networks(names: list[str], rounds: int) -> dict[str, Any]:
    """Times of every network, engine and batch: wall clock, and the processor's of all threads together."""
    import torch

    from sq_perception.learning import checkpoint
    from sq_perception.learning.dataset import ViewSource, draw_views
    from sq_perception.learning.regressor import Regressor, RegressorConfig

    torch.manual_seed(0)
    result: dict[str, Any] = {}
    for name in names:
        model = checkpoint.load() if name == "compact" else Regressor(RegressorConfig.thesis()).eval()
        views, _ = draw_views(max(BATCHES), np.random.default_rng(0), ViewSource(model.config.pixels))
        expected = model.predict(views).to_flat()[:, :8]
        ways = engines(model)
        result[name] = {way: {} for way in ways}
        for way, predict in ways.items():
            result[name][way]["difference"] = float(np.abs(predict(views).to_flat()[:, :8] - expected).max())
        for batch in BATCHES:
            taken: dict[str, list[tuple[float, float]]] = {way: [] for way in ways}
            for _ in range(WARM_UP + max(rounds // batch, WARM_UP)):
                for way, predict in ways.items():
                    began = time.perf_counter(), time.process_time()
                    predict(views[:batch])
                    taken[way].append((time.perf_counter() - began[0], time.process_time() - began[1]))
            for way, times in taken.items():
                wall, processor = 1e3 * np.array(times[WARM_UP:]).T
                least = float(np.percentile(processor, LEAST))
                result[name][way][str(batch)] = {**report.spread(wall), "processor": least}
            print(name, batch, file=sys.stderr, flush=True)
    return result


def measure_recovery(images: int, threads: int) -> dict[str, Any]:
    """Times of whole recoveries by method and what computes its network, in milliseconds by stage."""
    import torch

    from sq_perception.imaging import raycast, unit_cube
    from sq_perception.recovery.recoverer import Recoverer, RecoveryOptions
    from sq_perception.simulation.scenes import thesis_bodies

    camera = unit_cube.camera()
    frames = []
    for body in thesis_bodies(images, np.random.default_rng(2020)):
        depth, _ = raycast.render(unit_cube.optical_from_cube(body), camera)
        frames.append(unit_cube.depth_from_grey(unit_cube.grey_from_depth(depth)))
    result: dict[str, Any] = {}
    devices = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
    for method, device in itertools.product(("network", "auto"), devices):
        recoverer = Recoverer(method=method, device=device, threads=threads)
        recoverer.warm_up(camera)
        taken = [recoverer.recover(f, camera, options=RecoveryOptions(method=method)).milliseconds for f in frames]
        name = method if device == "cpu" else f"{method}, network on the GPU"
        result[name] = {stage: report.spread(np.array([t[stage] for t in taken])) for stage in taken[0]}
    return result


def work(options: argparse.Namespace) -> None:
    """What a process of one number of threads does; the answer is the last line that it prints."""
    import torch

    torch.set_num_threads(options.work)
    answer = {"networks": measure_networks(options.networks, options.rounds)}
    answer["recovery"] = measure_recovery(options.images, options.work)
    answer["card"] = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    print(json.dumps(answer))


def in_a_process(threads: int, options: argparse.Namespace) -> dict[str, Any]:
    command = [sys.executable, str(Path(__file__).resolve()), "--work", str(threads)]
    command += ["--rounds", str(options.rounds), "--images", str(options.images)]
    command += ["--networks", *options.networks]
    count = {name: str(threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")}
    done = subprocess.run(command, env={**os.environ, **count}, stdout=subprocess.PIPE, text=True, check=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def shown(time: dict[str, float]) -> str:
    return f"{time['median']:.2f} / {time['p5']:.2f} / {time['p95']:.2f}"


def counted(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def tables(result: dict[str, Any]) -> str:
    """The times of calls, their processor times as multiples of torch's, and whole recoveries."""
    first = next(iter(result.values()))
    card = f"GPU: {first['card']}.\n\n" if first.get("card") else ""
    columns = [(batch, threads) for batch in BATCHES for threads in result]
    header = ["network", "engine", *(f"{counted(b, 'view')}, {counted(int(t), 'thread')}, ms" for b, t in columns)]
    rows, ratios = [], []
    for network, rows_of in first["networks"].items():
        for engine, row in rows_of.items():
            rows.append([network, engine, *(shown(result[t]["networks"][network][engine][str(b)]) for b, t in columns)])
            rival = rows_of[RIVAL]
            ratios.append(
                [network, engine, *(f"{row[str(b)]['processor'] / rival[str(b)]['processor']:.2f}" for b in BATCHES)]
            )
    compared = ["network", "engine", *(f"{counted(b, 'view')}, of torch's time" for b in BATCHES)]
    methods = [
        [method, *(shown(result[threads]["recovery"][method]["total"]) for threads in result)]
        for method in first["recovery"]
    ]
    stages = ["whole recovery", *(f"{counted(int(threads), 'thread')}, ms" for threads in result)]
    return card + "\n\n".join(
        [report.table(header, rows), report.table(compared, ratios), report.table(stages, methods), THESIS]
    )


def main() -> None:
    parser = report.parser(__doc__)
    parser.add_argument("--rounds", type=int, default=200, help="calls of each engine for one view")
    parser.add_argument("--images", type=int, default=100, help="recovered by each method")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--networks", nargs="+", choices=NETWORKS, default=list(NETWORKS))
    parser.add_argument("--work", type=int, default=0, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        work(options)
        return
    result = {str(threads): in_a_process(threads, options) for threads in options.threads}
    facts = {key: value for key, value in vars(options).items() if key != "work"}
    report.write("network_speed", {"options": facts, "threads": result}, tables(result))


if __name__ == "__main__":
    main()
