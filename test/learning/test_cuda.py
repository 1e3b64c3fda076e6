"""On a graphics card networks predict and train as on the processor; skipped where there is none."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sq_perception.geometry.metrics import volume_iou
from sq_perception.imaging import raycast, unit_cube
from sq_perception.learning import checkpoint, inference, shard_training, train
from sq_perception.learning.dataset import ViewSource, draw_views
from sq_perception.learning.training_config import MASK_RUN, THING_RUN, ShardTraining, TrainingConfig
from sq_perception.recovery.recoverer import Recoverer
from sq_perception.simulation.scenes import thesis_bodies
from sq_perception.simulation.segment_views import draw_segment_views
from sq_perception.simulation.thing_views import draw_thing_views

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")

ROUNDED = 5e-3
"""Relative: a card rounds the factors of a convolution to 11 bits, a network of nine layers adds some of that up."""


def test_bodies_are_those_of_the_processor() -> None:
    views, _ = draw_views(32, np.random.default_rng(3), ViewSource(64))
    here, there = (inference.load("supervised", device).predict(views) for device in ("cpu", "cuda"))
    assert volume_iou(there, here).min() > 0.97
    assert np.allclose(there.size, here.size, rtol=5 * ROUNDED)


def test_hulls_are_those_of_the_processor() -> None:
    views = draw_thing_views(32, np.random.default_rng(4))
    shown = views.images, views.planes, views.extents
    here, there = (inference.load_things(None, device).predict(*shown) for device in ("cpu", "cuda"))
    assert np.abs(there.support - here.support).max() < ROUNDED
    deviations = [np.sqrt(np.diagonal(each.covariance, axis1=1, axis2=2)) for each in (here, there)]
    assert np.allclose(*deviations, rtol=10 * ROUNDED)


def test_a_frame_is_recovered_alike() -> None:
    camera = unit_cube.camera()
    body = thesis_bodies(1, np.random.default_rng(5))[0]
    depth, _ = raycast.render(unit_cube.optical_from_cube(body), camera)
    here, there = (Recoverer(device=device).recover(depth, camera).bodies[0] for device in ("cpu", "cuda"))
    assert volume_iou(there.superquadric, here.superquadric) > 0.995


def test_a_run_goes_on(tmp_path: Path) -> None:
    config = TrainingConfig(steps=40, batch=16, points=64, validation=20, warm_up=5, threads=1, device="cuda")
    train.train(replace(config, steps=20), tmp_path)
    train.train(config, tmp_path)
    log = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [record["step"] for record in log] == [20, 40]
    assert "device" in checkpoint.read_header(tmp_path / "model.safetensors")["made"]
    assert next(checkpoint.load(tmp_path / "model.safetensors").parameters()).device.type == "cpu"


@pytest.mark.parametrize("kind", [shard_training.THINGS, shard_training.MASKS], ids=lambda kind: kind.name)
def test_a_run_on_shards_goes_on(tmp_path: Path, kind: shard_training.NetworkKind) -> None:
    draw, run = (draw_thing_views, THING_RUN) if kind is shard_training.THINGS else (draw_segment_views, MASK_RUN)
    shard_training.write_views(tmp_path / "views", range(3), lambda rng: draw(4, rng), seed=1)
    config: ShardTraining = replace(run, minutes=0.05, batch=8, held=1, threads=1, device="cuda")
    shard_training.train(kind, config, tmp_path / "views", tmp_path / "run")
    first = len((tmp_path / "run" / "log.jsonl").read_text().splitlines())
    shard_training.train(kind, replace(config, minutes=0.1), tmp_path / "views", tmp_path / "run")
    assert len((tmp_path / "run" / "log.jsonl").read_text().splitlines()) > first
    assert "device" in checkpoint.read_header(tmp_path / "run" / f"{kind.name}.safetensors")["made"]
