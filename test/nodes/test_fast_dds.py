"""Segments of dead processes are freed, those of living ones are left alone."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sq_perception.nodes.fast_dds import FOLDER, LEAST_AGE, remove_orphans

PARTICIPANT = """
import rclpy, time
rclpy.init()
node = rclpy.create_node("killed")
print("here", flush=True)
time.sleep(600)
"""


def segment(folder: Path, digits: str, age: float = 2 * LEAST_AGE) -> tuple[Path, Path]:
    """A segment of 8 KB and its lock file."""
    memory, lock = folder / f"fastrtps_{digits}", folder / f"fastrtps_{digits}_el"
    memory.write_bytes(b"1" * 8192)
    lock.touch()
    for path in (memory, lock):
        os.utime(path, (time.time() - age,) * 2)
    return memory, lock


def test_only_old_segments_without_an_owner_are_freed(tmp_path):
    dead = [segment(tmp_path, "0123456789abcdef"), segment(tmp_path, "fedcba9876543210")]
    young = segment(tmp_path, "00000000000000aa", age=0.0)
    alive = segment(tmp_path, "00000000000000bb")
    others = [tmp_path / name for name in ("fastrtps_port7410", "fastrtps_port7410_el", "sem.something", "mine_el")]
    for path in others:
        path.touch()
    with alive[1].open("rb") as owner:
        fcntl.flock(owner, fcntl.LOCK_EX)
        assert remove_orphans(tmp_path) == tuple(memory.name for memory, _ in dead)
        assert sorted(tmp_path.iterdir()) == sorted([*young, *alive, *others])
    os.utime(young[1], (time.time() - 2 * LEAST_AGE,) * 2)
    assert len(remove_orphans(tmp_path)) == 2
    assert sorted(tmp_path.iterdir()) == sorted(others)


def test_what_is_no_segment_is_no_reason_to_fail(tmp_path):
    assert remove_orphans(tmp_path / "missing") == ()
    target = tmp_path / "precious"
    target.touch()
    (tmp_path / "fastrtps_0123456789abcdef_el").symlink_to(target)
    (tmp_path / "fastrtps_0123456789abcdee_el").mkdir()
    lock = tmp_path / "fastrtps_00000000000000cc_el"
    lock.touch()
    for path in (target, tmp_path / "fastrtps_0123456789abcdee_el", lock):
        os.utime(path, (time.time() - 2 * LEAST_AGE,) * 2)
    assert remove_orphans(tmp_path) == ("fastrtps_00000000000000cc",)
    assert target.exists()
    assert (tmp_path / "fastrtps_0123456789abcdef_el").is_symlink()
    assert not lock.exists()


def test_a_killed_participant_leaves_a_segment_that_is_freed():
    pytest.importorskip("rclpy", reason="needs the extra 'ros'")
    from respawned_nodes import orphans

    before = set(os.listdir(FOLDER))  # of others, which a participant of their domain maps as well
    process = subprocess.Popen([sys.executable, "-c", PARTICIPANT], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "here\n"
        lines = Path(f"/proc/{process.pid}/maps").read_text().splitlines()
        own = {line.split("/")[-1] for line in lines if f"{FOLDER}/fastrtps_" in line and "_port" not in line} - before
        if not own:
            pytest.skip("the middleware of this installation is not Fast DDS")
        assert not own & set(orphans())
        remove_orphans()
        assert all((FOLDER / name).exists() for name in own)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
    assert own <= set(orphans())
    for name in own:
        os.utime(FOLDER / f"{name}_el", (time.time() - 2 * LEAST_AGE,) * 2)
    assert set(remove_orphans()) >= own
    assert not own & set(os.listdir(FOLDER))
