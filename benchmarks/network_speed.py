"""How long the network takes, by what computes it and batch; and the whole recovery around it.

    python benchmarks/network_speed.py [--rounds 200] [--images 100]

The network alone: NumPy views to NumPy bodies, checks and decoding included.  compact is the shipped network on 64 x 64
views of thesis bodies; resnet18 is the thesis' network on 256 x 256 with random weights, whose speed is that of trained
ones.  "forward" is what the package itself takes for compact networks.  onnxruntime is compared where it is installed:

    pip install 'onnxruntime<1.29' onnx onnxscript

The whole recovery: a 256 x 256 image of one
thesis body to its result, segmentation to score, with the shipped network.  With a graphics card both are done there
too.

One thread.  The engines take turns, so that what else the machine does meets all of them.  Figures are median / 5th /
95th percentile of a call, all of its views together; the ratio to torch is that of the processor time, its least tenth.

The thesis reports 2.88 +- 0.92 ms for its network on its graphics card (table 6.3).
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

import importlib.util
import io
import itertools
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from common import report

from sq_perception.imaging import raycast, unit_cube
from sq_perception.learning import checkpoint
from sq_perception.learning.dataset import ViewSource, draw_views
from sq_perception.learning.forward import CompactRegressor
from sq_perception.learning.network_config import check_views
from sq_perception.learning.networks import Regressor, RegressorConfig
from sq_perception.recovery.recoverer import Recoverer, RecoveryOptions
from sq_perception.simulation.scenes import thesis_bodies

BATCHES = (1, 2, 10, 20)
WARM_UP = 3
LEAST = 10
"""Percentile of the processor times that is compared: a busy machine only ever adds."""
RIVAL = "torch, folded"
THESIS = "The thesis reports 2.88 +- 0.92 ms for its ResNet-18 on 256 x 256 views on a graphics card (table 6.3)."


def engines(model: Regressor) -> dict[str, Callable[[np.ndarray], Any]]:
    """Every way to compute ``model`` that is there, by name."""
    ways: dict[str, Callable[[np.ndarray], Any]] = {}
    if model.config.backbone == "compact":
        weights = {name: tensor.numpy() for name, tensor in model.state_dict().items()}
        ways["forward"] = CompactRegressor(model.config, weights).predict
    ways[RIVAL] = model.for_inference().predict
    if importlib.util.find_spec("onnxruntime") is not None:
        ways["onnxruntime"] = predict_by_onnxruntime(model)
    if torch.cuda.is_available():
        ways["GPU, folded"] = model.for_inference().to("cuda").predict
    return ways


def predict_by_onnxruntime(model: Regressor) -> Callable[[np.ndarray], Any]:
    """The network as a graph that onnxruntime computes on one thread, its telemetry off."""
    import onnxruntime

    onnxruntime.disable_telemetry_events()
    graph = io.BytesIO()
    views = torch.zeros(2, 1, model.config.pixels, model.config.pixels)
    copied = model.for_inference()
    copied.forward = copied.raw  # type: ignore[method-assign]
    program = torch.onnx.export(copied, (views,), dynamic_shapes=({0: torch.export.Dim("views")},), verbose=False)
    program.save(graph)
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = settings.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(graph.getvalue(), settings, providers=["CPUExecutionProvider"])
    name = session.get_inputs()[0].name

    def predict(views: np.ndarray) -> Any:
        (raw,) = session.run(None, {name: check_views(views, model.config)[:, None]})
        return model.config.decode(raw.astype(float))

    return predict


def of_network(model: Regressor, rounds: int) -> dict[str, Any]:
    """Times of every engine and batch: wall clock, and the processor's of all threads together."""
    views, _ = draw_views(max(BATCHES), np.random.default_rng(0), ViewSource(model.config.pixels))
    expected = model.predict(views).to_flat()[:, :8]
    ways = engines(model)
    result: dict[str, Any] = {
        way: {"difference": float(np.abs(predict(views).to_flat()[:, :8] - expected).max())}
        for way, predict in ways.items()
    }
    for batch in BATCHES:
        taken: dict[str, list[tuple[float, float]]] = {way: [] for way in ways}
        for _ in range(WARM_UP + max(rounds // batch, WARM_UP)):
            for way, predict in ways.items():
                began = time.perf_counter(), time.process_time()
                predict(views[:batch])
                taken[way].append((time.perf_counter() - began[0], time.process_time() - began[1]))
        for way, times in taken.items():
            wall, processor = 1e3 * np.array(times[WARM_UP:]).T
            result[way][str(batch)] = {**report.spread(wall), "processor": float(np.percentile(processor, LEAST))}
    return result


def of_recovery(images: int) -> dict[str, Any]:
    """Times of whole recoveries by method and what computes its network, in milliseconds by stage."""
    camera = unit_cube.camera()
    frames = []
    for body in thesis_bodies(images, np.random.default_rng(2020)):
        depth, _ = raycast.render(unit_cube.optical_from_cube(body), camera)
        frames.append(unit_cube.depth_from_grey(unit_cube.grey_from_depth(depth)))
    result: dict[str, Any] = {}
    devices = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
    for method, device in itertools.product(("network", "auto"), devices):
        recoverer = Recoverer(method=method, device=device, threads=1)
        recoverer.warm_up(camera)
        taken = [recoverer.recover(f, camera, options=RecoveryOptions(method=method)).milliseconds for f in frames]
        name = method if device == "cpu" else f"{method}, network on the GPU"
        result[name] = {stage: report.spread(np.array([t[stage] for t in taken])) for stage in taken[0]}
    return result


def shown(time: dict[str, float]) -> str:
    return f"{time['median']:.2f} / {time['p5']:.2f} / {time['p95']:.2f}"


def tables(networks: dict[str, Any], recovery: dict[str, Any]) -> str:
    """The times of calls, their processor times as multiples of torch's, and whole recoveries."""
    rows, ratios = [], []
    for network, found in networks.items():
        for engine, row in found.items():
            rows.append([network, engine, *(shown(row[str(batch)]) for batch in BATCHES)])
            shares = (row[str(batch)]["processor"] / found[RIVAL][str(batch)]["processor"] for batch in BATCHES)
            ratios.append([network, engine, *(f"{share:.2f}" for share in shares)])
    views = [f"{batch} view{'s' * (batch > 1)}" for batch in BATCHES]
    methods = [[method, shown(stages["total"])] for method, stages in recovery.items()]
    parts = [
        report.table(["network", "engine", *(f"{name}, ms" for name in views)], rows),
        report.table(["network", "engine", *(f"{name}, of torch's time" for name in views)], ratios),
        report.table(["whole recovery", "ms"], methods),
    ]
    return "\n\n".join([*parts, THESIS])


def main() -> None:
    parser = report.parser(__doc__)
    parser.add_argument("--rounds", type=int, default=200, help="calls of each engine for one view")
    parser.add_argument("--images", type=int, default=100, help="recovered by each method")
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    models = {"compact": checkpoint.load(), "resnet18": Regressor(RegressorConfig.thesis()).eval()}
    networks = {name: of_network(model, options.rounds) for name, model in models.items()}
    recovery = of_recovery(options.images)
    card = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    text = tables(networks, recovery) if card is None else f"GPU: {card}.\n\n{tables(networks, recovery)}"
    result = {"options": vars(options), "card": card, "networks": networks, "recovery": recovery}
    report.write("network_speed", result, text)


if __name__ == "__main__":
    main()
