"""A camera, a node and a viewer that are killed without warning and started again, as a robot's launch file does.

The viewer is a plain subscriber in a process of its own.  What is measured of a kill: the time from the new start to
the first result that needs the killed process, and the longest silence of those that live on.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from running_nodes import Peer, arguments, environment, until
from sensor_msgs.msg import CameraInfo
from started_nodes import Child

CAMERA, NODE, VIEWER = "camera", "node", "viewer"
MEMBERS = (CAMERA, NODE, VIEWER)
_SEEN = "seen at "
_VIEWER = f"""
import time
import rclpy
from sensor_msgs.msg import PointCloud2
rclpy.init()
node = rclpy.create_node("viewer")
node.create_subscription(PointCloud2, {{topic!r}}, lambda _: print("{_SEEN}", time.monotonic(), flush=True), 10)
rclpy.spin(node)
"""
_DEAF = 30.0
"""Seconds after which a process that was started again counts as not coming back."""
_SETTLE = 1.0
"""Seconds after a recovery in which the others are still watched."""


class NotBackError(Exception):
    """A process was started again and does not work."""


class Viewer(Child):
    """A process that prints the time of each result that it sees."""

    def __init__(self, topic: str) -> None:
        super().__init__("viewer", [], environment(), _VIEWER.format(topic=topic))

    @property
    def times(self) -> list[float]:
        """Seconds of the monotonic clock, which is that of all processes."""
        whole = self.output().rpartition("\n")[0]  # the last line may not be complete
        return [float(line.removeprefix(_SEEN)) for line in whole.splitlines() if line.startswith(_SEEN)]


@dataclass(frozen=True)
class Kill:
    """One kill: who, how long until it was back at work, and the longest silence of the others, in seconds.

    ``back`` is infinite if it did not come back, seen once in some 250 kills.  It looks like a known defect of Fast DDS
    2.14 (issues 2811 and 5053, pull request 4728 there): a new reader removes the shared-memory port of the dead one
    and makes it anew, while a writer that did not notice the death goes on writing into the old memory.  The camera is
    then started again, so that it opens the port anew.
    """

    member: str
    back: float
    silence: float


class Robot:
    """Three processes and the peer that watches them; leaves nothing behind."""

    def __init__(
        self, peer: Peer, camera: Sequence[str] = (), node: str = "recover_node", parameters: Sequence[str] = (),
    ) -> None:
        self._peer, self._node = peer, node
        self._camera, self._parameters = tuple(camera), tuple(parameters)
        self.running: dict[str, Any] = {}
        self.answers, self.diagnoses = peer.answers(f"/{node}"), peer.diagnoses(f"/{node}")
        self.infos: list[float] = []
        peer.listen(CameraInfo, "/depth/camera_info", lambda _: self.infos.append(time.monotonic()))
        self.pids: list[int] = []

    def __enter__(self) -> Robot:
        for member in MEMBERS:
            self.start(member)
        until(lambda: self.answers and self.running[VIEWER].times, (self.running[NODE],))
        return self

    def __exit__(self, *_: object) -> None:
        for member in MEMBERS:
            if member in self.running:
                self.running[member].kill()

    def start(self, member: str) -> None:
        if member == VIEWER:
            self.running[member] = Viewer(f"/{self._node}/superquadrics")
        elif member == CAMERA:
            words = [*arguments(*self._camera), "--log-level", "warn"]
            self.running[member] = Child("synthetic_depth_node", words, environment(NUMBA_NUM_THREADS="1"))
        else:
            words = [*arguments(*self._parameters), "--log-level", "warn"]
            self.running[member] = Child(self._node, words, environment())
        self.pids.append(self.running[member].pid)

    def kill(self, member: str) -> Kill:
        """SIGKILL, a new start at once, and what came of it."""
        others = {name: process.pid for name, process in self.running.items() if name != member}
        began = time.monotonic()
        self.running[member].kill()
        self.start(member)
        started = time.monotonic()
        try:
            back = self._wait(member, started)
        except NotBackError:
            back = math.inf
            self.running[CAMERA].kill()
            self.start(CAMERA)
            self._wait(CAMERA, time.monotonic())
            others[CAMERA] = self.running[CAMERA].pid
        ended = time.monotonic()
        time.sleep(_SETTLE)
        assert {name: self.running[name].pid for name in others} == others
        for name in others:
            assert self.running[name].exit_code is None, f"the {name} ended with the {member}"
        return Kill(member, back, self._silence(member, began, ended))

    def _wait(self, member: str, started: float) -> float:
        wall = time.time() - (time.monotonic() - started)
        if member == VIEWER:
            return self._until(lambda: next(iter(self.running[VIEWER].times), 0.0)) - started
        seen = len(self.answers)

        def answered() -> float:
            # The first result of an image that did not exist before the new start.
            return next((one.time for one in self.answers[seen:] if 1e-9 * one.stamp > wall), 0.0)

        back = self._until(answered)
        self._until(lambda: max(self.running[VIEWER].times, default=0.0) >= back - 1.0)
        return back - started

    def _until(self, condition: Callable[[], float]) -> float:
        deadline = time.monotonic() + _DEAF
        while not (result := condition()):
            for member, process in self.running.items():
                assert process.exit_code is None, f"the {member} ended"
            if time.monotonic() > deadline:
                raise NotBackError
            time.sleep(0.002)
        return result

    def _silence(self, member: str, began: float, ended: float) -> float:
        heard = {
            CAMERA: [one.time for one in self.diagnoses],
            NODE: self.infos,
            VIEWER: [one.time for one in self.answers],
        }[member]
        times = [began, *(one for one in heard if began < one < ended + _SETTLE), ended + _SETTLE]
        return max(later - earlier for earlier, later in pairwise(times))

    def left(self) -> list[int]:
        return [pid for pid in self.pids if Path(f"/proc/{pid}").exists()]
