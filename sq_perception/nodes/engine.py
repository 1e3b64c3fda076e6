"""The recoverer of a frame node, shared by the nodes of a process.

After a change of its parameters (model, device ...) the next frame waits for another one.  If that cannot be made, the
old one stays active and :attr:`Engine.fault` has the reason.

Nodes of one process share equal recoverers.  A process computes one frame at a time, in the order of requests
(:class:`Turns`): a frame already uses every core, so two at once would each take twice as long.
"""

from __future__ import annotations

import threading
import weakref
from collections import deque
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TypeAlias

from rclpy.node import Node

from sq_perception.imaging import unit_cube
from sq_perception.learning import checkpoint, inference
from sq_perception.nodes.frame import Frame
from sq_perception.nodes.parameters import RecoverParameters
from sq_perception.recovery import still_scene
from sq_perception.recovery.options import NEEDS_NETWORK
from sq_perception.recovery.recoverer import FrameRecovery, Recoverer
from sq_perception.recovery.still_scene import Reference, StillScene
from sq_perception.segmentation.options import Pose
from sq_perception.simulation.scenes import TABLE_CAMERA

_MADE_OF = ("device", "threads", "method", "model")  # parameters that determine a recoverer

Answer: TypeAlias = tuple[FrameRecovery, Hashable]  # the bodies of a frame, and a value that is equal for equal origins


class Turns:
    """Lock that a ``with`` block holds, granted in the order of requests, so that no camera starves."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: deque[object] = deque()

    def take(self) -> None:
        ticket = object()
        with self._changed:
            self._waiting.append(ticket)
            self._changed.wait_for(lambda: self._waiting[0] is ticket)

    def give(self, *_: object) -> None:
        with self._changed:
            self._waiting.popleft()
            self._changed.notify_all()

    __enter__, __exit__ = take, give

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Give up the caller's turn within the block, and wait for another one at its end."""
        self.give()
        try:
            yield
        finally:
            self.take()


TURNS = Turns()  # the lock of this process
_shared: weakref.WeakValueDictionary[Hashable, Recoverer] = weakref.WeakValueDictionary()


@dataclass(frozen=True)
class _Built:
    recoverer: Recoverer
    parameters: RecoverParameters
    key: tuple[Hashable, ...]  # equal for recoverers that nodes may share; begins with the weights


class Engine:
    """The active recoverer of a node; see the module."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._built: _Built | None = None
        self._last: dict[Hashable, Reference] = {}
        """State that the last frame leaves for the next, by its frame_id and origin."""
        self._is_due = False  # whether a parameter was set that may need another recoverer
        self.fault = ""  # why the last change failed; empty once one has succeeded

    def build(self, parameters: RecoverParameters) -> None:
        """Make and warm up the recoverer.  Raises ValueError if the model or the device cannot be used."""
        self.release()
        with TURNS:
            self._built = _make(parameters)

    def release(self) -> None:
        """Release the recoverer."""
        self._built, self._last, self._is_due, self.fault = None, {}, False, ""

    def discard(self) -> None:
        """Stop sharing the recoverer, since it has failed repeatedly."""
        if self._built is not None and _shared.get(self._built.key) is self._built.recoverer:
            del _shared[self._built.key]

    def check(self, parameters: RecoverParameters, changed: frozenset[str]) -> None:
        """Raise ValueError for parameters of which no recoverer could be made, as far as this is known at once."""
        if "device" in changed:
            inference.check_device(parameters.device)
        is_read = self._built is not None and parameters.method in NEEDS_NETWORK and changed & {"device", "method"}
        if "model" in changed or is_read:
            try:
                checkpoint.check(parameters.model or None)
            except ValueError as error:
                raise ValueError(f"model: {error}") from error

    def follow(self, parameters: RecoverParameters, changed: frozenset[str]) -> None:
        """Note which parameters were set, if to the value that they had: so a model file that was replaced is read."""
        self._is_due = self._is_due or not changed.isdisjoint(_MADE_OF)

    def recover(self, frame: Frame, parameters: RecoverParameters, pose: Pose | None = None) -> Answer:
        """Return the bodies of a frame, ``pose`` in ``target_frame`` if there is one, and a value equal for equal
        origins; for the holder of the turn.  With ``tracking``, what did not change comes from the last answer of this
        origin."""
        if self._is_due:
            self._is_due = False
            self._replace(parameters)
        built = self._built
        if built is None:
            raise RuntimeError("the recoverer has been released")
        method = built.parameters.method  # another one may be set that cannot be had
        origin = built.key[0], method
        key = frame.header.frame_id, origin
        last = self._last.get(key) if parameters.tracking else None
        options = replace(parameters.recovery_options(pose, frame.has_free_space), method=method)
        scene = StillScene(built.recoverer, last)
        recovery = scene.recover(frame.depth, frame.camera, frame.labels, options)
        self._last = {} if scene.last is None else {key: scene.last}
        return recovery, origin

    @property
    def description(self) -> str:
        """Describe the active recoverer for diagnostics."""
        return "none" if (built := self._built) is None else _describe(built.parameters)

    def _replace(self, parameters: RecoverParameters) -> None:
        started, log = perf_counter(), self._node.get_logger()
        try:
            self._built, self.fault = _make(parameters), ""
            log.info(f"changed to {_describe(parameters)} within {perf_counter() - started:.1f} s")
        except Exception as error:  # whatever it is: the old one goes on
            self.fault = f"cannot change to {_describe(parameters)}: {' '.join(str(error).split())}"
            log.error(f"{self.fault}; the previous one stays active")


def _make(parameters: RecoverParameters) -> _Built:
    """Return a warm recoverer, an existing one if it is equivalent."""
    # Without the model: the same file may have several names.
    key = (_file(parameters.model), *(getattr(parameters, name) for name in _MADE_OF if name != "model"))
    recoverer = _shared.get(key)
    if recoverer is None:
        recoverer = Recoverer(
            parameters.model or None, parameters.device, parameters.method, parameters.threads or None
        )
        still_scene.warm_up()
        is_cube = parameters.projection == "orthographic"
        recoverer.warm_up(unit_cube.camera() if is_cube else TABLE_CAMERA)
        _shared[key] = recoverer
    return _Built(recoverer, parameters, key)


def _file(model: str) -> Hashable:
    """Identify a weights file, also against one that is given its name later."""
    path = checkpoint.resolve(model or None)
    try:
        known = path.stat()
    except OSError:
        return str(path)
    return str(path.resolve()), known.st_ino, known.st_size, known.st_mtime_ns


def _describe(parameters: RecoverParameters) -> str:
    if parameters.method not in NEEDS_NETWORK:
        return f"method {parameters.method}, no network"
    return f"method {parameters.method}, {parameters.model or 'default weights'} on {parameters.device}"
