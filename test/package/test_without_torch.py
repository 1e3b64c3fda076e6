"""A robot needs no torch: what recovers runs where it cannot be imported, and what trains says what is missing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import sq_perception

ABSENT = f"""
import sys
sys.path[:1] = [{str(Path(sq_perception.__file__).parents[1])!r}]
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "torch":
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
"""
REMEDY = "needs torch: pip install 'sq_perception[train]'"


def run(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", ABSENT + code], cwd=folder, capture_output=True, text=True, check=False, timeout=600
    )


def command(arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return run(f"from sq_perception.commands.main import main; sys.exit(main({arguments.split()!r}))", folder)


@pytest.fixture
def frame(tmp_path: Path) -> Path:
    depth = np.full((60, 80), np.nan, np.float32)
    depth[20:40, 30:50] = 0.5
    np.savez(tmp_path / "a.npz", depth=depth, K=[[80, 0, 39.5], [0, 80, 29.5], [0, 0, 1]], labels=(depth > 0) * 1)
    return tmp_path


def test_recover(frame: Path) -> None:
    methods = ["auto", "network", "network --model supervised", "symmetry", "classic"]
    each = [f"recover a.npz --json {k}.json --method {method}".split() for k, method in enumerate(methods)]
    done = run(
        f"from sq_perception.commands.main import main; sys.exit(str([main(words) for words in {each!r}]))", frame
    )
    assert done.stderr.splitlines()[-1] == str([0] * len(methods)), done.stderr
    assert len(list(frame.glob("*.json"))) == len(methods)


def test_a_node(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs the extra 'ros'")
    code = """
import rclpy
from rclpy.lifecycle import TransitionCallbackReturn
from sq_perception.nodes.frame_node import FrameNode
rclpy.init(args=["--ros-args", "-p", "method:=auto", "-p", "autostart:=false"])
node = FrameNode("recover_node")
assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS
assert "torch" not in sys.modules
"""
    done = run(code, tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "arguments", ["train --output run", "evaluate --output out", "recover a.npz --model thesis.safetensors"]
)
def test_what_needs_torch_says_so(arguments: str, frame: Path) -> None:
    if "thesis" in arguments:
        from sq_perception.learning import checkpoint
        from sq_perception.learning.networks import Regressor, RegressorConfig

        checkpoint.save(frame / "thesis.safetensors", Regressor(RegressorConfig.thesis()))
    done = command(arguments, frame)
    assert done.returncode == 1
    assert REMEDY in done.stderr
    assert "Traceback" not in done.stderr


def test_a_device_that_needs_torch(tmp_path: Path) -> None:
    done = run("from sq_perception import Recoverer; Recoverer(device='cuda')", tmp_path)
    assert f"ValueError: device: 'cuda' {REMEDY}" in done.stderr
