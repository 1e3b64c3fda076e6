"""The page of `recover --html`: whole in one file, bodies where they are, and words that cannot leave their place."""

from __future__ import annotations

import base64
import io
import json
import re

import numpy as np
import pytest
import trimesh
from browser import Browser, executable

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.recordings.frame_file import RecordedFrame
from sq_perception.recordings.still_page import StillPage
from sq_perception.recovery.recoverer import Recoverer

CAMERA = Camera(80, 60, 100.0, 100.0, 39.5, 29.5)
BODY = Superquadric([0.05, 0.04, 0.08], [0.2, 0.9], [0.01, 0.02, 0.7], [0.4, 0.2, 0.1, 0.8])
HOSTILE = "</script><img src=http://elsewhere/>.npz"


@pytest.fixture(scope="module")
def shot():
    depth, index = raycast.render(BODY, CAMERA)
    depth = np.where(np.isfinite(depth), depth, np.nan).astype(np.float32)
    return depth, Recoverer(method="symmetry").recover(depth, CAMERA, (index + 1).astype(np.int32))


@pytest.fixture
def page(tmp_path, shot):
    depth, recovery = shot
    page = StillPage(tmp_path / "out.html")
    for name in ("one", HOSTILE):
        page.add(RecordedFrame(depth, CAMERA, None, name), recovery)
    assert page.close() == tmp_path / "out.html"
    return tmp_path / "out.html"


def test_points_and_bodies_are_where_they_were_seen(page, shot):
    depth, recovery = shot
    pushed = re.findall(r"<script>frames\.push\((.*)\);</script>", page.read_text())
    assert len(pushed) == 2
    frame = json.loads(pushed[1])
    assert frame["name"] == f"1: {HOSTILE}"
    scene = trimesh.load_scene(io.BytesIO(base64.b64decode(frame["glb"])), file_type="glb")
    parts = {type(part): part for part in scene.dump()}
    turn = np.diag([1.0, -1.0, -1.0])
    body = recovery.bodies[0].superquadric
    np.testing.assert_allclose(parts[trimesh.Trimesh].bounds.mean(axis=0), turn @ body.translation, atol=2e-3)
    rows, columns = np.nonzero(np.isfinite(depth))
    seen = CAMERA.unproject(columns, rows, depth[rows, columns])
    np.testing.assert_allclose(
        np.sort(parts[trimesh.PointCloud].vertices @ turn, axis=0), np.sort(seen, axis=0), atol=1e-6
    )
    assert "full edges" in frame["numbers"]
    assert " mm (+-" in frame["numbers"]


def test_nothing_is_loaded_and_no_name_ends_the_script(page):
    text = page.read_text()
    assert HOSTILE not in text
    assert not re.search(r"<(script|link|img|iframe)[^>]*\s(src|href)=", text)


def test_a_covered_lens_is_a_frame_like_others(tmp_path):
    """Its GLB has a point, as none may be empty."""
    depth = np.full((60, 80), np.nan, np.float32)
    page = StillPage(tmp_path / "out.html")
    page.add(RecordedFrame(depth, CAMERA, None, "dark"), Recoverer(method="symmetry").recover(depth, CAMERA))
    assert page.close() == tmp_path / "out.html"
    assert "frames.push(" in (tmp_path / "out.html").read_text()


def test_no_page_without_a_frame(tmp_path):
    page = StillPage(tmp_path / "out.html")
    assert page.close() is None
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("room", [1000, 1_000_000])
def test_a_full_disk_keeps_nothing_of_a_page(tmp_path, shot, file_size_limit, room):
    """Which is found when the page is begun, or by a frame."""

    def write():
        page = StillPage(tmp_path / "out.html")
        try:
            for _ in range(30):
                page.add(RecordedFrame(shot[0], CAMERA, None, "one"), shot[1])
        finally:
            page.close(whole=False)

    with file_size_limit(room), pytest.raises(OSError, match=r"too large: '.*/out\.html'"):
        write()
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(executable() is None, reason="no Chromium or Chrome is installed")
def test_a_browser_draws_it(page):
    with Browser(640, 480) as browser:
        browser.open(page.as_uri())
        browser.until(lambda: "full edges" in browser.text())
        # The body in its blue, on white.
        browser.until(lambda: (browser.picture().astype(int)[..., 2] - browser.picture()[..., 0] > 60).sum() > 500)
        picture = browser.picture().astype(int)
        blue = picture[(picture[..., 2] - picture[..., 0] > 60) & (picture[..., 0] < 30)][:, 2]
        assert np.percentile(blue, 5) > 90, "no side is black"
        assert blue.max() < 255
        assert browser.requested() == [page.as_uri()]
