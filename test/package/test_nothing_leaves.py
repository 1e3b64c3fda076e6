"""The promise of SECURITY.md: no program of this package calls anybody, or leaves a file behind that was not asked for.

Real processes, with a HOME that is empty and a network in which every packet is seen (``sealed_network.py``).
"""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
import sealed_network

import sq_perception

PACKAGE = Path(sq_perception.__file__).parent
NODE_SECONDS = 12
"""A release with telemetry on looked a name up every 7 s."""


@pytest.fixture
def home(tmp_path: Path) -> Path:
    folder = tmp_path / "home"
    folder.mkdir()
    return folder


def environment(home: Path, **more: str) -> dict[str, str]:
    """This process's, with that HOME and without what would hide or move anything."""
    moved = ("XDG_", "MPL", "ORT_", "NUMBA_CACHE", "ROS_HOME", "ROS_LOG")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(moved)}
    return {**kept, "HOME": str(home), "PYTHONPATH": str(PACKAGE.parent), **more}


def files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if not path.is_dir())


@pytest.mark.parametrize(
    ("code", "seen"),
    [
        ("import socket; socket.getaddrinfo('events.example.com', 443)", "events"),
        ("import socket; socket.create_connection(('192.0.2.7', 443), 1)", "192.0.2.7 port 443"),
        ("import socket; socket.create_connection(('127.0.0.1', 9), 1)", ""),
    ],
)
def test_the_recorder_sees_what_is_sent(code: str, seen: str, home: Path, tmp_path: Path) -> None:
    sealed_network.require()
    found = sealed_network.run([sys.executable, "-c", code], environment(home), tmp_path, 60)
    assert found.code != 0
    assert any(seen in one for one in found.sent) if seen else not found.sent


def test_recover(home: Path, tmp_path: Path) -> None:
    sealed_network.require()
    pytest.importorskip("mcap", reason="needs the extra 'bags'")
    depth = np.full((60, 80), np.nan, np.float32)
    depth[20:40, 30:50] = 0.5
    np.savez(tmp_path / "a.npz", depth=depth, K=[[80, 0, 39.5], [0, 80, 29.5], [0, 0, 1]], labels=(depth > 0) * 1)
    command = [sys.executable, "-m", "sq_perception", "recover", "a.npz", "--json", "out.json"]
    command += ["--jsonl", "out.jsonl", "--meshes", "meshes", "--mcap", "out.mcap"]
    found = sealed_network.run(command, environment(home), tmp_path, sealed_network.PATIENCE)
    assert found.code == 0, found.said
    assert found.sent == ()
    assert files(tmp_path) == ["a.npz", "meshes/a.glb", "out.json", "out.jsonl", "out.mcap"]


def test_a_node(home: Path, tmp_path: Path) -> None:
    """What ROS itself logs goes where ROS_LOG_DIR says; the discovery of this machine stays on it."""
    sealed_network.require()
    pytest.importorskip("rclpy", reason="needs the extra 'ros'")
    settings = environment(home, ROS_LOG_DIR=str(tmp_path / "log"), ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
    command = [sys.executable, "-c", "from sq_perception.nodes import executables; executables.recover_node()"]
    ready = "ready, listening to"
    found = sealed_network.run(command, settings, tmp_path, NODE_SECONDS, after=ready)
    assert ready in found.said, found.said
    assert [one for one in found.sent if not one.startswith("239.")] == [], "multicast does not leave this machine"
    assert files(home) == []
