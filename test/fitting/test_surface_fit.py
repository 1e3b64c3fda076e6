"""The surface fit: exact on clean images of both cameras, robust on bad ones, honest about what it cannot know."""

import re
import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sq_perception.fitting import quality, surface_fit
from sq_perception.fitting.fit import CUT_SHORT, Fit, Status
from sq_perception.fitting.surface_fit import FitOptions
from sq_perception.geometry import metrics
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast, unit_cube
from sq_perception.imaging.camera import Camera
from sq_perception.simulation import scenes

GREY = 1 / 255


def thesis_body(rng: np.random.Generator) -> Superquadric:
    """A body of the thesis' protocol, in the optical frame."""
    body = Superquadric(
        rng.uniform(25, 75, 3) / 255,
        rng.uniform(0.1, 1.0, 2),
        (128 + rng.uniform(-40, 40, 3)) / 255,
        quaternions.random(1, rng)[0],
    )
    return unit_cube.optical_from_cube(body)


def thesis_image(body: Superquadric) -> np.ndarray:
    depth, _ = raycast.render(body, unit_cube.camera())
    return unit_cube.grey_from_depth(depth)


def fit_grey(image: np.ndarray, **options: object) -> Fit:
    depth = unit_cube.depth_from_grey(image)
    return surface_fit.fit(depth, image > 0, unit_cube.camera(), options=FitOptions(**options))  # type: ignore[arg-type]


def test_sharp_cans_that_lie_are_as_long_as_they_are(rng: np.random.Generator) -> None:
    """Six of them, noise of 1.5 mm z^2: no rounded rim is to be made up for by a longer body."""
    camera = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
    up = -np.array([0.0, np.sin(0.8), np.cos(0.8)])
    level = np.array([1.0, 0.0, 0.0])
    errors = []
    for angle in np.linspace(0.2, 2.6, 6):
        axis = np.cos(angle) * level + np.sin(angle) * np.cross(up, level)
        turn = quaternions.from_matrix(np.stack([up, np.cross(axis, up), axis], axis=1))
        can = Superquadric([0.033, 0.033, 0.06], [0.02, 1.0], [0.0, 0.0, 0.7], turn)
        plane = np.append(up, 0.033 - 0.7 * up[2])
        rendered, _ = raycast.render(can, camera)
        depth = np.minimum(rendered, scenes.plane_depth(plane, camera))
        depth = depth + rng.normal(0, 0.0015, depth.shape) * depth**2
        found = surface_fit.fit(depth, np.isfinite(rendered), camera, options=FitOptions(plane=plane))
        along = int(np.argmax(np.abs(axis @ found.superquadric.rotation_matrix)))
        errors.append(2 * (found.superquadric.size[along] - 0.06))
    assert abs(np.mean(errors)) < 0.0006
    assert np.abs(errors).max() < 0.003


CAMERA = Camera(320, 240, 270.0, 270.0, 159.5, 119.5)


def pinhole_body(rng: np.random.Generator) -> Superquadric:
    size = rng.uniform(0.03, 0.08, 3)
    centre = np.array([rng.uniform(-0.05, 0.05), rng.uniform(-0.05, 0.05), rng.uniform(0.35, 0.6)])
    return Superquadric(size, rng.uniform(0.1, 1.0, 2), centre, quaternions.random(1, rng)[0])


def pinhole_image(body: Superquadric, behind: float = 1.5) -> tuple[np.ndarray, np.ndarray]:
    """Depth in whole millimetres, with a wall behind, and the mask."""
    depth, _ = raycast.render(body, CAMERA)
    mask = np.isfinite(depth)
    return np.round(np.where(mask, depth, behind) * 1000).astype(np.float32) / np.float32(1000), mask


def iou(fit: Fit, truth: Superquadric) -> float:
    return float(np.squeeze(metrics.volume_iou(fit.superquadric, truth)))


@pytest.mark.parametrize("seed", range(12))
def test_clean_thesis_images(seed: int) -> None:
    truth = thesis_body(np.random.default_rng(seed))
    fit = fit_grey(thesis_image(truth))
    assert iou(fit, truth) > 0.985
    assert fit.status == Status.CONVERGED
    assert fit.residual < 0.6 * GREY
    assert fit.inlier_share > 0.97
    assert fit.superquadric.canonical_form().to_flat() == pytest.approx(fit.superquadric.to_flat())


@pytest.mark.parametrize("seed", range(6))
def test_clean_pinhole_images(seed: int) -> None:
    truth = pinhole_body(np.random.default_rng(seed))
    depth, mask = pinhole_image(truth)
    fit = surface_fit.fit(depth, mask, CAMERA)
    assert iou(fit, truth) > 0.97
    assert fit.noise == pytest.approx(1e-3 / np.sqrt(12), rel=0.5)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("damage", ["dropout", "outliers", "eroded", "grown"])
def test_damaged_images(damage: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = thesis_body(rng)
    image = thesis_image(truth)
    depth, mask = unit_cube.depth_from_grey(image), image > 0
    square = np.ones((5, 5), np.uint8)
    if damage == "dropout":
        mask &= rng.random(mask.shape) > 0.1
        depth = np.where(mask, depth, np.float32(np.nan))
    elif damage == "outliers":
        stray = mask & (rng.random(mask.shape) < 0.02)
        depth = np.where(stray, rng.uniform(0, 1, mask.shape), depth).astype(np.float32)
    elif damage == "eroded":
        mask = cv2.erode(mask.astype(np.uint8), square, borderValue=1) > 0
        depth = np.where(mask, depth, np.float32(np.nan))
    else:
        depth = np.where(mask, depth, np.float32(1.0))
        mask = cv2.dilate(mask.astype(np.uint8), square) > 0
    assert iou(surface_fit.fit(depth, mask, unit_cube.camera()), truth) > 0.93


@pytest.mark.parametrize("seed", range(4))
def test_a_nearer_body_hides_a_part(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = pinhole_body(rng)
    depth, mask = pinhole_image(truth)
    columns = np.flatnonzero(mask.any(axis=0))
    hidden = np.arange(CAMERA.width) < columns[int(0.2 * len(columns))]
    depth[:, hidden] = 0.2
    assert iou(surface_fit.fit(depth, mask & ~hidden, CAMERA), truth) > 0.85


@pytest.mark.parametrize("form", range(8))
def test_all_forms_of_a_start_lead_to_the_same_body(form: int) -> None:
    rng = np.random.default_rng(3)
    truth = thesis_body(rng)
    image = thesis_image(truth)
    near = Superquadric(
        truth.size * 1.1,
        np.clip(truth.shape + 0.1, 0.1, 1.0),
        truth.translation + 0.01,
        quaternions.multiply(truth.rotation, quaternions.from_rotation_vector(np.array([0.1, -0.1, 0.1]))),
    )
    start = near.equivalent_forms()[form]
    depth = unit_cube.depth_from_grey(image)
    fit = surface_fit.fit(depth, image > 0, unit_cube.camera(), start=start)
    assert iou(fit, truth) > 0.99
    reference = surface_fit.fit(depth, image > 0, unit_cube.camera(), start=near)
    assert fit.superquadric.to_flat() == pytest.approx(reference.superquadric.to_flat(), abs=2e-3)
    assert fit.sigma_size == pytest.approx(reference.sigma_size, rel=0.1)


def test_the_best_of_several_starts_wins() -> None:
    truth = thesis_body(np.random.default_rng(5))
    image = thesis_image(truth)
    nonsense = Superquadric([0.01, 0.3, 0.01], [0.1, 1.0], [0.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0])
    depth = unit_cube.depth_from_grey(image)
    fit = surface_fit.fit(depth, image > 0, unit_cube.camera(), start=[nonsense, truth])
    assert iou(fit, truth) > 0.99
    assert iou(surface_fit.fit(depth, image > 0, unit_cube.camera(), start=nonsense), truth) > 0.98


def test_a_quarter_turn_of_the_image_turns_the_body() -> None:
    image = thesis_image(thesis_body(np.random.default_rng(8)))
    upright, turned = fit_grey(image), fit_grey(np.ascontiguousarray(np.rot90(image)))
    assert np.sort(turned.superquadric.size) == pytest.approx(np.sort(upright.superquadric.size), rel=0.01)
    about_view = np.array([0.0, 0.0, -np.sqrt(0.5), np.sqrt(0.5)])
    centre = np.array([0.5, 0.5, 0.0])
    moved = upright.superquadric.transformed(about_view, centre - quaternions.to_matrix(about_view) @ centre)
    assert iou(turned, moved) > 0.99


@pytest.mark.parametrize("seed", range(3))
def test_a_mirrored_camera_and_another_unit_change_no_body(seed: int) -> None:
    """Costs are in units of the noise, so that neither metres nor the side of the image count."""
    depth, mask = pinhole_image(pinhole_body(np.random.default_rng(40 + seed)))
    depth = depth + np.random.default_rng(seed).normal(0, 0.002, depth.shape).astype(np.float32)
    options = FitOptions(model_error=0.0, noise=0.002)
    size = np.sort(surface_fit.fit(depth, mask, CAMERA, options=options).superquadric.size)
    there = replace(CAMERA, cx=CAMERA.width - 1 - CAMERA.cx)
    mirrored = surface_fit.fit(np.fliplr(depth), np.fliplr(mask), there, options=options).superquadric.size
    np.testing.assert_allclose(np.sort(mirrored), size, rtol=0.02)
    larger = replace(options, noise=0.02)
    tenfold = surface_fit.fit(depth * np.float32(10), mask, CAMERA, options=larger).superquadric.size
    np.testing.assert_allclose(np.sort(tenfold), 10 * size, rtol=0.02)


def table_scene(truth: Superquadric, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    body, _ = raycast.render(truth, CAMERA)
    table = scenes.plane_depth(plane, CAMERA)
    mask = body < table
    depth = np.where(mask, body, np.where(np.isfinite(table), table, np.nan))
    return np.round(depth * 1000).astype(np.float32) / np.float32(1000), mask


def resting_body(rng: np.random.Generator) -> tuple[Superquadric, np.ndarray]:
    """A box-like body standing on a table seen from above at 40 degrees."""
    tilt = np.radians(40)
    normal = np.array([0.0, -np.cos(tilt), -np.sin(tilt)])
    size = rng.uniform(0.03, 0.07, 3)
    foot = np.array([0.0, 0.03, 0.5])
    x = np.array([1.0, 0.0, 0.0])
    turn = quaternions.from_rotation_vector(normal * rng.uniform(0, 3))
    axes = np.stack([x, np.cross(normal, x), normal], axis=1)
    rotation = quaternions.multiply(turn, quaternions.from_matrix(axes))
    body = Superquadric(size, np.array([0.2, 0.3]), foot + normal * size[2], rotation)
    return body, np.append(normal, -normal @ foot)


@pytest.mark.parametrize("seed", [0, 1, 6])
def test_a_thing_that_is_exactly_a_superquadric_may_still_be_another_body(seed: int) -> None:
    """Readings of fine noise may show a part of it that is one: the tolerant course's body counts as well."""
    truth, plane = resting_body(np.random.default_rng(seed))
    body, _ = raycast.render(truth, CAMERA)
    mask = body < scenes.plane_depth(plane, CAMERA)
    depth = np.where(mask, body, scenes.plane_depth(plane, CAMERA))
    depth = (depth + np.random.default_rng(seed).normal(0, 1e-4, depth.shape)).astype(np.float32)
    thing = surface_fit.fit(depth, mask, CAMERA, options=FitOptions(plane=plane))
    known = surface_fit.fit(depth, mask, CAMERA, options=FitOptions(plane=plane, model_error=0.0))
    assert (thing.status, known.status) == (Status.CONVERGED, Status.CONVERGED)
    np.testing.assert_allclose(thing.superquadric.size, known.superquadric.size, rtol=1e-3)
    # Twice and a half are the deviations of things whose residuals err alike.
    assert (thing.sigma_size / known.sigma_size).max() > 3


@pytest.mark.parametrize("seed", range(6))
def test_bodies_on_a_table_do_not_sink_into_it(seed: int) -> None:
    truth, plane = resting_body(np.random.default_rng(seed))
    depth, mask = table_scene(truth, plane)
    fit = surface_fit.fit(depth, mask, CAMERA, options=FitOptions(plane=plane))
    assert iou(fit, truth) > 0.88
    body = fit.superquadric
    assert (plane[:3] @ body.translation + plane[3] - body.support(plane[None, :3])[0]) > -0.003
    assert np.abs(plane[:3] @ body.rotation_matrix).max() > 0.995


def test_a_box_seen_face_on_is_weak_and_says_what_is_missing() -> None:
    """Whatever the noise.  Which depth it then gives is chance: of eight, at least half are within three deviations."""
    truth = Superquadric([0.06, 0.05, 0.04], [0.1, 0.1], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0, 1.0])
    camera = Camera(160, 120, 800.0, 800.0, 79.5, 59.5, "orthographic")
    flat, _ = raycast.render(truth, camera)
    within = 0
    for seed in range(8):
        noisy = flat + np.random.default_rng(seed).normal(0, 4e-3, flat.shape)
        depth = np.where(np.isfinite(flat), noisy, np.nan).astype(np.float32)
        fit = surface_fit.fit(depth, np.isfinite(depth), camera)
        assert fit.status == Status.WEAK
        hidden = int(np.argmax(fit.sigma_size))
        assert re.search(rf"half size along [xyz and]*{'xyz'[hidden]}[xyz and]* undetermined", fit.message)
        assert " mm" not in fit.message, "only the reader of the image knows its unit"
        assert abs(fit.superquadric.rotation_matrix[2, hidden]) > 0.9
        within += abs(fit.superquadric.size[hidden] - 0.04) < 3 * fit.sigma_size[hidden]
    assert within >= 4


def test_deviations_cover_the_errors_under_noise_of_two_grey_levels() -> None:
    within, total = 0, 0
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        truth = thesis_body(rng)
        image = thesis_image(truth)
        noisy = np.clip(np.round(image + rng.normal(0, 2, image.shape)), 1, 255)
        fit = fit_grey(np.where(image > 0, noisy, 0).astype(np.uint8))
        assert iou(fit, truth) > 0.9
        assert fit.noise == pytest.approx(2 * GREY, rel=0.15)
        order = np.argsort(fit.superquadric.size)
        error = np.abs(fit.superquadric.size[order] - np.sort(truth.size))
        within += int((error < 2 * fit.sigma_size[order]).sum())
        total += 3
        assert fit.covariance == pytest.approx(fit.covariance.T)
        assert np.linalg.eigvalsh(fit.covariance).min() > 0
    assert within / total > 0.75


def test_a_time_budget_ends_the_search() -> None:
    image = thesis_image(thesis_body(np.random.default_rng(4)))
    patient, hasty = fit_grey(image), fit_grey(image, time_budget=1e-9)
    assert hasty.iterations < 100
    assert patient.inlier_share > 0.97
    assert np.isfinite(hasty.superquadric.to_flat()).all()
    assert CUT_SHORT in hasty.message
    assert CUT_SHORT not in patient.message


FLAT = np.full((240, 320), 0.5, np.float32)


def square_mask(rows: int, columns: int) -> np.ndarray:
    mask = np.zeros((240, 320), bool)
    mask[100 : 100 + rows, 150 : 150 + columns] = True
    return mask


def test_noise_does_not_pull_bodies_on_a_plane_towards_the_camera() -> None:
    """Points before and behind the surface weigh alike where a superquadric explains the image; 2 mm of noise."""
    shift = []
    for seed in range(12):
        truth, plane = resting_body(np.random.default_rng(seed))
        depth, mask = table_scene(truth, plane)
        noisy = depth + 0.002 * np.random.default_rng(100 + seed).standard_normal(depth.shape)
        body = surface_fit.fit(noisy, mask, CAMERA, options=FitOptions(plane=plane)).superquadric
        sight = truth.translation / np.linalg.norm(truth.translation)
        shift.append(sight @ (body.translation - truth.translation))
    assert abs(np.median(shift)) < 0.0003


@pytest.mark.parametrize(("width", "height"), [(640, 3), (3, 480)])
@pytest.mark.parametrize("model_error", [None, 0.0025])
def test_a_strip_of_a_wall_has_a_covariance(width: int, height: int, model_error: float | None) -> None:
    """Rounding of one part in 10^16 of what it measures exactly must not make variances of the rest negative."""
    camera = Camera(width, height, 270.0, 270.0, (width - 1) / 2, (height - 1) / 2)
    depth = np.full((height, width), 0.7, np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit = surface_fit.fit(
            depth, np.ones_like(depth, dtype=bool), camera, options=FitOptions(model_error=model_error)
        )
        assert (fit.sigma_size > 0).all()


@pytest.mark.parametrize("width", [2, 3, 4, 5])
def test_a_narrow_mask_is_no_line(width: int) -> None:
    """A ledge that faces the camera: every so many-th of its pixels may lie in one column."""
    camera = Camera(64, 140, 200.0, 200.0, 31.5, 69.5)
    depth, mask = np.full((140, 64), 1.0, np.float32), np.zeros((140, 64), bool)
    mask[20:120, 30 : 30 + width] = True
    depth[mask] = 0.5
    assert surface_fit.fit(depth, mask, camera).status != Status.FAILED


def test_an_inverse_of_information_is_a_covariance(rng: np.random.Generator) -> None:
    """One direction known 10^10 times as well as another that is known from the prior alone."""
    axes, _ = np.linalg.qr(rng.normal(size=(11, 11)))
    found = quality._inverse((axes * np.r_[1e20, 1e12, np.full(9, 1.0)]) @ axes.T, 1.0)
    deviations = np.linalg.eigvalsh((found + found.T) / 2)
    assert deviations.min() > -1e-12
    assert deviations.max() <= 1 + 1e-9


def test_misuse_raises() -> None:
    mask, body = square_mask(30, 40), Superquadric([0.1] * 3, [0.5, 0.5], [0, 0, 0.5], [0, 0, 0, 1.0])
    for depth, pixels, words in (
        (FLAT, mask[:100], "mask"),
        (FLAT, mask.astype(np.uint8), "bool"),
        (FLAT[:100], mask[:100], "does not fit a camera"),
        (FLAT.astype(np.uint16), mask, "float"),
        (np.full_like(FLAT, np.nan), mask, "nothing to fit"),
        (FLAT, np.zeros_like(mask), "nothing to fit"),
    ):
        with pytest.raises(ValueError, match=words):
            surface_fit.fit(depth, pixels, CAMERA)
    for start, got in *((one, f"{one!r}$") for one in ("guess", "", None, 3)), ([body, 3], ""):
        with pytest.raises(ValueError, match=f"start: expected .* got {got}"):
            surface_fit.fit(FLAT, mask, CAMERA, start=start)
    for wrong in ({"noise": -1.0}, {"noise": np.inf}, {"plane": np.zeros(4)}, {"pixels": 3}, {"time_budget": 0.0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            FitOptions(**wrong)


def test_author_renders(shared_data: Path) -> None:
    for line in (shared_data / "author_renders" / "labels.txt").read_text().splitlines()[1:]:
        name, *numbers = line.split(",")
        values = np.array([float(x) for x in numbers])
        truth = Superquadric(values[0:3] / 255, values[3:5], values[5:8] / 255, values[17:21])
        image = cv2.imread(str(shared_data / "author_renders" / name), cv2.IMREAD_GRAYSCALE)
        assert iou(fit_grey(image), unit_cube.optical_from_cube(truth)) > 0.99


def test_recorded_box_on_a_table(shared_data: Path) -> None:
    """One box, two frames of a moving camera: the same sizes."""
    sizes = []
    for name in ("pcl_grab0", "pcl_grab1"):
        frame = np.load(shared_data / "frames" / f"{name}.npz")
        camera = Camera.from_matrix(frame["K"], frame["depth"].shape[1], frame["depth"].shape[0])
        fit = surface_fit.fit(frame["depth"], frame["labels"] == 2, camera, options=FitOptions(plane=frame["plane"]))
        assert fit.status != Status.FAILED
        sizes.append(np.sort(fit.superquadric.size))
    assert np.abs(sizes[0] - sizes[1]).max() < 0.004


HARD_SENSOR = {
    "wrong order of the axes, half again as deep": [
        0.0572, 0.1074, 0.0585, 0.3235, 0.2392, -0.2553, -0.0206, 1.4608, 0.8913, -0.3293, 0.1179, 0.2886
    ],
    "a slab taken for a block": [
        0.0375, 0.1122, 0.1108, 0.2937, 0.4964, 0.328, 0.1772, 1.4751, 0.5716, -0.6366, -0.4077, -0.319
    ],
    "a slab far away": [
        0.1124, 0.0872, 0.0347, 0.6613, 0.3403, -0.2296, -0.3932, 2.1054, -0.1787, -0.1988, -0.8346, 0.4816
    ],
    "a stick with a square end": [
        0.0326, 0.0326, 0.0921, 0.3072, 0.5984, -0.3748, 0.0872, 1.8106, 0.0852, 0.7379, 0.4299, 0.5132
    ],
}


@pytest.mark.parametrize("name", HARD_SENSOR)
def test_hard_bodies_through_a_sensor(name: str) -> None:
    """Bodies that an earlier search left in a wrong valley, at IoU 0.3 to 0.7, as both explain the image well."""
    focal = 320 / np.tan(np.deg2rad(30))
    camera = Camera(640, 480, focal, focal, 319.5, 239.5)
    rng = np.random.default_rng(5)
    body = Superquadric.from_flat(np.array(HARD_SENSOR[name]))
    depth, index = raycast.render(body, camera)
    mask = index >= 0
    depth = np.where(mask, depth, np.nan)
    noisy = np.round((depth + rng.standard_normal(depth.shape) * 0.0015 * depth**2) * 1000) / 1000
    assert iou(surface_fit.fit(noisy, mask, camera), body) > 0.85


@pytest.mark.parametrize("seed", [6, 11])
@pytest.mark.parametrize(
    "flat",
    [
        [0.2233, 0.2067, 0.1212, 0.33, 0.7848, 0.3657, 0.4311, 0.6132, 0.5732, 0.4275, 0.0861, -0.6938],
        [0.1085, 0.247, 0.2471, 0.5249, 0.3061, 0.3565, 0.445, 0.5274, 0.1896, 0.9345, 0.2959, 0.0559],
    ],
)
def test_hard_bodies_under_heavy_noise(flat: list[float], seed: int) -> None:
    """Eight grey levels: an earlier search read the outline from a body that noise had swollen (IoU 0.2 to 0.6)."""
    body = Superquadric.from_flat(np.array(flat))
    depth, index = raycast.render(body, unit_cube.camera())
    grey = (1 - depth) / GREY - 0.5 + np.random.default_rng(seed).normal(0, 8, depth.shape)
    depth = 1 - (np.clip(np.round(grey), 1, 255) + 0.5) * GREY
    assert iou(surface_fit.fit(depth, index >= 0, unit_cube.camera()), body) > 0.8


def test_a_hollow_body_is_taken_for_its_hull() -> None:
    """Points behind the surface, as in a box without a lid, do not pull it in."""
    body = Superquadric([0.1, 0.08, 0.06], [0.1, 0.1], [0.0, 0.0, 0.6], [0.3, 0.25, 0.0, 0.92])
    depth, mask = pinhole_image(body)
    notch = np.zeros_like(mask)
    notch[100:125, 140:175] = True
    depth = np.where(notch & mask, depth + 0.03, depth).astype(np.float32)
    assert (notch & mask).sum() > 500
    assert iou(surface_fit.fit(depth, mask, CAMERA), body) > 0.9


@pytest.mark.parametrize("behind", [1.5, np.nan])
def test_a_hole_that_the_sensor_left_is_no_hole_in_the_body(behind: float) -> None:
    """Shiny and black surfaces give no depth, and masks made from depth leave them out."""
    truth = pinhole_body(np.random.default_rng(1))
    depth, mask = pinhole_image(truth, behind)
    rows, columns = np.nonzero(mask)
    v, u = int(rows.mean()), int(columns.mean())
    depth[v - 8 : v + 9, u - 12 : u + 7] = np.nan
    mask &= np.isfinite(depth)
    assert iou(surface_fit.fit(depth, mask, CAMERA), truth) > 0.97


@pytest.mark.parametrize(
    ("typical", "as_hull", "status"),
    [
        (0.004, False, Status.CONVERGED),
        (0.006, False, Status.FAILED),
        (0.006, True, Status.WEAK),
        (0.029, True, Status.WEAK),
        (0.031, True, Status.FAILED),
    ],
)
def test_a_hull_that_encloses_most_of_a_thing_is_weak(typical: float, as_hull: bool, status: Status) -> None:
    """A quarter of the smallest half size, 20 mm, may stray; out of a hull, as much as the middle one sticks out."""
    body = Superquadric([0.02, 0.03, 0.04], [0.5, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0, 1.0])
    found, message = quality.judge(body, 1e-8 * np.eye(11), typical, 1e-4, as_hull)
    assert found == status
    assert ("off" in message) == (status != Status.CONVERGED)


def test_a_longer_body_is_not_taken_for_a_smaller_mask() -> None:
    """A body that covers free pixels on one side only is too long; the mask is right."""
    truth = pinhole_body(np.random.default_rng(3))
    depth, mask = pinhole_image(truth)
    start = Superquadric(truth.size * np.array([1.0, 1.0, 1.3]), truth.shape, truth.translation, truth.rotation)
    assert iou(surface_fit.fit(depth, mask, CAMERA, start=start), truth) > 0.97


def test_a_search_that_time_ended_is_not_sure_of_a_wrong_body() -> None:
    """It was: by tens of its deviations, which are those of the end of a search."""
    off, unknown = [], 0
    for seed in range(12):
        body = thesis_body(np.random.default_rng(seed))
        found = fit_grey(thesis_image(body), time_budget=1e-9)
        assert CUT_SHORT in found.message
        if np.isnan(found.sigma_size).all():
            assert found.status != Status.CONVERGED
            unknown += 1
            continue
        extent = body.support(found.superquadric.rotation_matrix.T)
        off.append(np.abs(found.superquadric.size - extent) / found.sigma_size)
    assert unknown >= 2
    assert np.mean(np.array(off) < 3) > 0.9


def test_an_object_of_a_camera_has_the_deviations_of_things(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether it is a superquadric is not known."""
    body = Superquadric([0.05, 0.04, 0.06], [0.3, 0.5], [0.0, 0.0, 0.5], [0.3, 0.25, 0.1, 0.9])
    depth, mask = pinhole_image(body)
    depth = depth + np.random.default_rng(3).normal(0, 0.001, depth.shape).astype(np.float32)
    sigmas = []
    for factor in (surface_fit.SPREAD, 1.0):
        monkeypatch.setattr(surface_fit, "SPREAD", factor)
        sigmas.append(surface_fit.fit(depth, mask, CAMERA).sigma_size)
    assert (sigmas[0] > 2 * sigmas[1]).all()
