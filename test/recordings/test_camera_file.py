"""One camera, as the tools of many write it, and what is said where it is not all there."""

import json

import cv2
import numpy as np
import pytest

import sq_perception as sq
from sq_perception.imaging.camera import Camera
from sq_perception.recordings.camera_file import FrameError, read_calibration, read_camera_info
from sq_perception.recordings.frame_file import Reading

CAMERA = Camera(64, 48, 60.0, 61.0, 31.5, 23.5)
SIZE = (64, 48)
K = CAMERA.matrix
ROWS, COLUMNS = K.ravel().tolist(), K.T.ravel().tolist()
REALSENSE = {"width": 64, "height": 48, "fx": 60, "fy": 61, "ppx": 31.5, "ppy": 23.5}
FORMS = {
    "opencv.yml": "%YAML:1.0\n---\nimage_width: 64\nimage_height: 48\ncamera_matrix: !!opencv-matrix\n   rows: 3\n"
    f"   cols: 3\n   dt: d\n   data: {ROWS}\ndistortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n"
    "   dt: d\n   data: [ 0., 0., 0., 0., 0. ]\n",
    "bare.yaml": f"%YAML:1.0\nK: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: f\n   data: {ROWS}\n",
    "orbslam.yaml": "%YAML:1.0\nCamera.type: PinHole\nCamera.fx: 60.0\nCamera.fy: 61.0\nCamera.cx: 31.5\n"
    "Camera.cy: 23.5\nCamera.k1: 0.0\nCamera.width: 64\nCamera.height: 48\nCamera.fps: 30.0\n",
    "orbslam3.yaml": "%YAML:1.0\nCamera1.fx: 60.0\nCamera1.fy: 61.0\nCamera1.cx: 31.5\nCamera1.cy: 23.5\n",
    "kalibr.yaml": "cam0:\n  camera_model: pinhole\n  intrinsics: [60.0, 61.0, 31.5, 23.5]\n"
    "  distortion_model: radtan\n  distortion_coeffs: [0, 0, 0, 0]\n  resolution: [64, 48]\n",
    "scene_camera.json": json.dumps({"3": {"cam_K": ROWS, "depth_scale": 0.1}, "4": {"cam_K": ROWS, "depth_scale": 1}}),
    "a.intr": json.dumps({"_fx": 60, "_fy": 61, "_cx": 31.5, "_cy": 23.5, "_width": 64, "_height": 48, "_K": 0}),
    "record3d.json": json.dumps({"w": 64, "h": 48, "K": COLUMNS, "fps": 30}),
    "transforms.json": json.dumps({"fl_x": 60, "fl_y": 61, "cx": 31.5, "cy": 23.5, "w": 64.0, "h": 48, "frames": []}),
    "cameras.txt": "# Camera list\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 PINHOLE 64 48 60 61 31.5 23.5\n",
    "two.txt": "1 PINHOLE 640 480 600 600 320 240\n2 OPENCV 64 48 60.0 61.0 31.5 23.5 0 0 0 0\n",
    "four.txt": "60.0 61.0 31.5 23.5\n",
    "four.csv": "60.0,61.0,31.5,23.5",
    "nine.txt": " ".join(map(str, ROWS)),
    "lines.txt": "60 0 31.5\n0 61 23.5\n0 0 1\n",
    "plain.yaml": "fx: 60\nfy: 61\ncx: 31.5\ncy: 23.5\n",
    "one_scene.json": json.dumps({"cam_K": ROWS}),
    "scaled.json": json.dumps({"fx": 60, "fy": 61, "cx": 31.5, "cy": 23.5, "depth_scale": 1.0}),
    "sixteen.csv": "60,0,31.5,0\n0,61,23.5,0\n0,0,1,0\n0,0,0,1\n",
    "scannet.txt": "fx_color = 1170.1\nfy_color = 1170.1\nmx_color = 647.7\ncolorWidth = 1296\ncolorHeight = 968\n"
    "depthWidth = 64\ndepthHeight = 48\nm_calibrationColorIntrinsic = 1170 0 647 0 0 1170 483 0 0 0 1 0 0 0 0 1\n"
    "m_calibrationDepthIntrinsic = 60 0 31.5 0 0 61 23.5 0 0 0 1 0 0 0 0 1\n",
    "rs.txt": 'Device info:\n  Name: Intel RealSense D435\n  Intrinsic of "Depth" / 640x480 / {Z16}\n  Width:\t640\n'
    "  Height:\t480\n  PPX:\t315\n  PPY:\t235\n  Fx:\t600\n  Fy:\t600\n  Distortion:\tBrown Conrady\n"
    "  Coeffs:\t0 \t0 \t0 \t0 \t0\n"
    '  Intrinsic of "Depth" / 64x48 / {Z16}\n  Width:\t64\n  Height:\t48\n  PPX:\t31.5\n  PPY:\t23.5\n  Fx:\t60\n'
    "  Fy:\t61\n  Distortion:\tBrown Conrady\n  Coeffs:\t0 \t0 \t0 \t0 \t0\n",
    "librealsense.json": json.dumps({**REALSENSE, "model": "Brown Conrady", "coeffs": [0, 0, 0, 0, 0]}),
    "undistorted.json": json.dumps({**REALSENSE, "model": "distortion.none"}),
    "open3d.json": json.dumps({"width": 64, "height": 48, "intrinsic_matrix": COLUMNS}),
    "camera_info.json": json.dumps({"width": 64, "height": 48, "k": ROWS}),
    "both.json": json.dumps({"color": {"fx": 9, "fy": 9, "cx": 3, "cy": 2}, "depth": {"intrinsics": ROWS}}),
    "nested.json": json.dumps({"device": "x", "camera": {"intrinsic_matrix": K.tolist(), "image_size": [64, 48]}}),
    "fx_depth.yaml": "fx_depth: 60\nfy_depth: 61\ncx_depth: 31.5\ncy_depth: 23.5\nfx_rgb: 9\nfy_rgb: 9\ncx_rgb: 1\n"
    "cy_rgb: 1\n",
}


@pytest.mark.parametrize("name", FORMS)
def test_every_form_is_the_same_camera(tmp_path, name):
    path = tmp_path / name
    path.write_text(FORMS[name])
    info = read_camera_info(path, SIZE, "000003")
    assert read_calibration(path, size=SIZE).camera == CAMERA if name != "scene_camera.json" else info.unit.scale == 1e4
    assert (info.width, info.height, info.k) == (64, 48, tuple(ROWS))


@pytest.mark.parametrize("names", [{"K": K}, {"mtx": K, "dist": np.zeros((1, 5))}, {"camera_matrix": K, "x": "text"}])
def test_an_archive_is_the_same_camera(tmp_path, names):
    np.savez(tmp_path / "camera.npz", **names)
    assert read_calibration(tmp_path / "camera.npz", size=SIZE).camera == CAMERA


def test_distortion_comes_along_and_three_numbers_are_no_camera(tmp_path):
    with pytest.raises(FrameError, match="expected four numbers, fx,fy,cx,cy, got 3"):
        read_calibration("60,61,31.5", size=SIZE)
    path = tmp_path / "cam.yaml"
    path.write_text("Camera.fx: 60\nCamera.fy: 61\nCamera.cx: 31.5\nCamera.cy: 23.5\nCamera.k1: 0.1\nCamera.p2: 0.01\n")
    assert read_camera_info(path, SIZE).d[:4] == (0.1, 0, 0, 0.01)
    path.write_text("1 OPENCV_FISHEYE 64 48 60 61 31.5 23.5 0.1 0.2 0.3 0.4\n")
    info = read_camera_info(path, SIZE)
    assert (info.distortion_model, info.d) == ("equidistant", (0.1, 0.2, 0.3, 0.4))


WRONG = {
    "camera.txt": [
        ('{"fx": 60, "fy": 61, "cx": 31.5}', "expected cy .* beside fx, fy, cx"),
        ('{"K": [1, 0, 0, 0, 1, 0, 0, 0, 1]}', "identity"),
        ('{"fx": 0.9, "fy": 0.9, "cx": 0.5, "cy": 0.5}', "divided by the size of the image"),
        ('{"a": {"fx": 60, "fy": 61, "cx": 1, "cy": 1}, "b": {"fx": 70, "fy": 71, "cx": 1, "cy": 1}}', "got 2: a, b"),
        ("1 FOV 64 48 1 2 3 4 5", "expected a model of SIMPLE_PINHOLE"),
    ],
    "camera.json": [
        ("[" * 100_000, "not JSON"),
        ("[1]", "3 x 3"),
        ('{"ppx": 1, "ppy": 2}', "expected fx, fy .* beside cx, cy"),
        (json.dumps({**REALSENSE, "model": "F-Theta"}), "F-Theta"),
        (json.dumps({**REALSENSE, "fx": 10**400}), "expected numbers"),
        ('{"k": [60, 0, 31.5, 0, 61, 23.5, 1, 0, 1]}', "0 0 1 in its last row"),
    ],
    "info.yaml": [
        ("", "mapping"),
        ("[1, 2", "four numbers"),
        ("{1, 2", "not YAML"),
        ("just text", "mapping"),
        ("!!python/object/apply:os.system ['true']", "not YAML"),
        ("{image_width: 64, k: [9, 0, 0, 0, 9, 0, 0, 0, 1]}", "image_height"),
        ("{image_width: wide, image_height: 48, k: [9, 0, 0, 0, 9, 0, 0, 0, 1]}", "positive integer"),
        ("{image_width: 64, image_height: 48}", "camera_matrix"),
        ("{image_width: 64, image_height: 48, k: [1, 2]}", "4 or 9 or 12 or 16 finite numbers"),
        ("{image_width: 64, image_height: 48, k: [a, b]}", "expected numbers"),
        ("{width: 64, height: 48, k: [0, 0, 0, 0, 0, 0, 0, 0, 0]}", "above 0"),
        ("{width: 64, height: 48, k: [9, 1, 0, 0, 9, 0, 0, 0, 1]}", "no skew"),
        ("{width: 64, height: 48, k: [9, 0, 0, 0, 9, 0, 0, 0, 1], binning_x: -1}", "binning_x"),
        ("{width: 64, height: 48, k: [9, 0, 0, 0, 9, 0, 0, 0, 1], roi: {x_offset: a}}", "x_offset"),
        ("{width: 64, height: 48, k: [9, 0, 0, 0, 9, 0, 0, 0, 1], roi: 3}", "roi"),
        ("{width: 64, height: 48, k: [9, 0, 0, 0, 9, 0, 0, 0, 1], d: [.nan]}", "finite"),
    ],
}


@pytest.mark.parametrize(
    ("name", "text", "said"), [(name, *case) for name in WRONG for case in WRONG[name]], ids=lambda word: word[:30]
)
def test_what_is_no_camera_is_named(tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    with pytest.raises(FrameError, match=said):
        read_calibration(tmp_path / name, size=SIZE)


def scene(folder, scale):
    """A scene of BOP: 0.8 m in the units of each image."""
    (folder / "depth").mkdir(parents=True)
    cameras = {}
    for number, unit in enumerate(scale):
        image = np.full((48, 64), round(800 / unit), np.uint16)
        cv2.imwrite(str(folder / "depth" / f"{number:06d}.png"), image)
        cameras[str(number)] = {"cam_K": [60 + number, *ROWS[1:]], "depth_scale": unit}
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    return folder / "depth"


def test_the_camera_and_unit_of_each_image_of_a_scene_are_found_and_used(tmp_path):
    folder = scene(tmp_path / "scene", [0.1, 1.0])
    for number, unit in enumerate((10000, 1000)):
        frame = sq.read_frame(folder / f"{number:06d}.png")
        assert (frame.depth[0, 0], frame.camera.fx) == (pytest.approx(0.8), 60 + number)
        assert f"{unit} units are a metre: scene_camera.json: depth_scale" in frame.notes
    given = sq.read_frame(folder / "000000.png", reading=Reading(scale=1000.0))
    assert given.depth[0, 0] == pytest.approx(8.0)
    assert not given.notes
    with pytest.raises(FrameError, match="no camera for image 7"):
        read_camera_info(tmp_path / "scene" / "scene_camera.json", SIZE, "7")


@pytest.mark.parametrize("name", ["a.png", "a.tiff", "a.npy"])
def test_a_stated_unit_holds_for_every_kind_of_file(tmp_path, name):
    image = np.full((48, 64), 6400, np.uint16)
    np.save(tmp_path / name, image) if name == "a.npy" else cv2.imwrite(str(tmp_path / name), image)
    intrinsics = {"fx": 60, "fy": 61, "ppx": 31.5, "ppy": 23.5, "depth_scale": 0.00012498664727900177}
    (tmp_path / "intrinsics.json").write_text(json.dumps(intrinsics))
    frame = sq.read_frame(tmp_path / name)
    assert (frame.camera, frame.depth[0, 0]) == (CAMERA, pytest.approx(0.8, abs=1e-3))
    assert "metres a unit" in frame.notes


def test_an_archive_may_hold_whole_numbers_and_their_unit(tmp_path):
    numbers = np.full((48, 64), 8000, np.uint16)
    np.savez(tmp_path / "a.npz", depth=numbers, K=K, depth_scale=0.1)
    np.savez(tmp_path / "b.npz", depth=numbers, K=K)
    assert sq.read_frame(tmp_path / "a.npz").depth[0, 0] == pytest.approx(0.8)
    assert sq.read_frame(tmp_path / "b.npz").depth[0, 0] == pytest.approx(8.0)
