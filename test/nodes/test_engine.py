"""What recover_node makes its recoverer of, and what becomes of that when the model's file is gone or another one."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

from std_msgs.msg import Header

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.calibration import Calibration
from sq_perception.imaging.camera import Camera
from sq_perception.learning import checkpoint
from sq_perception.nodes.engine import Engine
from sq_perception.nodes.frame import Frame
from sq_perception.nodes.parameters import FitterParameters, RecoverParameters

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
BODY = Superquadric([0.08, 0.06, 0.1], [0.4, 0.7], [0.0, 0.02, 0.6], [0.3, 0.2, 0.1, 0.9])


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return Path(shutil.copy(checkpoint.resolve(None), tmp_path / "model.safetensors"))


@pytest.fixture
def engine() -> Engine:
    said = SimpleNamespace(info=lambda *_: None, error=lambda *_: None)
    node: Any = SimpleNamespace(get_logger=lambda: said)
    return Engine(node)


def frame() -> Frame:
    depth, _ = raycast.render(BODY, CAMERA)
    image = np.where(np.isfinite(depth), depth, np.nan).astype(np.float32)
    return Frame(Header(), "32FC1", image, Calibration(CAMERA), np.isfinite(image).astype(np.int32))


def set_to(engine: Engine, before: RecoverParameters, **values: Any) -> RecoverParameters:
    """As ``ros2 param set`` does."""
    after = replace(before, **values)
    engine.check(after, frozenset(values))
    engine.follow(after, frozenset(values))
    return after


def test_what_is_loaded_stays_when_the_file_is_gone(engine, model):
    parameters = RecoverParameters(model=str(model), threads=1, method="network")
    engine.build(parameters)
    _, origin = engine.recover(frame(), parameters)
    parameters = set_to(engine, parameters, threads=2)
    before, same = engine.recover(frame(), parameters)
    assert (engine.fault, same) == ("", origin), "other threads are no other weights: tracks go on"
    model.unlink()
    parameters = set_to(engine, parameters, threads=3)
    after, same = engine.recover(frame(), parameters)
    assert same == origin
    assert engine.fault.startswith(f"cannot change to method network, {model} on cpu: ")
    np.testing.assert_array_equal(after.bodies[0].superquadric.size, before.bodies[0].superquadric.size)
    for wanted in ({"model": str(model)}, {"method": "auto"}):
        with pytest.raises(ValueError, match=r"model: .*model.safetensors"):
            set_to(engine, parameters, **wanted)


def test_fitter_node_asks_for_the_classic_method_and_nothing_else():
    one, other = FitterParameters().recovery_options(), RecoverParameters().recovery_options()
    assert one == replace(other, method="classic")
