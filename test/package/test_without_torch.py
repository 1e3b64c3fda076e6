"""A robot needs no torch: what recovers runs where it cannot be imported, and what trains says what is missing."""

from pathlib import Path

import numpy as np
import pytest
from python_process import run_python

import sq_perception
from sq_perception.learning import checkpoint
from sq_perception.learning.networks import Regressor, RegressorConfig

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


def run(folder: Path, *each: str) -> tuple[str, str]:
    """What commands, one after the other, say on standard error, and their exit codes."""
    code = f"from sq_perception.commands.main import main; print([main(one.split()) for one in {each!r}])"
    done = run_python("-c", ABSENT + code, cwd=folder)
    return done.stderr, done.stdout.splitlines()[-1]


@pytest.fixture
def frame(tmp_path: Path) -> Path:
    depth = np.full((60, 80), np.nan, np.float32)
    depth[20:40, 30:50] = 0.5
    np.savez(tmp_path / "a.npz", depth=depth, K=[[80, 0, 39.5], [0, 80, 29.5], [0, 0, 1]], labels=(depth > 0) * 1)
    return tmp_path


def test_recover(frame: Path) -> None:
    methods = ["auto", "network", "network --model supervised", "symmetry", "classic"]
    said, codes = run(frame, *(f"recover a.npz --json {k}.json --method {method}" for k, method in enumerate(methods)))
    assert codes == str([0] * len(methods)), said
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
    run_python("-c", ABSENT + code, cwd=tmp_path)


def test_what_needs_torch_says_so(frame: Path) -> None:
    checkpoint.save(frame / "thesis.safetensors", Regressor(RegressorConfig.thesis()))
    said, codes = run(frame, "train --output run", "evaluate --output out", "recover a.npz --model thesis.safetensors")
    assert codes == "[1, 1, 1]", said
    assert said.count(REMEDY) == 3
    done = run_python("-c", ABSENT + "from sq_perception import Recoverer; Recoverer(device='cuda')", code=1)
    assert f"ValueError: device: 'cuda' {REMEDY}" in done.stderr
