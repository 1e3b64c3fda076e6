"""Frames in several processes: the same answers in the same order, whatever dies."""

import os
import signal
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.recovery import workers
from sq_perception.recovery.options import RecoveryOptions
from sq_perception.recovery.recoverer import Recoverer
from sq_perception.recovery.workers import Work

pytestmark = pytest.mark.process
_CAMERA = Camera(96, 72, 90.0, 90.0, 47.5, 35.5)
_OPTIONS = RecoveryOptions(method="symmetry")


def _frames(count: int) -> list[tuple[int, Work]]:
    frames = []
    for k in range(count):
        size = np.array([0.05 + 0.002 * k, 0.07, 0.06])
        body = Superquadric(size, np.array([0.4, 0.8]), np.array([0.01 * k, 0.0, 0.5]), np.array([0.3, 0.2, 0.1, 1.0]))
        depth, index = raycast.render(body, _CAMERA)
        image = np.where(np.isfinite(depth), depth, np.nan).astype(np.float32)
        labels = (1 + 30_000 * k) * (index >= 0).astype(np.int32)  # of one byte to four
        frames.append((k, Work(image, _CAMERA, labels, _OPTIONS)))
    return frames


def test_two_processes_answer_as_one_and_in_order() -> None:
    frames = _frames(7)
    alone = Recoverer(method="symmetry", threads=1)
    executor = workers.Processes(None, "symmetry", 2)
    answers = list(workers.recover_all([*frames[:3], (-1, None), *frames[3:]], executor))
    assert [key for key, _ in answers] == [0, 1, 2, -1, 3, 4, 5, 6]
    assert answers[3][1] is None
    for (_, work), (_, answer) in zip(frames, [one for one in answers if one[1] is not None], strict=True):
        expected = alone.recover(work.depth, work.camera, work.labels, work.options)
        mine, theirs = answer.bodies[0].superquadric, expected.bodies[0].superquadric
        assert answer.labels.dtype == expected.labels.dtype
        np.testing.assert_array_equal(answer.labels, expected.labels)
        # Kernels just compiled and those read from the cache may differ in the last bit.
        np.testing.assert_allclose(mine.to_flat(), theirs.to_flat(), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("seconds", [0.0, 0.1, 0.3])
def test_a_ctrl_c_while_a_process_begins_is_not_for_it(seconds: float) -> None:
    """Its imports take longer than that; what they were interrupted in was printed."""
    process, pipe = workers._start(None, "symmetry")
    time.sleep(seconds)
    os.kill(process.pid, signal.SIGINT)
    pipe.close()
    process.join(60)
    assert process.exitcode == 0


def test_what_a_frame_raises_is_its_answer() -> None:
    (_, work), *_ = _frames(1)
    wrong = Work(work.depth[:10], work.camera, None, work.options)
    (_, error), (_, answer) = workers.recover_all([(0, wrong), (1, work)], workers.Processes(None, "symmetry", 2))
    assert isinstance(error, ValueError)
    assert len(answer.bodies) == 1


def test_a_killed_process_costs_no_frame_and_answers_none_twice() -> None:
    frames, seen = _frames(24), []
    for key, answer in workers.recover_all(frames, workers.Processes(None, "symmetry", 2)):
        seen.append(key)
        assert len(answer.bodies) == 1
        if key == 5:
            os.kill(_children()[-1], signal.SIGKILL)
    assert seen == list(range(24))


def _dies_while_it_answers(model: None, method: str, pipe: Connection) -> None:
    pipe.recv()
    os.write(pipe.fileno(), (1000).to_bytes(4, "big") + b"the first bytes of a thousand")
    os._exit(1)


def test_processes_that_die_while_they_answer_are_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_serve", _dies_while_it_answers)
    answers = list(workers.recover_all(_frames(2), workers.Processes(None, "symmetry", 2)))
    assert [key for key, _ in answers] == [0, 1]
    assert all(isinstance(answer, workers.WorkerLostError) for _, answer in answers)


def test_a_frame_at_which_processes_die_takes_no_other_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = _frames(6)
    over = threading.Event()

    def kill() -> None:
        """Whatever works while the third frame is asked for."""
        while not over.wait(0.05):
            for process in _children():
                os.kill(process, signal.SIGKILL)

    killer = threading.Thread(target=kill)
    answers = workers.recover_all(frames, workers.Processes(None, "symmetry", 1))
    found = [next(answers), next(answers)]
    killer.start()
    found.append(next(answers))
    over.set()
    killer.join()
    found += answers
    assert [key for key, _ in found] == list(range(6))
    lost = [key for key, answer in found if isinstance(answer, workers.WorkerLostError)]
    assert lost in ([], [2])  # it may have been answered before the first kill
    assert all(len(answer.bodies) == 1 for key, answer in found if key not in lost)


def _children() -> list[int]:
    """Processes of this one that compute; the first ones that spawn needs are no workers."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        found = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                try:
                    parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
                    command = (entry / "cmdline").read_text()
                except (OSError, IndexError):
                    continue
                if parent == os.getpid() and "spawn_main" in command:
                    found.append(int(entry.name))
        if found:
            return sorted(found)
        time.sleep(0.02)
    return []
