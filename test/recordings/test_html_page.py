"""The page of `recover --html`: whole in one file, bodies where they are, and words that cannot leave their place."""

import base64
import json
import re

import numpy as np
import pytest
from browser import executable, opened

from sq_perception import Camera, RecordedFrame, Recoverer, Superquadric
from sq_perception.imaging import raycast
from sq_perception.recordings.html_page import HtmlPage

CAMERA = Camera(80, 60, 100.0, 100.0, 39.5, 29.5)
BODY = Superquadric([0.05, 0.04, 0.08], [0.2, 0.9], [0.01, 0.02, 0.7], [0.4, 0.2, 0.1, 0.8])
HOSTILE = "</script><img src=http://elsewhere/>.npz"
needs_browser = pytest.mark.skipif(executable() is None, reason="no Chromium or Chrome is installed")


@pytest.fixture(scope="module")
def shot():
    depth, index = raycast.render(BODY, CAMERA)
    depth = np.where(np.isfinite(depth), depth, np.nan).astype(np.float32)
    return depth, Recoverer(method="symmetry").recover(depth, CAMERA, (index + 1).astype(np.int32))


@pytest.fixture
def page(tmp_path, shot):
    depth, recovery = shot
    page = HtmlPage(tmp_path / "out.html")
    for name in ("one", HOSTILE):
        page.add(RecordedFrame(depth, CAMERA, None, name), recovery)
    assert page.close() == tmp_path / "out.html"
    return tmp_path / "out.html"


def frames(page):
    return [json.loads(text) for text in re.findall(r"<script>frames\.push\((.*)\);</script>", page.read_text())]


def steps(text):
    return np.frombuffer(base64.b64decode(text), "<u2")


def test_points_and_bodies_are_where_they_were_seen_and_nothing_else_may_be_loaded(page, shot):
    depth, recovery = shot
    first, frame = frames(page)
    assert (first["name"], frame["name"]) == ("0: one", f"1: {HOSTILE}")
    body = Superquadric(*(np.array(frame["bodies"][0][name]) for name in ("size", "shape", "translation", "rotation")))
    np.testing.assert_allclose(body.to_flat(), recovery.bodies[0].superquadric.to_flat())
    rows, columns = np.nonzero(np.isfinite(depth))
    seen = CAMERA.unproject(columns, rows, depth[rows, columns])
    points = frame["points"]
    at = points["low"] + np.array(points["step"]) * steps(points["steps"]).reshape(-1, 3)
    np.testing.assert_allclose(at, seen, atol=1e-5)
    assert (steps(points["bodies"]) == 1).all(), "every point is one of the body with number 0"
    assert frame["rows"][0][0] == "converged"
    assert " mm (+-" in frame["rows"][0][1]
    text = page.read_text()
    assert HOSTILE not in text
    assert "default-src 'none'" in text
    assert not re.search(r"<(script|link|img|iframe)[^>]*\s(src|href)=", text)


def test_a_covered_lens_is_a_frame_like_others_and_there_is_no_page_without_a_frame(tmp_path):
    assert HtmlPage(tmp_path / "out.html").close() is None
    assert not list(tmp_path.iterdir())
    depth = np.full((60, 80), np.nan, np.float32)
    page = HtmlPage(tmp_path / "out.html")
    page.add(RecordedFrame(depth, CAMERA, None, "dark"), Recoverer(method="symmetry").recover(depth, CAMERA))
    assert page.close() == tmp_path / "out.html"
    (frame,) = frames(tmp_path / "out.html")
    assert (frame["rows"], frame["bodies"], frame["points"]["steps"]) == ([], [], "")
    assert frame["remark"]


@pytest.mark.parametrize("room", [1000, 100_000])
def test_a_full_disk_keeps_nothing_of_a_page(tmp_path, shot, file_size_limit, room):
    """Which is found when the page is begun, or by a frame."""

    def write():
        page = HtmlPage(tmp_path / "out.html")
        try:
            for _ in range(30):
                page.add(RecordedFrame(shot[0], CAMERA, None, "one"), shot[1])
        finally:
            page.close(whole=False)

    with file_size_limit(room), pytest.raises(OSError, match=r"too large: '.*/out\.html'"):
        write()
    assert not list(tmp_path.iterdir())


def blue(picture):
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return np.nonzero((blue - red > 60) & (blue > green))


@needs_browser
def test_a_browser_draws_the_body_where_the_camera_saw_it(page, shot, tmp_path):
    """Seen from the camera, the body is at the same place of the picture as in the depth image."""
    hide = "id('points').checked = false; document.querySelector('[data-view=camera]').click();"
    hide += "id('labels').hidden = true; id('numbers').hidden = true; draw();"
    text, picture = opened(page, tmp_path, hide, (800, 600))
    assert "full edges" in text
    assert "drag: turn" in text
    assert HOSTILE in text
    rows, columns = blue(picture[60:])
    assert len(rows) > 2000
    v, u = np.nonzero(np.isfinite(shot[0]))
    height, width = picture[60:].shape[:2]
    scale = height / 60  # the height of the image fills that of the window
    assert (columns.mean() - width / 2) / scale == pytest.approx(u.mean() - 39.5, abs=1.5)
    assert (rows.mean() - height / 2) / scale == pytest.approx(v.mean() - 29.5, abs=1.5)
    assert len(rows) / scale**2 == pytest.approx(len(v), rel=0.15)


@needs_browser
def test_it_turns_and_zooms_under_the_pointer_and_goes_to_the_next_frame(page, tmp_path):
    drag = """
      const drag = (type, x, y) => canvas.dispatchEvent(
        new PointerEvent(type, { clientX: x, clientY: y, pointerId: 1, buttons: 1, bubbles: true }));
      canvas.setPointerCapture = () => {};
      const before = { ...eye };
      drag("pointerdown", 100, 100); drag("pointermove", 200, 130); drag("pointerup", 200, 130);
      canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: -500 }));
      const moved = eye.yaw !== before.yaw && eye.pitch !== before.pitch, nearer = eye.distance < before.distance;
      id("next").click();
      document.title = ""; id("how").textContent = `turned ${moved}, nearer ${nearer}, frame ${id("choice").value}`;
    """
    text, _ = opened(page, tmp_path, drag)
    assert "turned true, nearer true, frame 1" in text
