"""Frames from files: what is read is what was recorded, and what cannot be read says why."""

import re

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image

from sq_perception import Camera, Superquadric
from sq_perception.imaging import raycast, unit_cube
from sq_perception.imaging.distortion import Distortion
from sq_perception.imaging.rectification import Rectification
from sq_perception.recordings.camera_file import FrameError, Region, read_calibration, read_camera_info
from sq_perception.recordings.frame_file import Reading, read

K = np.array([[60.0, 0, 31.5], [0, 61.0, 23.5], [0, 0, 1]])


def camera_info(path, **changes):
    info = {"image_width": 64, "image_height": 48, "camera_name": "depth", "distortion_model": "plumb_bob"}
    info["camera_matrix"] = {"rows": 3, "cols": 3, "data": K.ravel().tolist()}
    info["distortion_coefficients"] = {"rows": 1, "cols": 5, "data": [0.0] * 5}
    info["rectification_matrix"] = {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()}
    info["projection_matrix"] = {"rows": 3, "cols": 4, "data": (K @ np.eye(3, 4)).ravel().tolist()}
    path.write_text(yaml.safe_dump({**info, **changes}))
    return path


@pytest.fixture
def info(tmp_path):
    return camera_info(tmp_path / "camera.yaml")


def save_npz(path, **fields):
    depth = np.full((48, 64), 0.8, np.float32)
    depth[0, 0], depth[0, 1], depth[0, 2] = np.nan, 0, np.inf
    np.savez(path, **{"depth": depth, "K": K, **fields})
    return path


def test_npz_with_labels(tmp_path):
    labels = np.zeros((48, 64), np.int16)
    labels[10:20, 10:20] = 7
    frame = read(save_npz(tmp_path / "frame.npz", labels=labels))
    assert frame.camera == Camera(64, 48, 60.0, 61.0, 31.5, 23.5)
    assert (frame.depth.dtype, frame.labels.dtype) == (np.float32, np.int32)
    assert np.isnan(frame.depth[0, :3]).all()
    assert (np.isfinite(frame.depth).sum(), set(np.unique(frame.labels))) == (48 * 64 - 3, {0, 7})
    assert frame.name == "frame.npz"
    assert not frame.is_cube


def test_a_printed_message_is_a_camera_info_too(tmp_path):
    path = tmp_path / "echo.yaml"
    message = {"width": 64, "height": 48, "d": [], "k": K.ravel().tolist(), "p": [0.0] * 12}
    path.write_text(yaml.safe_dump(message) + "---\n")
    assert read_calibration(path).camera == Camera(64, 48, 60.0, 61.0, 31.5, 23.5)
    part = {"x_offset": 10, "y_offset": 4, "width": 40, "height": 20, "do_rectify": True}
    path.write_text(yaml.safe_dump({**message, "roi": part, "binning_x": 2, "binning_y": 2}))
    assert read_camera_info(path).roi == Region(10, 4, 40, 20)
    assert read_calibration(path).camera == Camera(20, 10, 30.0, 30.5, 10.75, 9.75)


def test_a_distorted_image_is_rectified_unless_a_name_says_that_it_is(tmp_path, rng, monkeypatch):
    rectified = np.array([[55.0, 0, 30.0, 0], [0, 55.0, 22.0, 0], [0, 0, 1, 0]])
    changes = {"distortion_coefficients": {"data": [0.1, 0, 0, 0, 0]}, "projection_matrix": rectified.ravel().tolist()}
    info = camera_info(tmp_path / "c.yaml", **changes)
    image = rng.integers(1000, 1010, (48, 64)).astype(np.uint16)
    (tmp_path / "depth_rect").mkdir()
    for folder in (tmp_path, tmp_path / "depth_rect"):
        cv2.imwrite(str(folder / "1.png"), image)
    undone = Rectification(Camera(64, 48, 60.0, 61.0, 31.5, 23.5), Distortion("plumb_bob", (0.1, 0, 0, 0, 0)))
    for frame in (read(tmp_path / "1.png", info), read(tmp_path / "depth_rect" / "1.png", info, distortion="apply")):
        assert frame.camera == undone.camera
        np.testing.assert_array_equal(frame.depth, undone.there.depth(image / np.float32(1000)))
    for frame in (read(tmp_path / "depth_rect" / "1.png", info), read(tmp_path / "1.png", info, distortion="ignore")):
        assert frame.camera == Camera(64, 48, 55.0, 55.0, 30.0, 22.0)
        np.testing.assert_array_equal(frame.depth, image / np.float32(1000))
    monkeypatch.chdir(tmp_path / "depth_rect")
    assert read("1.png", info).camera == Camera(64, 48, 55.0, 55.0, 30.0, 22.0)
    with pytest.raises(ValueError, match="distortion: expected auto, apply, ignore"):
        read(tmp_path / "1.png", info, distortion="perhaps")
    camera_info(info, **changes, distortion_model="unified")
    with pytest.raises(FrameError, match=r"expected plumb_bob, .*, got 'unified' .*distortion = ignore"):
        read(tmp_path / "1.png", info)


@pytest.mark.parametrize("suffix", ["png", "bmp"])
def test_grey_images_are_views_of_the_cube(tmp_path, suffix):
    body = Superquadric([0.2, 0.15, 0.1], [0.5, 0.5], [0.5, 0.5, 0.5], [0.1, 0.2, 0.3, 0.9])
    depth, _ = raycast.render(unit_cube.optical_from_cube(body), unit_cube.camera(64))
    cv2.imwrite(str(tmp_path / f"view.{suffix}"), unit_cube.grey_from_depth(depth))
    frame = read(tmp_path / f"view.{suffix}", projection="orthographic")
    assert frame.is_cube
    assert frame.camera == unit_cube.camera(64)
    np.testing.assert_array_equal(np.isfinite(frame.depth), np.isfinite(depth))
    seen = np.isfinite(depth)
    assert np.abs(frame.depth[seen] - depth[seen]).max() <= 0.5 / 255 + 1e-6
    cv2.imwrite(str(tmp_path / "fine.png"), unit_cube.grey_from_depth(depth, np.uint16))
    found = read(tmp_path / "fine.png", projection="orthographic").depth
    np.testing.assert_allclose(found[seen], depth[seen], atol=1 / 65535)


def test_grey_saved_as_colour_is_accepted_and_colour_is_not(tmp_path):
    grey = np.zeros((16, 16, 3), np.uint8)
    grey[4:9, 4:9] = 100
    cv2.imwrite(str(tmp_path / "grey.png"), grey)
    assert np.isfinite(read(tmp_path / "grey.png", projection="orthographic").depth).sum() == 25
    grey[0, 0] = 1, 2, 3
    cv2.imwrite(str(tmp_path / "colour.png"), grey)
    with pytest.raises(FrameError, match="colour"):
        read(tmp_path / "colour.png", projection="orthographic")
    cv2.imwrite(str(tmp_path / "wide.png"), np.uint16([[[0, 0, 900]]]))
    with pytest.raises(FrameError, match="the camera's picture, or depth drawn in colours"):
        read(tmp_path / "wide.png", "60,61,0,0")


BAD_NPZ = {
    "no depth": (lambda p: np.savez(p, K=K), "field 'depth'"),
    "no K": (lambda p: np.savez(p, depth=np.ones((4, 4), np.float32)), "field 'K'"),
    "bytes": (lambda p: save_npz(p, depth=np.ones((48, 64), np.uint8)), "16 bit"),
    "a volume": (lambda p: save_npz(p, depth=np.ones((48, 64, 2))), "numbers"),
    "no pixel": (lambda p: save_npz(p, depth=np.ones((0, 64))), "numbers"),
    "zero K": (lambda p: save_npz(p, K=np.zeros((3, 3))), "positive"),
    "NaN K": (lambda p: save_npz(p, K=np.full((3, 3), np.nan)), "finite"),
    "text K": (lambda p: save_npz(p, K=np.full((3, 3), "x")), "K:"),
    "skewed K": (lambda p: save_npz(p, K=K + np.eye(3, k=1)), "skew"),
    "other labels": (lambda p: save_npz(p, labels=np.zeros((3, 3), np.int32)), "labels"),
    "float labels": (lambda p: save_npz(p, labels=np.zeros((48, 64))), "labels"),
    "labels that would become others": (lambda p: save_npz(p, labels=np.full((48, 64), 2**32 + 2)), "numbers below"),
    "transposed K": (lambda p: save_npz(p, K=K.T), "transposed"),
    "identity K": (lambda p: save_npz(p, K=np.eye(3)), "identity"),
    "truncated": (lambda p: p.write_bytes(save_npz(p).read_bytes()[:-600]), "readable NPZ"),
    "not a zip": (lambda p: p.write_bytes(b"not a zip"), "readable NPZ"),
    "empty": (lambda p: p.write_bytes(b""), "readable NPZ"),
}


@pytest.mark.parametrize("what", BAD_NPZ)
def test_bad_archives_are_named(tmp_path, what):
    make, reason = BAD_NPZ[what]
    path = tmp_path / "bad.npz"
    make(path)
    with pytest.raises(FrameError, match=reason) as caught:
        read(path)
    assert "bad.npz" in str(caught.value)


def test_bad_images_are_named(tmp_path, info):
    (tmp_path / "alone").mkdir()
    cv2.imwrite(str(tmp_path / "eight.png"), np.ones((48, 64), np.uint8))
    cv2.imwrite(str(tmp_path / "alone" / "depth.png"), np.ones((48, 64), np.uint16))
    cv2.imwrite(str(tmp_path / "other.png"), np.ones((10, 10), np.uint16))
    (tmp_path / "no.png").write_bytes(b"\x89PNG nothing")
    (tmp_path / "empty.bmp").touch()
    cv2.imwrite(str(tmp_path / "dot.png"), np.ones((1, 1), np.uint8))
    for name, given, words in (
        ("eight.png", {"camera_info": info}, "orthographic"),
        ("alone/depth.png", {}, "camera_info"),
        ("other.png", {"camera_info": info}, "does not fit"),
        ("no.png", {"camera_info": info}, "readable image"),
        ("empty.bmp", {"projection": "orthographic"}, "readable image"),
        ("dot.png", {"projection": "orthographic"}, "at least 2 x 2"),
        ("missing.npz", {}, "no such file"),
        (".", {}, "no such file"),
    ):
        with pytest.raises(FrameError, match=words):
            read(tmp_path / name, **given)


@pytest.mark.parametrize("error", [PermissionError(13, "Permission denied"), MemoryError("Unable to allocate 1 TiB")])
def test_what_the_system_refuses_is_named(tmp_path, info, monkeypatch, error):
    """A mask too, also that of a bag's frame: one unreadable file must not end the whole run."""
    cv2.imwrite(str(tmp_path / "depth.png"), np.ones((48, 64), np.uint16))
    masks = Reading(masks=tmp_path)
    assert masks.labels("depth", np.ones((48, 64))).all()

    def refused(*_, **__):
        raise error

    monkeypatch.setattr(Image, "open", refused)
    with pytest.raises(FrameError, match=re.escape(str(error))):
        read(tmp_path / "depth.png", info)
    if isinstance(error, OSError):
        with pytest.raises(FrameError, match=re.escape(str(error))):
            masks.labels("depth", np.ones((48, 64)))


def test_names_that_no_file_can_have_are_named(tmp_path):
    with pytest.raises(FrameError, match=r"aaa\.npz"):
        read(tmp_path / f"{'a' * 300}.npz")
    cv2.imwrite(str(tmp_path / "depth.png"), np.ones((48, 64), np.uint16))
    with pytest.raises(FrameError, match="camera_info"):
        read(tmp_path / "depth.png", "a" * 300)
    numbers = ",".join(f"{number:.90f}" for number in (60.0, 61.0, 31.5, 23.5))
    assert read(tmp_path / "depth.png", numbers).camera == Camera(64, 48, 60.0, 61.0, 31.5, 23.5)
    (tmp_path / "depth.txt").write_text("1 2 3")
    with pytest.raises(FrameError, match=r"\.npz, \.npy, \.png, \.bmp"):
        read(tmp_path / "depth.txt")
    with pytest.raises(ValueError, match="projection"):
        read(tmp_path / "eight.png", projection="fisheye")
