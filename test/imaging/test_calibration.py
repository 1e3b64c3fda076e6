"""camera_infos by hand, in every form that drivers send them, and what is made of their images."""

from dataclasses import replace

import numpy as np
import pytest
from distorted_views import share_seen

from sq_msgs_py import depth_image
from sq_msgs_py.depth_image import Intrinsics, RawIntrinsics, size_mismatch
from sq_perception.imaging.calibration import Calibration, is_rectified_name
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.distortion import Distortion
from sq_perception.imaging.rectification import Rectification
from sq_perception.recordings.camera_file import CameraInfo, Region

K = (500.0, 0.0, 321.0, 0.0, 502.0, 243.0, 0.0, 0.0, 1.0)
P = (450.0, 0.0, 315.0, 0.0, 0.0, 451.0, 238.0, 0.0, 0.0, 0.0, 1.0, 0.0)
D = (-0.2, 0.05, 0.001, -0.001, 0.0)
INFO = CameraInfo(640, 480, "plumb_bob", D, K, P, 0, 0, Region())
LENS = Distortion("plumb_bob", D)
RAW = Camera(640, 480, 500.0, 502.0, 321.0, 243.0)
RECTIFIED = Camera(640, 480, 450.0, 451.0, 315.0, 238.0)
NO_K, NO_P = (0.0,) * 9, (0.0,) * 12


RECTIFIED_NAMES = (
    *("/camera/camera/depth/image_rect_raw", "/camera/depth/image_rect", "recordings/depth-rect/0001"),
    *("/depth_registered/image_rect", "/camera/rect/image", "/camera/depth/rectified", "/camera/depth/Image_RECT"),
    "/camera/depth/image_rect/compressedDepth",
)
OTHER_NAMES = (
    *("/camera/depth/image_raw", "/camera/depth/image_raw/compressedDepth", "/direct/image", "/depth/image", ""),
    *("/camera/aligned_depth_to_color/image_raw", "/camera/depth_registered/image_raw", "/rectangles/image"),
    *("/camera/unrectified/image", "/rect/camera/depth/image"),
)


@pytest.mark.parametrize("name", RECTIFIED_NAMES + OTHER_NAMES)
def test_some_names_say_that_images_are_rectified(name):
    assert is_rectified_name(name) == (name in RECTIFIED_NAMES)


@pytest.mark.parametrize(
    ("changes", "name", "distortion", "raw", "camera"),
    [
        ({}, "/depth/image_raw", "auto", True, RAW),
        ({}, "/depth/image_rect", "auto", False, RECTIFIED),
        ({}, "/depth/image_rect", "apply", True, RAW),
        ({}, "/depth/image_raw", "ignore", False, RECTIFIED),
        ({"p": NO_P}, "/depth/image_raw", "auto", True, RAW),
        ({"p": NO_P}, "/depth/image_rect", "auto", False, RAW),
        ({"k": NO_K}, "/depth/image_rect", "auto", False, RECTIFIED),
        # No distortion: P, as ever; but of an image that is said to be raw it is K.
        ({"d": ()}, "/depth/image_raw", "auto", False, RECTIFIED),
        ({"d": (0.0,) * 5}, "/depth/image_raw", "auto", False, RECTIFIED),
        ({"d": (), "p": NO_P}, "/depth/image_raw", "auto", False, RAW),
        ({"d": (), "distortion_model": ""}, "/depth/image_raw", "apply", False, RAW),
        # All zeros are no distortion to image_geometry, whatever the model; an ideal fisheye has to be said.
        ({"d": (0.0,) * 4, "distortion_model": "equidistant"}, "/depth/image_raw", "auto", False, RECTIFIED),
        ({"d": (0.0,) * 4, "distortion_model": "equidistant"}, "/depth/image_raw", "apply", True, RAW),
        # What is not used may be anything.
        ({"d": (np.nan,) * 5}, "/depth/image_rect", "auto", False, RECTIFIED),
        ({"distortion_model": "unified"}, "/depth/image_raw", "ignore", False, RECTIFIED),
    ],
)
def test_which_image_it_is(changes, name, distortion, raw, camera, rng):
    info = replace(INFO, **changes)
    calibration = Calibration.of(info, name, distortion)
    assert calibration.size == (640, 480)
    depth = rng.uniform(1, 1.001, (480, 640)).astype(np.float32)
    labels = (depth > 1.0005).astype(np.int32)
    if not raw:
        assert calibration.rectification is None
        assert calibration.camera == camera
        assert calibration.rectify(depth) is depth
        assert calibration.rectify_labels(labels) is labels
        assert calibration.as_sent(depth) is depth
        return
    undone = Rectification(camera, Distortion(info.distortion_model, info.d))
    assert calibration.rectification == undone
    assert calibration.camera == undone.camera != camera
    np.testing.assert_array_equal(calibration.rectify(depth), undone.there.depth(depth))
    np.testing.assert_array_equal(calibration.rectify_labels(labels), undone.there.labels(labels))
    seen = np.ones((undone.camera.height, undone.camera.width), np.float32)
    assert calibration.as_sent(seen).shape == depth.shape


def test_what_auto_has_decided_is_said():
    assert "(plumb_bob -0.2 0.05 0.001 -0.001 0) is undone" in Calibration.of(INFO, "/depth/image").note
    assert "is not undone" in Calibration.of(INFO, "/depth/image_rect").note
    assert Calibration.of(INFO, "/depth/image", "apply").note == Calibration.of(INFO, "", "ignore").note == ""
    assert Calibration.of(replace(INFO, d=()), "/depth/image").note == ""


@pytest.mark.parametrize(
    ("changes", "distortion", "words"),
    [
        ({"k": NO_K, "p": NO_P}, "auto", "not calibrated"),
        ({"k": NO_K, "p": NO_P}, "ignore", "not calibrated"),
        ({"k": NO_K}, "auto", r"not calibrated.*distortion = ignore"),
        ({"k": (np.nan, *K[1:])}, "auto", "finite"),
        ({"k": (-5.0, *K[1:])}, "auto", "above 0"),
        ({"p": (np.nan, *P[1:])}, "ignore", "finite"),
        ({"d": (np.nan, *D[1:])}, "auto", r"finite d, got nan.*distortion = ignore"),
        ({"d": (np.inf, *D[1:])}, "apply", "finite d"),
        ({"d": D[:3]}, "auto", r"4 or 5 or 8 or 12 or 14 coefficients, got 3 .*distortion = ignore"),
        ({"distortion_model": "unified"}, "auto", r"got 'unified'.*distortion = ignore"),
        ({"distortion_model": ""}, "auto", "expected plumb_bob, rational_polynomial, equidistant, got ''"),
        ({"distortion_model": "none"}, "auto", "got 'none'"),
        ({"distortion_model": "equidistant"}, "auto", "expected 4 coefficients, got 5"),
        ({"distortion_model": "rational_polynomial", "d": (0,) * 11 + (0.1,)}, "auto", "thin prism"),
        ({"distortion_model": "rational_polynomial", "d": (0,) * 13 + (0.1,)}, "auto", "thin prism"),
        ({"d": (1e9, 0, 0, 0)}, "auto", "up to 1e"),
        ({"width": 2**31, "height": 2**31}, "auto", "at most"),
        ({"width": 0}, "auto", "at least 1 x 1"),
        ({}, "perhaps", "expected auto, apply, ignore"),
    ],
)
def test_faults_are_told_in_words(changes, distortion, words):
    with pytest.raises(ValueError, match=words):
        Calibration.of(replace(INFO, **changes), "/depth/image_raw", distortion)


@pytest.mark.parametrize("distortion", ["apply", "ignore"])
def test_a_part_and_binned_pixels_see_the_rays_of_the_whole(distortion):
    """Pixel (u, v) of the whole is ((u - x) / binning, (v - y) / binning) of the part, through the same lens."""
    part = replace(INFO, roi=Region(100, 40, 300, 200), binning_x=2, binning_y=4)
    found = Calibration.of(part, "", distortion)
    assert found.size == (150, 50)
    known = depth_image.raw_intrinsics_from_message(part)
    assert known == RawIntrinsics(Intrinsics(150, 50, 250.0, 125.5, 110.5, 50.75), "plumb_bob", D)
    u, v = 310.0, 120.0
    inner = ((u - 100) / 2, (v - 40) / 4)
    if distortion == "ignore":
        whole = depth_image.intrinsics_from_message(INFO)
        assert (inner[0] - found.camera.cx) / found.camera.fx == pytest.approx((u - whole.cx) / whole.fx)
        return
    raw = found.rectification.raw
    image = np.array([(inner[0] - raw.cx) / raw.fx, (inner[1] - raw.cy) / raw.fy])
    np.testing.assert_allclose(image, [(u - K[2]) / K[0], (v - K[5]) / K[4]])
    assert found.rectification.distortion == LENS
    # The window follows the part: all of it is seen, and no more than a little around it.
    assert share_seen(found.rectification) == 1
    assert found.camera.width * found.camera.height < 1.3 * 150 * 50


def test_a_part_far_from_the_axis_is_seen_too():
    for corner in ((0, 0), (540, 400)):
        calibration = Calibration.of(replace(INFO, roi=Region(*corner, 100, 80)), "", "apply")
        assert share_seen(calibration.rectification) == 1
        assert np.isfinite(calibration.rectify(np.ones((80, 100)))).mean() > 0.75


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ((640, 480), "width and height are swapped"),
        ((240, 320), "2 times smaller.*binning"),
        ((200, 300), "region of interest"),
        ((481, 640), "the image has 640 x 481 pixels, its camera_info is for 640 x 480$"),
    ],
)
@pytest.mark.parametrize("distortion", ["apply", "ignore"])
def test_images_that_do_not_fit_say_what_may_be_the_reason(shape, words, distortion):
    calibration = Calibration.of(INFO, "", distortion)
    for call in (calibration.rectify, calibration.rectify_labels):
        with pytest.raises(ValueError, match=f"camera_info: does not fit: .*{words}"):
            call(np.ones(shape))
    with pytest.raises(ValueError, match="does not fit"):
        calibration.as_sent(np.ones((7, 7)))
    assert size_mismatch((640, 480), (640, 480)) == ""
