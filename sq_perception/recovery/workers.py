"""Recover frames in several processes and return the results in order; and many images of one object each.

Each process has a Recoverer with one thread, and a few frames under way, which bounds memory.  If a process dies
(killed, or out of memory), another one starts and its frame is tried again, a few times.  Each has a pipe of its own:
those of :class:`concurrent.futures.ProcessPoolExecutor` share one, and wait for ever if one is killed while it writes.
"""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TypeAlias, TypeVar, cast

import numpy as np

from sq_perception.imaging.camera import Camera
from sq_perception.recovery.options import Method, RecoveryOptions
from sq_perception.recovery.recovery import FrameRecovery, Recovery

_Key = TypeVar("_Key")
_Answer: TypeAlias = "Future[FrameRecovery | None]"


@dataclass(frozen=True, eq=False)
class Work:
    """What :meth:`Recoverer.recover` is called with: shapes and units are given there."""

    depth: np.ndarray
    camera: Camera
    labels: np.ndarray | None
    options: RecoveryOptions


class _LostError(RuntimeError):
    """A process died before it answered."""


class WorkerLostError(RuntimeError):
    """The processes that worked on a frame died, again and again."""


def recover_all(
    frames: Iterable[tuple[_Key, Work | None]], executor: Processes
) -> Iterator[tuple[_Key, FrameRecovery | Exception | None]]:
    """The key of each frame, in their order, with its recovery or the exception that it raised, None for no work.  An
    answer may be a :class:`WorkerLostError`.  The executor is shut down in the end."""
    under_way: deque[tuple[_Key, Work | None, _Answer]] = deque()

    def begun(work: Work | None) -> _Answer:
        if work is not None:
            return executor.ask(work)
        answer: _Answer = Future()
        answer.set_result(None)
        return answer

    def first() -> tuple[_Key, FrameRecovery | Exception | None]:
        key, work, answer = under_way.popleft()
        deaths = 0
        while True:
            try:
                return key, _unpack(answer.result())
            except _LostError:
                deaths += 1
                if deaths == 3:  # one may be an operator's, or another frame's memory
                    return key, WorkerLostError("the process that recovered it died, again and again")
                answer = begun(work)
            except Exception as error:  # whatever it raised there is for the caller
                return key, error

    try:
        for key, work in frames:
            under_way.append((key, work, begun(work)))
            # For each process the frame it works on, one that waits for it, and one whose answer waits.
            while under_way and (len(under_way) >= 3 * executor.size or under_way[0][2].done()):
                yield first()
        while under_way:
            yield first()
    finally:
        executor.end()


def recover_crops(
    depths: Sequence[np.ndarray], cameras: Camera | Sequence[Camera], masks: Sequence[np.ndarray] | None = None,
    options: RecoveryOptions | None = None, jobs: int = 1,
) -> list[Recovery | None]:
    """Recover the one object of each of n images.

    Parameters
    ----------
    depths : n of float (height, width)
        Metres in the optical frame, NaN for nothing; they may differ in size.
    cameras
        One for all or one each; of a crop :meth:`Camera.cropped`.
    masks : n of bool (height, width), optional
        Where the object is; by default wherever something was measured, as in images with all else removed.
    options
        As of :meth:`Recoverer.recover`.
    jobs
        Processes that share the images.  More than one pays from some hundred images on, as each takes seconds to
        start; a script that asks for them begins below ``if __name__ == "__main__":``.

    Returns
    -------
    list of n
        None where the mask holds no reading.

    Raises
    ------
    ValueError
        If there is not one camera and one mask an image, or one does not fit its image.
    """
    count = len(depths)
    each = [cameras] * count if isinstance(cameras, Camera) else list(cameras)
    shown = [np.isfinite(depth) for depth in depths] if masks is None else list(masks)
    if (len(each), len(shown)) != (count, count):
        raise ValueError(f"expected a camera and a mask for each of {count} images, got {len(each)} and {len(shown)}")
    settings = options or RecoveryOptions()
    works = [
        Work(depth, camera, np.asarray(mask, bool).astype(np.int32), settings)
        for depth, camera, mask in zip(depths, each, shown, strict=True)
    ]
    if jobs > 1:
        answers = [answer for _, answer in recover_all(enumerate(works), Processes(None, settings.method, jobs))]
    else:
        from sq_perception.recovery.recoverer import Recoverer  # here: a process that only shares work needs none

        recoverer = Recoverer(method=settings.method)
        answers = [recoverer.recover(work.depth, work.camera, work.labels, settings) for work in works]
    found: list[Recovery | None] = []
    for answer in answers:
        if isinstance(answer, Exception):
            raise answer
        found.append(answer.bodies[0] if answer is not None and answer.bodies else None)
    return found


class Processes:
    """``size`` processes, each asked by a thread of its own; another one begins where one died."""

    def __init__(self, model: Path | str | None, method: Method, size: int) -> None:
        self._model, self._method, self.size = model, method, size
        self._threads, self._lock = ThreadPoolExecutor(size), threading.Lock()
        self._of_thread: dict[int, tuple[BaseProcess, Connection]] = {}
        self._ended = False

    def ask(self, work: Work) -> _Answer:
        return self._threads.submit(self._answer, work)

    def end(self) -> None:
        with self._lock:
            self._ended = True
            asked = list(self._of_thread.values())
            for process, _ in asked:
                process.terminate()
        self._threads.shutdown(cancel_futures=True)
        for process, pipe in asked:
            process.join()
            pipe.close()

    def _answer(self, work: Work) -> FrameRecovery:
        thread = threading.get_ident()
        with self._lock:
            if self._ended:
                raise _LostError
            if thread not in self._of_thread:
                self._of_thread[thread] = _start(self._model, self._method)
            process, pipe = self._of_thread[thread]
        try:
            pipe.send(work)
            answer = pipe.recv()
        except (EOFError, OSError) as error:
            with self._lock:
                del self._of_thread[thread]
            pipe.close()
            process.join()
            raise _LostError from error
        if isinstance(answer, Exception):
            raise answer
        return cast(FrameRecovery, answer)


def _start(model: Path | str | None, method: Method) -> tuple[BaseProcess, Connection]:
    """A process, and this end of its pipe; Ctrl-C is for the one that asks."""
    # Not forked: a process that has threads of BLAS and numba cannot be copied.
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(model, method, there), daemon=True)
    resource_tracker.ensure_running()  # whose start would let the signal through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # the process inherits it, and has it at once
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    there.close()  # so that its end is that of the pipe
    return process, here


def _serve(model: Path | str | None, method: Method, pipe: Connection) -> None:
    """What a process does until the other end of its pipe is closed."""
    import cv2

    from sq_perception.recovery.recoverer import Recoverer

    cv2.setNumThreads(1)  # its threads spin while they wait, on the cores of the other processes
    recoverer: Recoverer | None = None
    while True:
        try:
            work = pipe.recv()
        except EOFError:
            return
        try:
            recoverer = recoverer or Recoverer(model, method=method, threads=1)
            answer: FrameRecovery | Exception = _pack(
                recoverer.recover(work.depth, work.camera, work.labels, work.options)
            )
        except Exception as error:  # the answer to this frame; who asked raises it
            answer = error
        pipe.send(answer)


def _pack(found: FrameRecovery) -> FrameRecovery:
    """A recovery as it is sent: labels in as few bytes as they need."""
    labels = found.labels.astype(np.min_scalar_type(found.labels.max(initial=0)))
    return replace(found, labels=labels)


def _unpack(found: FrameRecovery | None) -> FrameRecovery | None:
    return None if found is None else replace(found, labels=found.labels.astype(np.int32))
