"""A stand-in for tf2_ros, whose transforms the test knows."""

import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Quaternion, TransformStamped, Vector3

Pose = tuple[np.ndarray, np.ndarray]
"""Unit quaternion and translation."""


class Tf2:
    """Answers what ``look_up`` (of target, source, stamp in nanoseconds and timeout) gives or raises."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, look_up: Callable[[str, str, int, Any], Pose]) -> None:
        self.look_up = look_up
        self.asked: list[tuple[str, str]] = []
        self.listeners = self.closed = self.cleared = 0
        monkeypatch.setitem(
            sys.modules, "tf2_ros", SimpleNamespace(Buffer=lambda: self, TransformListener=lambda *_: self._listen())
        )

    def _listen(self) -> Any:
        self.listeners += 1
        return SimpleNamespace(unregister=self._unregister)

    def _unregister(self) -> None:
        self.closed += 1

    def lookup_transform(self, target: str, source: str, time: Any, timeout: Any) -> TransformStamped:
        self.asked.append((target, source))
        turn, shift = self.look_up(target, source, time.nanoseconds, timeout)
        found = TransformStamped()
        found.transform.rotation = Quaternion(**dict(zip("xyzw", map(float, turn), strict=True)))
        found.transform.translation = Vector3(**dict(zip("xyz", map(float, shift), strict=True)))
        return found

    def clear(self) -> None:
        self.cleared += 1
