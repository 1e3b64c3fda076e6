"""``sq-perception view FRAME``: the page of ``view`` for recorded frames, which are recovered here; needs no ROS."""

from __future__ import annotations

import argparse
import queue
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NoReturn

from sq_perception.commands.console import FAILURE, SUCCESS, add_address, add_frames, complain, failed, parser

if TYPE_CHECKING:
    from sq_perception.recordings.frame_file import RecordedFrame
    from sq_perception.recovery.recovery import FrameRecovery
    from sq_perception.viewing.drawings import Bodies
    from sq_perception.viewing.page import Page

_HELP = """\
A page in the browser for recorded frames: depth as points, superquadrics with their uncertainty, numbers.  FRAME is
what `sq-perception recover` takes: an image, an NPZ, a cloud, a folder or a bag.  Everything comes from this machine.
"""
_SOURCE = "/recording"
_PREVIOUS, _NEXT = "previous", "next"
_KEPT = 20
"""Frames that one can go back to."""
_REDRAWN = 0.5
"""Seconds between two drawings, so that the boxes of the page take effect."""


def main(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception view FRAME``; the exit code."""
    command = parser("view", _HELP)
    add_frames(command)
    add_address(command)
    options = command.parse_args(arguments)
    try:
        from sq_perception.viewing import server
        from sq_perception.viewing.page import Page
    except ImportError as error:
        return failed(f"view needs the module {error.name!r}: pip install 'sq_perception[view]'")
    from sq_perception.recordings.frame_file import FrameError

    try:
        frames = _recovered(options)
        first = next(frames, None)
        if first is None:
            return FAILURE
        bound = server.listening_socket(options.host, options.port)
    except (FrameError, server.ServerError) as error:
        return failed(str(error))
    page = Page(bound, [_SOURCE], parameters=False)
    try:
        print(f"{server.url(bound)}; Ctrl-C ends", flush=True)
        _browse(page, first, frames)
    except KeyboardInterrupt:
        return SUCCESS
    finally:
        page.close()
        bound.close()


def _recovered(options: argparse.Namespace) -> Iterator[tuple[RecordedFrame, FrameRecovery]]:
    """The frames that can be read, one by one as they are asked for."""
    from sq_perception.recordings.bag_file import InputOptions
    from sq_perception.recordings.frame_file import FrameError, Reading
    from sq_perception.recordings.inputs import RecordedInput
    from sq_perception.recovery.recoverer import Recoverer, RecoveryOptions

    reading = Reading(options.depth_scale, ignore_masks=options.ignore_masks, kind=options.depth_kind)
    wanted = InputOptions(
        options.camera_info,
        options.projection,
        options.topic,
        options.every,
        reading=reading,
        camera_info_topic=options.camera_info_topic,
    )
    recorded = RecordedInput(options.frames, wanted)
    recoverer = Recoverer(method=options.method)
    for _, frame in recorded:
        if isinstance(frame, FrameError):
            complain(str(frame))
            continue
        for text in filter(None, (frame.warning, frame.notes)):
            complain(f"{frame.name}: {text}")
        print(f"recovering {frame.name}", flush=True)
        settings = RecoveryOptions(method=options.method, free_space=frame.has_free_space)
        try:
            recovery = recoverer.recover(frame.depth, frame.camera, frame.labels, settings)
        except (ValueError, ArithmeticError) as error:  # such as a camera of no image
            complain(f"{frame.name}: {error}")
            continue
        yield frame, recovery


def _browse(
    page: Page,
    first: tuple[RecordedFrame, FrameRecovery],
    frames: Iterator[tuple[RecordedFrame, FrameRecovery]],
) -> NoReturn:
    """Show frames by the buttons of the page; never returns."""
    clicks: queue.SimpleQueue[str] = queue.SimpleQueue()
    buttons = page.server.gui.add_button_group("Frame", (_PREVIOUS, _NEXT))
    buttons.on_click(lambda _: clicks.put(buttons.value))
    shown, at = [first], 0
    while True:
        _show(page, *shown[at])
        try:
            clicked = clicks.get(timeout=_REDRAWN)
        except queue.Empty:
            continue
        if clicked == _PREVIOUS:
            at = max(at - 1, 0)
        elif at + 1 < len(shown):
            at += 1
        elif (new := next(frames, None)) is not None:
            shown = [*shown, new][-_KEPT:]
            at = len(shown) - 1


def _show(page: Page, frame: RecordedFrame, recovery: FrameRecovery) -> None:
    from sq_perception.viewing import tables
    from sq_perception.viewing.tables import NodeState

    if not page.watched:
        return
    camera = frame.camera
    text = f"{frame.name}: {camera.width} x {camera.height}, {recovery.milliseconds['total']:.0f} ms"
    page.show_source(tables.answer(f"{text}; {recovery.message or frame.warning}".rstrip("; "), not frame.warning))
    page.show_depth(frame.depth, camera)
    page.show_bodies(bodies_of(recovery), NodeState(_SOURCE, age=0.0))


def bodies_of(recovery: FrameRecovery) -> Bodies:
    """What the page draws of a frame; ids are places in ``recovery.bodies``."""
    from sq_perception.recordings import publication

    ids = tuple(range(len(recovery.bodies)))
    array = publication.superquadric_array(publication.Identified(recovery, ids), is_cube=False)
    return publication.drawn(array, publication.superquadrics(array.recovered))
