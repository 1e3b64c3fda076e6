"""Which pixels of a mask are taken for the object."""

import cv2
import numpy as np
import pytest

from sq_perception.fitting import surface_fit
from sq_perception.fitting.fit import Status
from sq_perception.fitting.observation import Crop
from sq_perception.fitting.options import FitOptions
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.metrics import volume_iou
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera
from sq_perception.simulation.rendering import render_things
from sq_perception.simulation.thing import NO_CAVITY

CAMERA = Camera(640, 480, 554.0, 554.0, 319.5, 239.5)
PITCH = np.deg2rad(35)
NORMAL = -np.array([0.0, np.cos(PITCH), np.sin(PITCH)])
TABLE = np.append(NORMAL, 0.8 * np.sin(PITCH))
RIGHT = np.array([1.0, 0.0, 0.0])
UPRIGHT = quaternions.from_matrix(np.stack([RIGHT, np.cross(NORMAL, RIGHT), NORMAL], axis=1))
HALF = 0.12
BOX = Superquadric([0.04, 0.035, HALF], [0.2, 0.2], np.array([0.0, 0.0, 0.8]) + HALF * NORMAL, UPRIGHT)
CAN = Superquadric([0.035, 0.035, HALF], [0.1, 1.0], BOX.translation, UPRIGHT)


def image(body: Superquadric, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The body on its table, a wall behind, with little noise; and its mask."""
    depth, thing = render_things(Superquadric.stack([body]), np.zeros(1), NO_CAVITY, np.zeros(0), CAMERA, TABLE, 1.5)
    return (depth + 0.001 * depth**2 * rng.standard_normal(depth.shape)).astype(np.float32), thing == 0


def grown(mask: np.ndarray, pixels: int) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * pixels + 1, 2 * pixels + 1), np.uint8)) > 0


@pytest.mark.parametrize("pixels", [1, 2, 3])
@pytest.mark.parametrize("truth", [BOX, CAN], ids=["box", "can"])
def test_a_mask_too_large_by_pixels_makes_neither_table_nor_wall_a_part(truth, pixels, rng) -> None:
    """What is behind a thing goes on from its foot by way of the table, without a step."""
    depth, mask = image(truth, rng)
    fit = surface_fit.fit(depth, grown(mask, pixels), CAMERA, options=FitOptions(plane=TABLE))
    assert fit.status == Status.CONVERGED
    assert volume_iou(fit.superquadric, truth) > 0.97


def test_a_plane_before_the_object_is_refused(rng: np.random.Generator) -> None:
    """As other libraries' planes have it, whose normals point to either side; else it is a body on the wrong side."""
    depth, mask = image(CAN, rng)
    with pytest.raises(ValueError, match="does its normal n point away"):
        surface_fit.fit(depth, mask, CAMERA, options=FitOptions(plane=-TABLE))
    surface_fit.fit(depth, mask, CAMERA, options=FitOptions(plane=2 * TABLE))


def test_right_pixels_stay_whatever_the_plane_and_where_most_of_a_thing_is_as_low_as_its_support(rng) -> None:
    depth, mask = image(BOX, rng)
    crop = Crop.around(depth, mask, CAMERA, None)
    assert crop is not None
    known, unknown = crop.observe(0.0025, None, TABLE), crop.observe(0.0025, None)
    np.testing.assert_array_equal(known.pixels, unknown.pixels)
    above = TABLE - [0.0, 0.0, 0.0, 2 * HALF]  # a plane through its top
    assert len(crop.observe(0.0025, None, above).pixels) == len(crop.observe(0.0025, None).pixels)


@pytest.mark.parametrize("nothing", [np.inf, -np.inf, 0.0, -1.0])
def test_readings_that_are_none_say_the_same_whatever_their_number(nothing: float, rng: np.random.Generator) -> None:
    depth, mask = np.full((40, 40), 0.8), np.zeros((40, 40), bool)
    mask[10:30, 10:30] = True
    depth[mask] = 0.6 + 0.001 * rng.standard_normal(np.count_nonzero(mask))
    lost = rng.random(depth.shape) < 0.15
    camera = CAMERA.cropped(300, 220, 40, 40)
    usual, other = (Crop.around(np.where(lost, number, depth), mask, camera, None) for number in (np.nan, nothing))
    assert usual is not None
    assert other is not None
    assert usual.noise == other.noise
    np.testing.assert_array_equal(usual.depth, other.depth)


def test_a_thing_whose_head_hides_the_beginning_of_its_grip_is_fitted_whole() -> None:
    """Of an image without noise a superquadric explains all pixels of the head, which are most; and a planner that
    takes that for the thing runs into the grip."""
    away = np.cross(NORMAL, RIGHT)
    centre = np.array([0.0, 0.0, 0.8])
    head = Superquadric([0.06, 0.03, 0.03], [0.3, 0.3], centre + 0.03 * NORMAL, UPRIGHT)
    grip = Superquadric([0.02, 0.1, 0.01], [0.3, 0.3], centre + 0.01 * NORMAL + 0.12 * away, UPRIGHT)
    parts = Superquadric.stack([head, grip])
    depth, thing = render_things(parts, np.zeros(2), NO_CAVITY, np.zeros(0), CAMERA, TABLE, 1.5)
    fit = surface_fit.fit(depth.astype(np.float32), thing == 0, CAMERA, options=FitOptions(plane=TABLE))
    reach = (fit.superquadric.translation - centre) @ away + fit.superquadric.support(away[None])[0]
    assert reach > 0.12
    assert fit.status != Status.CONVERGED
