"""sq-perception view FRAME: recorded frames on the page, one after the other, without ROS."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sq_perception.commands import main, view_recording
from sq_perception.fitting.fit import Status
from sq_perception.geometry.mesh import COLOURS
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.recordings.frame_file import RecordedFrame
from sq_perception.recovery.recoverer import Recoverer

CAMERA = Camera(80, 60, 100.0, 100.0, 39.5, 29.5)
BODIES = Superquadric(
    [[0.05, 0.04, 0.05], [0.04, 0.03, 0.05]],
    [[0.2, 0.9], [0.5, 1.0]],
    [[-0.12, 0.0, 0.7], [0.12, 0.0, 0.7]],
    [[0.4, 0.2, 0.1, 0.8], [0.7, 0.1, 0.3, 0.6]],
)


@pytest.fixture(scope="module")
def shot():
    depth, index = raycast.render(BODIES, CAMERA)
    depth = np.where(np.isfinite(depth), depth, np.nan).astype(np.float32)
    recovery = Recoverer(method="symmetry").recover(depth, CAMERA, (index + 1).astype(np.int32))
    return RecordedFrame(depth, CAMERA, None, "a"), recovery


def test_what_is_drawn_keeps_its_place_among_the_bodies(shot):
    _, recovery = shot
    first, second = recovery.bodies
    lost = replace(first, fit=replace(first.fit, status=Status.FAILED))
    bodies = view_recording.bodies_of(replace(recovery, bodies=(lost, second)))
    assert (list(bodies.ids), list(bodies.failed)) == ([1], [0])
    np.testing.assert_array_equal(bodies.colours, COLOURS[1:2])
    np.testing.assert_array_equal(bodies.superquadrics.size[0], second.superquadric.size.astype(np.float32))
    assert len(view_recording.bodies_of(replace(recovery, bodies=()))) == 0


def test_frames_are_turned_over_and_recovered_once(shot):
    """Next, next beyond the end, previous, previous beyond the beginning, next."""
    frame, recovery = shot
    shown, asked = [], []
    wishes = iter(["next", "next", "previous", "previous", "next"])
    buttons = SimpleNamespace(value="", on_click=lambda callback: setattr(buttons, "callback", callback))

    def show_source(text):
        shown.append(text.partition(": 80")[0][-1])
        buttons.value = next(wishes, None)
        if buttons.value is None:
            raise KeyboardInterrupt
        buttons.callback(None)

    page = SimpleNamespace(
        watched=True,
        server=SimpleNamespace(gui=SimpleNamespace(add_button_group=lambda *_: buttons)),
        show_source=show_source,
        show_depth=lambda depth, camera: None,
        show_bodies=lambda bodies, state: None,
    )

    def rest():
        asked.append("b")
        yield replace(frame, name="b"), recovery

    with pytest.raises(KeyboardInterrupt):
        view_recording._browse(page, (frame, recovery), rest())
    assert shown == ["a", "b", "b", "a", "a", "b"]
    assert asked == ["b"]


def test_what_one_waits_for_is_said(tmp_path, shot, capsys):
    frame, _ = shot
    np.savez(tmp_path / "a.npz", depth=frame.depth, K=CAMERA.matrix)
    given = {"frames": [str(tmp_path / "a.npz")] * 2, "method": "symmetry", "projection": "pinhole", "every": 1}
    options = SimpleNamespace(**given, camera_info=None, topic=None, ignore_masks=True)
    frames = view_recording._recovered(options)
    assert not capsys.readouterr().out
    next(frames)
    assert capsys.readouterr().out == "recovering a.npz\n"


def test_a_frame_that_cannot_be_recovered_is_passed_over(tmp_path, shot, capsys, monkeypatch):
    frame, recovery = shot
    np.savez(tmp_path / "a.npz", depth=frame.depth, K=CAMERA.matrix)
    answers = iter([ValueError("expected finite numbers"), recovery])

    def recover(*_, **__):
        if isinstance(answer := next(answers), Exception):
            raise answer
        return answer

    monkeypatch.setattr(Recoverer, "recover", recover)
    given = {"frames": [str(tmp_path / "a.npz")] * 2, "method": "symmetry", "projection": "pinhole", "every": 1}
    options = SimpleNamespace(**given, camera_info=None, topic=None, ignore_masks=True)
    assert [found for _, found in view_recording._recovered(options)] == [recovery]
    assert "a.npz: expected finite numbers" in capsys.readouterr().err


def test_nothing_to_show_ends_at_once(tmp_path, capsys):
    pytest.importorskip("viser", reason="needs the extra 'view'")
    assert main.main(["view", str(tmp_path / "none.npz"), "--method", "symmetry"]) == 1
    assert "no such file" in capsys.readouterr().err


@pytest.mark.parametrize("given", [["none.npz"], []])
def test_no_other_port_is_taken_than_the_one_that_was_asked_for(given, capsys):
    """The system takes 65537 for 1."""
    assert main.main(["view", *given, "--port", "65537"]) == 2
    assert "--port: expected 0 to 65535, got 65537" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("host", "shown"), [("127.0.0.1", "127.0.0.1"), ("192.0.2.1", "192.0.2.1"), ("::1", "[::1]"), ("::", "localhost")]
)
def test_the_address_that_is_printed_can_be_opened(host, shown):
    pytest.importorskip("viser", reason="needs the extra 'view'")
    from sq_perception.viewing import server

    assert server.url(SimpleNamespace(getsockname=lambda: (host, 8080))) == f"http://{shown}:8080"


@pytest.mark.parametrize(
    "given", [["none.npz", "--port", "0"], ["--port", "0", "none.npz"], ["--projection", "orthographic", "none.npz"]]
)
def test_frames_may_come_after_the_options(given, monkeypatch):
    seen = []
    monkeypatch.setattr(view_recording, "main", lambda arguments: seen.append(arguments) or 0)
    assert main.main(["view", *given]) == 0
    assert seen == [given]
