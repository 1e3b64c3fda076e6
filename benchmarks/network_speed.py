"""How long the network takes, by engine, precision, batch and threads; and the whole recovery around it.

    python benchmarks/network_speed.py [--seconds 4] [--images 100] [--threads 1 2] [--networks compact] [--compile]

The network alone: NumPy views to NumPy bodies, checks and decoding included.  compact is the shipped network on 64 x 64
views of thesis bodies; resnet18 is the thesis' network on 256 x 256 with random weights, whose speed is that of trained
ones.  The whole recovery: a 256 x 256 image of one thesis body to its result, segmentation to score, with the shipped
network.  Every number of threads has a process of its own, in which all libraries know it before they are imported.
Calls are made for ``--seconds`` after a warm-up; figures are median / 5th / 95th percentile of a call, all of its views
together.

The thesis reports 2.88 +- 0.92 ms for its network on its graphics card (table 6.3).  Budget: compact, one view, two
threads, at most 3 ms by the engine that ``inference.prepare`` takes by itself.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import report

BATCHES = (1, 64)
BUDGET_MS, BUDGET_THREADS = 3.0, 2
DEFAULT = "auto"
MOST_WARM_UP, FEWEST_CALLS = 5, 5
NETWORKS = ("compact", "resnet18")
THESIS = "The thesis reports 2.88 +- 0.92 ms for its ResNet-18 on 256 x 256 views on a graphics card (table 6.3)."


def timed(call: Callable[[], object], seconds: float) -> dict[str, float]:
    """Milliseconds of as many calls as fit into ``seconds``."""
    began = time.perf_counter()
    for k in range(MOST_WARM_UP):
        call()
        if k > 0 and time.perf_counter() - began > seconds:
            break
    times: list[float] = []
    end = time.perf_counter() + seconds
    while len(times) < FEWEST_CALLS or time.perf_counter() < end:
        began = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - began))
    return report.spread(np.array(times))


def engines(model: Any, compile_too: bool) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Name and maker of every way to compute ``model``; a maker may fail where a part is missing."""
    import torch

    from sq_perception.learning import inference

    yield DEFAULT, lambda: inference.prepare(model)
    yield "onnxruntime", lambda: inference.prepare(model, "onnxruntime")
    yield "torch, as trained", lambda: model
    yield "torch, folded", lambda: model.for_inference()
    yield "torch, folded, not channels last", lambda: model.for_inference().to(memory_format=torch.contiguous_format)
    yield "torch, folded, bfloat16", lambda: model.for_inference(torch.bfloat16)
    yield "torch.jit, optimised", lambda: _scripted(model.for_inference())
    if compile_too:
        yield "torch.compile, frozen", lambda: _compiled(model.for_inference())
    if torch.cuda.is_available():
        for dtype in (torch.float32, torch.bfloat16, torch.float16):
            name = f"GPU, folded, {str(dtype).removeprefix('torch.')}"
            yield name, lambda dtype=dtype: model.for_inference(dtype).to("cuda")


def _scripted(model: Any) -> Any:
    """The network with its heads' outputs computed by a frozen trace, one for each number of views."""
    import torch

    class Raw(torch.nn.Module):
        def __init__(self, network: Any) -> None:
            super().__init__()
            self.network = network

        def forward(self, views: torch.Tensor) -> torch.Tensor:
            return self.network.raw(views)

    traces: dict[int, Any] = {}
    plain = Raw(model).eval()
    compute = model.raw

    def raw(views: torch.Tensor) -> torch.Tensor:
        if len(views) not in traces:
            model.raw = compute
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # TorchScript is deprecated
                traces[len(views)] = torch.jit.optimize_for_inference(torch.jit.trace(plain, views))
            model.raw = raw
        return traces[len(views)](views)

    model.raw = raw
    return model


def _compiled(model: Any) -> Any:
    """The network with its heads' outputs computed by inductor, weights frozen; needs a C++ compiler and minutes."""
    import torch
    from torch._inductor import config

    config.freezing = True
    model.raw = torch.compile(model.raw, dynamic=False)
    return model


def measure_networks(names: list[str], seconds: float, compile_too: bool) -> dict[str, Any]:
    """Times of every network, engine and batch, or the reason why there are none."""
    import torch

    from sq_perception.learning import checkpoint
    from sq_perception.learning.dataset import ViewSource, draw_views
    from sq_perception.learning.regressor import Regressor, RegressorConfig

    torch.manual_seed(0)
    result: dict[str, Any] = {}
    for name in names:
        model = checkpoint.load() if name == "compact" else Regressor(RegressorConfig.thesis()).eval()
        views, _ = draw_views(max(BATCHES), np.random.default_rng(0), ViewSource(model.config.pixels))
        expected = model.predict(views).to_flat()
        result[name] = {}
        for engine, make in engines(model, compile_too):
            row: dict[str, Any] = {}
            try:
                predictor = make()
                difference = np.abs(predictor.predict(views).to_flat()[:, :8] - expected[:, :8])
                row["difference"] = float(difference.max())
                for batch in BATCHES:
                    row[str(batch)] = timed(lambda p=predictor, v=views[:batch]: p.predict(v), seconds)
                row["is"] = type(predictor).__name__
            except Exception as error:  # one engine's fault must not cost the others their figures
                row["reason"] = f"{type(error).__name__}: {str(error).splitlines()[0]}"
            result[name][engine] = row
            print(name, engine, row.get("reason", ""), file=sys.stderr, flush=True)
    return result


def measure_recovery(images: int) -> dict[str, Any]:
    """Times of whole recoveries by method, in milliseconds by stage."""
    from sq_perception.imaging import raycast, unit_cube
    from sq_perception.recovery.recoverer import Recoverer, RecoveryOptions
    from sq_perception.simulation.scenes import thesis_bodies

    camera = unit_cube.camera()
    frames = []
    for body in thesis_bodies(images, np.random.default_rng(2020)):
        depth, _ = raycast.render(unit_cube.optical_from_cube(body), camera)
        frames.append(unit_cube.depth_from_grey(unit_cube.grey_from_depth(depth)))
    result: dict[str, Any] = {}
    for method in ("network", "auto"):
        recoverer = Recoverer(method=method)
        recoverer.warm_up(camera)
        taken = [recoverer.recover(f, camera, options=RecoveryOptions(method=method)).milliseconds for f in frames]
        result[method] = {stage: report.spread(np.array([t[stage] for t in taken])) for stage in taken[0]}
    return result


def work(options: argparse.Namespace) -> None:
    """What a process of one number of threads does; the answer is the last line that it prints."""
    import torch

    torch.set_num_threads(options.work)
    answer = {"networks": measure_networks(options.networks, options.seconds, options.compile)}
    answer["recovery"] = measure_recovery(options.images)
    print(json.dumps(answer))


def in_a_process(threads: int, options: argparse.Namespace) -> dict[str, Any]:
    command = [sys.executable, str(Path(__file__).resolve()), "--work", str(threads)]
    command += ["--seconds", str(options.seconds), "--images", str(options.images)]
    command += ["--networks", *options.networks]
    command += ["--compile"] if options.compile else []
    count = {name: str(threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")}
    done = subprocess.run(command, env={**os.environ, **count}, stdout=subprocess.PIPE, text=True, check=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def shown(time: dict[str, float] | None) -> str:
    return "-" if time is None else f"{time['median']:.2f} / {time['p5']:.2f} / {time['p95']:.2f}"


def counted(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def tables(result: dict[str, Any]) -> str:
    """Both tables and the lines of the thesis and of the budget."""
    first = next(iter(result.values()))
    columns = [(batch, threads) for batch in BATCHES for threads in result]
    header = ["network", "engine", *(f"{counted(b, 'view')}, {counted(int(t), 'thread')}, ms" for b, t in columns)]
    rows = []
    for network, rows_of in first["networks"].items():
        for engine, row in rows_of.items():
            if "reason" in row:
                rows.append([network, engine, row["reason"], *["-"] * (len(columns) - 1)])
                continue
            name = f"{engine} ({row['is']})" if engine == DEFAULT else engine
            rows.append(
                [network, name, *(shown(result[t]["networks"][network][engine].get(str(b))) for b, t in columns)]
            )
    methods = [
        [method, *(shown(result[threads]["recovery"][method]["total"]) for threads in result)]
        for method in first["recovery"]
    ]
    stages = ["whole recovery", *(f"{counted(int(threads), 'thread')}, ms" for threads in result)]
    parts = [report.table(header, rows), report.table(stages, methods), THESIS, budget(result)]
    return "\n\n".join(parts)


def budget(result: dict[str, Any]) -> str:
    asked = f"Budget: compact, one view, {BUDGET_THREADS} threads, at most {BUDGET_MS:.0f} ms"
    if str(BUDGET_THREADS) not in result or "compact" not in result[str(BUDGET_THREADS)]["networks"]:
        return f"{asked}: not measured."
    median = result[str(BUDGET_THREADS)]["networks"]["compact"][DEFAULT]["1"]["median"]
    return f"{asked}: {median:.2f} ms, {'met' if median <= BUDGET_MS else 'missed'}."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--seconds", type=float, default=4.0, help="of calls, for each row and batch")
    parser.add_argument("--images", type=int, default=100, help="recovered by each method")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--networks", nargs="+", choices=NETWORKS, default=list(NETWORKS))
    parser.add_argument("--compile", action="store_true", help="torch.compile too; takes minutes")
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
