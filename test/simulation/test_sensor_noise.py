"""Sensors: what they claim is what they do, their geometry is that of two eyes, and recorded planes agree."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import norm

from sq_perception.imaging import unit_cube
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.inverse_depth import InverseDepth
from sq_perception.simulation.scenes import plane_depth, table_scene
from sq_perception.simulation.sensor_noise import PRESETS, Ideal, Stereo, StructuredLight, TimeOfFlight, preset

CAMERA = Camera(320, 240, 525.0, 525.0, 159.5, 119.5)
KINECT, AZURE, D435, ZED = (PRESETS[name] for name in ("kinect_v1", "azure_kinect", "realsense_d435", "zed"))
NAMES = tuple(PRESETS)
STILL = dataclasses.replace(KINECT, edge_wander=0.0)
"""A Kinect whose edges keep their place."""


def wall(z: float, angle: float = 0.0, camera: Camera = CAMERA) -> np.ndarray:
    """Depth of a plane through (0, 0, z), turned about the image's vertical by ``angle`` degrees."""
    turn = np.radians(angle)
    return plane_depth(np.array([-np.sin(turn), 0.0, -np.cos(turn), z * np.cos(turn)]), camera)


def two_walls(near: float = 1.0, far: float = 1.5, left: int = 120, right: int = 200) -> np.ndarray:
    """A face at depth ``near`` in the columns left to right - 1 before a wall at ``far``."""
    depth = np.full((CAMERA.height, CAMERA.width), far)
    depth[:, left:right] = near
    return depth


def runs(row: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], row.view(np.int8), [0]])))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]


@pytest.mark.parametrize("angle", [0.0, 45.0, 55.0])
@pytest.mark.parametrize("z", [0.8, 1.4, 2.0])
@pytest.mark.parametrize("name", NAMES)
def test_a_plane_has_the_claimed_deviation_and_no_bias(name, z, angle, rng):
    model, true = PRESETS[name], wall(z, angle)
    sigma = model.sigma(true, np.clip(InverseDepth.of(true, CAMERA).cosine(), 1e-3, 1))
    relative = np.concatenate(
        [((model.measure(true, CAMERA, rng) - true) / sigma)[:, 60:] for _ in range(4 if angle else 8)]
    )
    seen = np.isfinite(relative)
    # A moving average over 45 to 81 pixels leaves some 10^4 independent readings in 8 images.
    assert np.std(relative[seen]) == pytest.approx(1.0, rel=0.05)
    assert abs(np.mean(relative[seen])) < (np.nanmax(sigma / true) + 5 * np.sqrt(81 / seen.sum()))


def test_the_cosine_of_a_plane_is_exact():
    angle, camera = 50.0, CAMERA
    v, u = np.indices((camera.height, camera.width))
    rays = camera.rays(u, v)[1]
    normal = np.array([np.sin(np.radians(angle)), 0.0, np.cos(np.radians(angle))])
    expected = rays @ normal / np.linalg.norm(rays, axis=-1)
    np.testing.assert_allclose(InverseDepth.of(wall(1.0, angle), camera).cosine(), expected, atol=2e-3)


@pytest.mark.parametrize("model", [KINECT, D435], ids=["kinect_v1", "realsense_d435"])
def test_steps_are_uniform_in_disparity(model, rng):
    measured = model.measure(wall(1.4, 30.0), CAMERA, rng)
    levels = CAMERA.fx / measured[np.isfinite(measured)].astype(float) / (CAMERA.fx * model.quantum)
    np.testing.assert_allclose(levels, np.rint(levels), atol=2e-3)
    assert np.count_nonzero(np.diff(np.unique(np.rint(levels))) == 1) > 10
    # 2.85 mm at 1 m for the Kinect, growing with the square of the distance (Khoshelham & Elberink 2012, equation 14).
    assert KINECT.quantum == pytest.approx(2.85e-3, rel=0.02)


def test_sigma_is_that_of_the_publications():
    assert KINECT.sigma(1.0) == pytest.approx(0.0012 + 0.0019 * 0.36)
    theta = np.radians(70.0)
    grazing = 1e-4 / np.sqrt(2.0) * (theta / (np.pi / 2 - theta)) ** 2
    assert KINECT.sigma(2.0, np.cos(theta)) == pytest.approx(0.0012 + 0.0019 * 1.6**2 + grazing)
    assert D435.sigma(2.0) == pytest.approx(4 * 0.08 / (424 * 0.05))
    assert AZURE.sigma(2.0) == pytest.approx(1.7e-3)
    # The specification is 17 mm at most, wherever the sensor sees anything.
    assert AZURE.sigma(3.8) < 0.017
    assert 3 * ZED.sigma(1.0) == pytest.approx(0.01, rel=0.15)
    for name in NAMES:
        assert (np.diff(PRESETS[name].sigma(np.linspace(0.9, 3.5, 30))) > 0).all()
        assert PRESETS[name].sigma(np.ones((3, 1)), np.full(4, 0.5)).shape == (3, 4)


def test_noise_of_triangulation_is_shared_within_the_window(rng):
    model = dataclasses.replace(D435, step=0.0)
    error = model.measure(wall(1.0), CAMERA, rng)[:, 60:] - 1.0
    columns, rows = model.window
    for lag in (1, 4, columns, columns + 6):
        found = np.mean(error[:, lag:] * error[:, :-lag]) / np.mean(error**2)
        assert found == pytest.approx(max(0, 1 - lag / columns), abs=0.06)
    found = np.mean(error[2:] * error[:-2]) / np.mean(error**2)
    assert found == pytest.approx(1 - 2 / rows, abs=0.06)


@pytest.mark.parametrize("baseline", [0.075, -0.075])
def test_shadows_lie_on_the_side_away_from_the_projector_and_have_its_width(baseline, rng):
    missing = np.isnan(dataclasses.replace(STILL, baseline=baseline).measure(two_walls(), CAMERA, rng))
    width = CAMERA.fx * 0.075 * (1 / 1.0 - 1 / 1.5)
    for row in missing[::20]:
        ((first, last),) = runs(row)
        assert last - first + 1 == pytest.approx(width, abs=1)
        assert (last == 119) if baseline > 0 else (first == 200)


def test_a_thin_pole_casts_a_shadow_apart_from_itself_and_a_tilted_plane_none(rng):
    ((first, last),) = runs(np.isnan(STILL.measure(two_walls(1.0, 2.5, 160, 166), CAMERA, rng))[100])
    assert last - first + 1 == pytest.approx(6, abs=1)
    assert 160 - first == pytest.approx(CAMERA.fx * 0.075 * (1 / 1.0 - 1 / 2.5), abs=1)
    for angle in (-60.0, -30.0, 0.0, 30.0, 60.0):
        assert not InverseDepth.of(wall(1.0, angle), CAMERA).hidden_from(0.075).any()


def test_stereo_misses_the_columns_outside_the_second_image(rng):
    for z in (0.6, 1.0, 2.0):
        ((first, last),) = runs(np.isnan(ZED.measure(wall(z), CAMERA, rng))[50])
        assert (first, last + 1) == (0, pytest.approx(CAMERA.fx * 0.12 / z, abs=1))
    mirrored = dataclasses.replace(ZED, baseline=-0.12)
    ((_, last),) = runs(np.isnan(mirrored.measure(wall(1.0), CAMERA, rng))[50])
    assert last == CAMERA.width - 1
    assert not np.isnan(KINECT.measure(wall(1.0), CAMERA, rng)).any()


def test_stereo_fattens_the_foreground_over_its_shadow(rng):
    model = dataclasses.replace(D435, edge_wander=0.0, fattening=3)
    measured = model.measure(two_walls(1.0, 2.0), CAMERA, rng)[100]
    assert runs(measured < 1.2) == [(117, 202)]
    shadow = runs(np.isnan(measured))[-1]
    assert shadow[1] == 116
    assert shadow[1] - shadow[0] + 1 == pytest.approx(CAMERA.fx * 0.05 * 0.5 - 3, abs=1)


@pytest.mark.parametrize("wander", [0.8, 1.5])
def test_edges_wander_by_the_stated_pixels(wander, rng):
    model = dataclasses.replace(KINECT, edge_wander=wander)
    near = np.zeros(16)
    for _ in range(12):
        near += (model.measure(two_walls(), CAMERA, rng)[:, 192:208] < 1.2).mean(axis=0) / 12
    # The edge lies between columns 199 and 200; column c shows the near face if it looks left of the edge.
    expected = norm.cdf((199.5 - np.arange(192, 208)) / wander)
    reached = np.abs(np.arange(192, 208) - 199.5) < 4
    np.testing.assert_allclose(near[reached], expected[reached], atol=0.03)
    assert (near[0], near[-1]) == (1, 0)


def test_edges_wander_without_moving_surfaces(rng):
    # A tilted face before a tilted wall: what is near the edge still lies on one of the two planes.
    depth = wall(1.6, 40.0)
    depth[:, 120:200] = wall(1.0, -40.0)[:, 120:200]
    measured = dataclasses.replace(KINECT, edge_wander=2.0).measure(depth, CAMERA, rng)
    sigma = KINECT.sigma(1.8, np.cos(np.radians(40.0)))
    off = np.minimum(np.abs(measured - wall(1.6, 40.0)), np.abs(measured - wall(1.0, -40.0)))
    assert np.nanmax(off) < 6 * sigma


def test_flying_pixels_lie_between_foreground_and_background(rng):
    model = dataclasses.replace(AZURE, mixed_loss=0.0)
    measured = np.stack([model.measure(two_walls(1.0, 1.5), CAMERA, rng) for _ in range(4)])
    between = (measured > 1.02) & (measured < 1.48)
    assert set(np.nonzero(between.any(axis=(0, 1)))[0]) == {119, 120, 199, 200}
    assert between[:, :, [119, 120, 199, 200]].mean() > 0.8
    assert measured.min() > 1.0 - 6 * model.sigma(1.0)
    assert measured.max() < 1.5 + 6 * model.sigma(1.5)
    half = dataclasses.replace(AZURE, mixed_loss=0.5).measure(two_walls(1.0, 1.5), CAMERA, rng)
    assert np.isnan(half[:, [119, 120, 199, 200]]).mean() == pytest.approx(0.5, abs=0.06)
    whole = dataclasses.replace(model, footprint=0.0).measure(two_walls(1.0, 1.5), CAMERA, rng)
    assert not ((whole > 1.02) & (whole < 1.48)).any()


def test_the_nearer_surface_returns_more_light(rng):
    # The light of a face goes with 1 / z^2; the near face's share of a pixel on the far one is 0 to 1/2.
    model = dataclasses.replace(AZURE, mixed_loss=0.0)
    far = np.concatenate([model.measure(two_walls(1.0, 2.0), CAMERA, rng)[:, 200] for _ in range(30)])
    share = np.linspace(0, 0.5, 1001)
    expected = (share * 1.0 + (1 - share) * 0.5) / (share * 1.0 + (1 - share) * 0.25)
    assert np.mean(far) == pytest.approx(np.mean(expected), abs=0.01)
    assert far.min() > (0.5 + 0.25) / (0.5 + 0.125) - 6 * model.sigma(2.0)


@pytest.mark.parametrize("name", NAMES)
def test_dropout_grows_with_the_angle_as_claimed(name, rng):
    model, camera = PRESETS[name], Camera(640, 240, 1000.0, 1000.0, 319.5, 119.5)
    lost = []
    for angle in (0.0, 60.0, 78.0, 82.0, 85.0):
        true = wall(1.4, -angle, camera)
        cosine = np.clip(InverseDepth.of(true, camera).cosine(), 1e-3, 1)
        inside = np.zeros(true.shape, dtype=bool)
        # Beside the band that stereo does not see, and where the plane is in range; it faces the second eye.
        inside[:, 200:] = True
        inside &= (true < 2.5) & (true > 0.9)
        missing = np.mean([np.isnan(model.measure(true, camera, rng)[inside]).mean() for _ in range(6)])
        assert missing == pytest.approx(model.dropout(true, cosine)[inside].mean(), abs=0.06)
        lost.append(missing)
    assert lost[0] == 0
    assert (np.diff(lost) >= 0).all()
    if isinstance(model, TimeOfFlight):
        assert model.dropout(3.6) > model.dropout(2.0) == 0
        assert model.dropout(model.far) == 0.5
    else:
        assert lost[-1] > 0.5


@pytest.mark.parametrize("name", NAMES)
def test_nothing_stays_nothing_and_readings_keep_the_range(name, rng):
    model = PRESETS[name]
    assert np.isnan(model.measure(np.full((240, 320), np.nan), CAMERA, rng)).all()
    assert np.isnan(model.measure(np.full((240, 320), np.inf, np.float32), CAMERA, rng)).all()
    hole = wall(1.0)
    hole[60:180, 120:240] = np.nan
    hole[:40, 200:] = np.inf
    measured = model.measure(hole, CAMERA, rng)
    # Up to the pixels by which edges wander or foregrounds are fattened.
    assert np.isnan(measured[68:172, 128:232]).all()
    assert np.isnan(measured[:32, 208:]).all()
    for outside in (1e-9, 0.8 * model.near, 2 * model.far):
        assert np.isnan(model.measure(np.full((240, 320), outside), CAMERA, rng)).all()


@pytest.mark.parametrize("name", ["ideal", *NAMES])
def test_a_seed_names_an_image_and_the_truth_is_left_alone(name):
    model = Ideal(0.002) if name == "ideal" else preset(name)
    true, _ = table_scene(np.random.default_rng(2), 2, CAMERA).render()
    kept = true.copy()
    first, again, other = (model.measure(true, CAMERA, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other, equal_nan=True)
    np.testing.assert_array_equal(true, kept)
    assert (first.dtype, first.shape) == (np.float32, true.shape)
    np.testing.assert_array_equal(model.measure(true.astype(float), CAMERA, np.random.default_rng(1)), first)


def test_the_ideal_sensor_adds_its_deviation_and_nothing_else(rng):
    depth = np.full((200, 200), 1.0, np.float32)
    depth[:20] = np.nan
    depth[20:40] = np.inf
    camera = Camera(200, 200, 200.0, 200.0, 99.5, 99.5)
    noisy = Ideal(0.01).measure(depth, camera, rng)
    assert np.isnan(noisy[:40]).all()
    assert np.std(noisy[40:]) == pytest.approx(0.01, rel=0.02)
    np.testing.assert_array_equal(Ideal().measure(depth, camera, rng)[40:], depth[40:])
    below = np.full((9, 9), -0.5)
    np.testing.assert_array_equal(Ideal().measure(below, unit_cube.camera(9), rng), below)


def test_misuse_is_named(rng):
    images = (
        (np.ones((4, 5)), "does not fit a camera of 320 x 240"),
        (np.ones((240, 320), np.uint16), "expected a floating image"),
        (np.ones((240, 320, 1)), "expected a floating image"),
    )
    for model in (KINECT, AZURE, D435, Ideal(0.001)):
        for image, words in images:
            with pytest.raises(ValueError, match=words):
                model.measure(image, CAMERA, rng)
        with pytest.raises(TypeError, match=r"numpy\.random\.Generator"):
            model.measure(wall(1.0), CAMERA, 7)
        for z in (0.0, -1.0, np.nan):
            with pytest.raises(ValueError, match="z: expected positive"):
                model.sigma(z)
        for cosine in (0.0, 1.1, np.nan):
            with pytest.raises(ValueError, match="cosine: expected"):
                model.sigma(1.0, cosine)
    for model in PRESETS.values():
        for bad in (0.0, -1.0, -np.inf):
            with pytest.raises(ValueError, match="expected positive metres"):
                model.measure(np.full((240, 320), bad), CAMERA, rng)
        with pytest.raises(ValueError, match="pinhole"):
            model.measure(np.ones((9, 9)), unit_cube.camera(9), rng)
    with pytest.raises(ValueError, match="expected one of kinect_v1, azure_kinect"):
        preset("lidar")
    changes = {"baseline": 0.0, "focal": -1.0, "far": 0.2, "window": (4, 5), "blind": 60.0, "step": -1}
    others = [(D435, "fattening", 40), (AZURE, "footprint", 3.0), (Ideal(), "deviation", float("nan"))]
    for model, name, value in [*((KINECT, *change) for change in changes.items()), *others]:
        with pytest.raises(ValueError, match=name):
            dataclasses.replace(model, **{name: value})
    assert isinstance(KINECT, StructuredLight)
    assert isinstance(ZED, Stereo)


# Recorded planes

TILE = 16


def spreads(depth: np.ndarray, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth and standard deviation of tiles of a plane about planes of their own."""
    found = []
    v, u = np.nonzero(np.ones((TILE, TILE)))
    design = np.stack([u, v, np.ones(v.size)], axis=1).astype(float)
    for top in range(0, depth.shape[0] - TILE + 1, TILE):
        for left in range(0, depth.shape[1] - TILE + 1, TILE):
            part = (slice(top, top + TILE), slice(left, left + TILE))
            inside = (plane[part] & np.isfinite(depth[part])).ravel()
            if inside.sum() < 0.9 * inside.size:
                continue
            z, rows = depth[part].ravel()[inside], design[inside]
            rest = z - rows @ np.linalg.lstsq(rows, z, rcond=None)[0]
            if np.abs(rest).max() < 0.03:
                found.append((np.median(z), np.std(rest)))
    return tuple(np.array(found).T)


@pytest.mark.parametrize(
    ("file", "model", "low", "high"),
    [
        *[(f"mosd_learn/learn{k}.npz", KINECT, 0.6, 1.6) for k in ("00", "12", "30", "42")],
        *[(f"frames/{name}.npz", D435, 0.25, 2.5) for name in ("felix_0", "felix_3")],
    ],
)
def test_recorded_planes_scatter_like_the_model(shared_data, file, model, low, high, rng):
    """The same estimate from a recorded table and from the model's picture of that table, at the same depths."""
    if not (shared_data / file).is_file():
        pytest.skip(f"no {file} in {shared_data}")
    frame = np.load(shared_data / file)
    depth = frame["depth"].astype(float)
    camera = Camera.from_matrix(frame["K"], depth.shape[1], depth.shape[0])
    if "support" in frame.files:
        table = frame["support"] > 0
    else:
        table = (frame["labels"] == 0) & (np.abs(camera.points(depth) @ frame["plane"][:3] + frame["plane"][3]) < 0.015)
    table &= np.isfinite(depth)
    v, u = np.nonzero(table)
    rows, inverse = np.stack([u, v, np.ones(v.size)], axis=1).astype(float), 1 / depth[table]
    keep = np.ones(v.size, dtype=bool)
    for _ in range(6):
        law = np.linalg.lstsq(rows[keep], inverse[keep], rcond=None)[0]
        rest = np.abs(inverse - rows @ law)
        keep = rest < 4 * np.median(rest)
    v, u = np.indices(depth.shape)
    flat = law[0] * u + law[1] * v + law[2]
    true = np.where(flat > 0.2, 1 / np.maximum(flat, 0.2), np.nan)
    simulated = np.rint(1e3 * model.measure(true, camera, rng)) / 1e3
    real_z, real = spreads(depth, table)
    model_z, claimed = spreads(simulated, table)
    ratios = []
    for z in np.arange(0.5, 1.4, 0.2):
        here, there = np.abs(real_z - z) < 0.1, np.abs(model_z - z) < 0.1
        if here.sum() > 10 and there.sum() > 10:
            ratios.append(np.median(real[here]) / np.median(claimed[there]))
    assert len(ratios) >= 3
    assert low < min(ratios)
    assert max(ratios) < high
