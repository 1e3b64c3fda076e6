"""What computes in a frame node: a recoverer, made away from the frames, swapped as a whole, shared within a process.

A change of the parameters that a recoverer is made of (model, device ...) makes another one in a thread of its own,
warmed up before it is used.  Frames go on with the old one, and with those parameters as they were, until the new one
is ready.  One that cannot be made leaves the old one at work, and :attr:`Engine.fault` says why.

Nodes of one process that ask for equal recoverers get one: several cameras need the memory of one network.  One frame
is computed at a time in a process, in the order of asking (:class:`Turns`): a frame already uses every core, two at
once would each take twice as long, and a GPU serves one of them at a time anyway.
"""

from __future__ import annotations

import threading
import weakref
from collections import deque
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any, Generic, TypeVar

from rclpy.node import Node

from sq_perception.imaging.camera import Camera
from sq_perception.nodes.frame import Frame
from sq_perception.recovery.recoverer import FrameRecovery, Recoverer, RecoveryOptions

P = TypeVar("P")


class Turns:
    """A lock that is given in the order in which it was asked for, so that no camera starves."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: deque[object] = deque()

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Wait for one's turn, and keep it for the block."""
        ticket = object()
        with self._changed:
            self._waiting.append(ticket)
            self._changed.wait_for(lambda: self._waiting[0] is ticket)
        try:
            yield
        finally:
            with self._changed:
                self._waiting.popleft()
                self._changed.notify_all()


TURNS = Turns()
"""Those of this process."""


@dataclass(frozen=True)
class RecovererFactory(Generic[P]):
    """How a kind of node makes its recoverer, and tells it what the parameters say.

    Attributes
    ----------
    make
        A recoverer of parameters, with the weights of another one if that is given.
    options
        What the parameters say to each frame.
    made_of
        Names of the parameters that the recoverer is made of.
    read_by
        Those of them whose setting reads the weights; the others keep what is loaded, whatever became of the file.
    weights
        Tells the weights that would be read now from others; None where recoverers are never shared.
    answers
        Names of the parameters that change what bodies come out, beside the weights.
    check
        Raises ValueError for parameters that :attr:`make` would refuse, as far as that can be told at once; it also
        gets the names of those that change, and the recoverer at work.
    describe
        In a few words, for diagnostics.
    """

    make: Callable[[P, Recoverer | None], Recoverer]
    options: Callable[[P], RecoveryOptions]
    made_of: tuple[str, ...] = ()
    read_by: tuple[str, ...] = ()
    weights: Callable[[P], Hashable] = lambda _: None
    answers: tuple[str, ...] = ()
    check: Callable[[P, frozenset[str], Recoverer | None], None] = lambda *_: None
    describe: Callable[[P], str] = lambda _: ""


_shared: weakref.WeakValueDictionary[Hashable, Recoverer] = weakref.WeakValueDictionary()
_making = threading.Lock()


class _Superseded(Exception):  # noqa: N818 - no fault
    """Another request came meanwhile."""


@dataclass(frozen=True)
class _Built(Generic[P]):
    recoverer: Recoverer
    parameters: P
    weights: Hashable
    key: Hashable


class Engine(Generic[P]):
    """The recoverer at work; see the module.

    Parameters
    ----------
    factory
        What makes it.
    node
        Whose log hears of swaps.
    """

    def __init__(self, factory: RecovererFactory[P], node: Node) -> None:
        self._factory, self._node = factory, node
        self._lock = threading.Lock()
        self._built: _Built[P] | None = None
        self._request = 0
        self._is_to_read = False
        """Whether weights that were asked for have not been read yet."""
        self.is_making = False
        """Whether another one is being made."""
        self.fault = ""
        """Why the last swap came to nothing; empty once one has succeeded."""

    def build(self, parameters: P, camera: Camera) -> None:
        """Make the recoverer and warm it up; what the factory raises comes through."""
        with self._lock:
            self._request += 1
        built = self._made(parameters, camera, None)
        with self._lock:
            self._built, self.fault, self.is_making, self._is_to_read = built, "", False, False

    def release(self) -> None:
        """Let go of the recoverer, and of one that is being made."""
        with self._lock:
            self._request += 1
            self._built, self.fault, self.is_making = None, "", False

    def discard(self) -> None:
        """Let nobody else share the recoverer from now on: it has failed again and again."""
        built = self._built
        if built is not None:
            with _making:
                if _shared.get(built.key) is built.recoverer:
                    del _shared[built.key]

    def check(self, parameters: P, changed: frozenset[str]) -> None:
        """Raise ValueError for parameters that :meth:`follow` could not follow, as far as that can be told at once."""
        self._factory.check(parameters, changed, None if self._built is None else self._built.recoverer)

    def follow(self, parameters: P, changed: frozenset[str], camera: Camera) -> None:
        """Swap the recoverer where a parameter that it is made of has been set, in the background.

        A set that leaves the value as it is counts too: it is how a model file that was replaced is read again.
        """
        if not changed.intersection(self._factory.made_of) or self._built is None:
            return
        with self._lock:
            self._request += 1
            request = self._request
            self.is_making = True
            self._is_to_read = self._is_to_read or bool(changed.intersection(self._factory.read_by))
            kept = None if self._is_to_read else self._built
        threading.Thread(
            target=self._swap, args=(request, parameters, camera, kept), name="recoverer in the making", daemon=True
        ).start()

    def recover(self, frame: Frame, parameters: P) -> tuple[FrameRecovery, Hashable]:
        """The bodies of a frame by the parameters in force, and what tells their origin from another.

        Raises
        ------
        RuntimeError
            If there is none.
        """
        built = self._built
        if built is None:
            raise RuntimeError("the recoverer has been released")
        made_of = {name: getattr(built.parameters, name) for name in self._factory.made_of}
        in_force: Any = replace(parameters, **made_of)  # type: ignore[type-var]
        recovery = built.recoverer.recover(frame.depth, frame.camera, frame.labels, self._factory.options(in_force))
        return recovery, (built.weights, *(getattr(in_force, name) for name in self._factory.answers))

    @property
    def description(self) -> str:
        """What is at work, for diagnostics."""
        built = self._built
        if built is None:
            return "none"
        return self._factory.describe(built.parameters) + (", another one is being made" if self.is_making else "")

    def _swap(self, request: int, parameters: P, camera: Camera, kept: _Built[P] | None) -> None:
        started = perf_counter()
        described = self._factory.describe(parameters)
        try:
            built = self._made(parameters, camera, kept, lambda: request == self._request)
        except _Superseded:
            return
        except Exception as error:  # whatever it is: the old one goes on
            with self._lock:
                if request != self._request:
                    return
                self.is_making = False
                self.fault = f"cannot change to {described}: {' '.join(str(error).split())}"
            self._node.get_logger().error(f"{self.fault}; what was there before goes on")
            return
        with self._lock:
            if request != self._request:
                return
            self._built, self.fault, self.is_making, self._is_to_read = built, "", False, False
        self._node.get_logger().info(f"changed to {described} within {perf_counter() - started:.1f} s")

    def _made(
        self, parameters: P, camera: Camera, kept: _Built[P] | None, is_wanted: Callable[[], bool] = lambda: True
    ) -> _Built[P]:
        """A recoverer, warm, with the weights of ``kept`` if given; one that is there already if its key is the same.

        Raises
        ------
        _Superseded
            If nobody wants it any more.
        """
        weights = self._factory.weights(parameters) if kept is None else kept.weights
        others = (name for name in self._factory.made_of if name != "model")  # the same file may have several names
        key = None if weights is None else (weights, *(getattr(parameters, name) for name in others))
        with _making:
            if not is_wanted():
                raise _Superseded
            known = None if key is None else _shared.get(key)
            if known is not None:
                return _Built(known, parameters, weights, key)
            recoverer = self._factory.make(parameters, None if kept is None else kept.recoverer)
            if key is not None:
                _shared[key] = recoverer
        with TURNS.turn():
            if not is_wanted():
                raise _Superseded
            recoverer.warm_up(camera)
        return _Built(recoverer, parameters, weights, key)
