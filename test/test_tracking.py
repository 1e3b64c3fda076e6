"""Tracking: ids and forms that last, sizes that sharpen, and deviations that are true."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import chi2

from sq_perception.fitting import covariance as fit_covariance
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import scene
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.raycast import render
from sq_perception.imaging.sensor_model import Ideal
from sq_perception.recovery import Recoverer
from sq_perception.tracking import forms, sight, state
from sq_perception.tracking.tracker import Tracker, TrackerOptions, TrackState

EXACT = TrackerOptions(
    least_log_size=0, least_shape=0, least_centre=0, least_turn=0, drift_centre=0, drift_turn=0, gate=1 - 1e-9
)
"""Nothing but the covariances given."""
CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)


class Seen(NamedTuple):
    superquadric: Superquadric
    covariance: np.ndarray


def body(size=(0.05, 0.04, 0.03), shape=(0.3, 0.5), centre=(0, 0, 0.8), turn=(0.1, 0.2, 0.3)):
    return Superquadric(
        np.array(size, dtype=float),
        np.array(shape, dtype=float),
        np.array(centre, dtype=float),
        quaternions.from_rotation_vector(np.array(turn, dtype=float)),
    )


def spread_bodies(count, rng, gap=0.3):
    """Bodies that cannot be confused: on a grid."""
    side = int(np.ceil(np.sqrt(count)))
    place = np.array([(gap * (k % side), gap * (k // side), 0.8) for k in range(count)])
    shape = rng.uniform([0.2, 0.6], [0.5, 0.9], (count, 2))
    return Superquadric(rng.uniform(0.03, 0.07, (count, 3)), shape, place, quaternions.random(count, rng))


def noise(size=0.03, shape=0.03, centre=0.001, turn=0.03):
    return state.diagonal(size, shape, centre, turn)


def correlated(rng, scale=0.03):
    """A random covariance in logarithms of sizes with correlations between everything."""
    deviation = np.sqrt(np.diag(noise(scale, scale, scale / 30, scale)))
    mix = rng.standard_normal((11, 22)) / np.sqrt(22)
    return deviation[:, None] * (mix @ mix.T) * deviation


def draw(truth, covariance, rng, form=None, error=None):
    """An observation of a body in a frame where its covariance (logarithms) holds; in a random form."""
    if error is None:
        error = rng.multivariate_normal(np.zeros(11), covariance)
    seen = Superquadric.from_flat(state.moved(truth.to_flat(), error))
    metres = state.from_log(covariance, seen.size)
    form = rng.integers(8) if form is None else form
    other = seen.equivalent_forms()[int(form)]
    return Seen(other, fit_covariance.carried_over(metres, seen, other))


def exchanged(seen, turn):
    """What a fit finds that chose another axis as z: one of the 16 forms that are no exact ones."""
    flat = forms.candidates(seen.superquadric.to_flat())[turn]
    change = forms._CHANGES[turn]
    return Seen(Superquadric.from_flat(flat), change @ seen.covariance @ change.T + 1e-6 * np.eye(11))


def from_camera(seen, rotation, position):
    """An observation of the world as a camera with this pose makes it."""
    back = quaternions.conjugate(rotation)
    matrix = quaternions.to_matrix(back)
    local = seen.superquadric.transformed(back, -matrix @ position)
    return Seen(local, state.turned(seen.covariance, matrix))


def looking_at(target, direction, distance):
    """Pose of a camera that looks at a point from a direction."""
    forward = -direction / np.linalg.norm(direction)
    helper = np.array([0, 1.0, 0]) if abs(forward[1]) < 0.9 else np.array([1.0, 0, 0])
    right = np.cross(helper, forward)
    right /= np.linalg.norm(right)
    matrix = np.stack([right, np.cross(forward, right), forward], axis=1)
    return quaternions.from_matrix(matrix), target - distance * forward


def error_of(track, truth):
    """Error of a track in the truth's nearest form, and its covariance, in logarithms."""
    covariance = state.to_log(track.covariance, track.superquadric.size)
    match = forms.nearest(
        truth.to_flat()[None], 1e-9 * np.eye(11)[None], track.superquadric.to_flat()[None], covariance[None], 0.0
    )
    return state.difference(truth.to_flat(), match.state[0]), match.covariance[0]


def nees(track, truth):
    error, covariance = error_of(track, truth)
    return float(state.mahalanobis(covariance, error))


def assert_chi_square(values, degrees=11, probability=1e-3):
    total, count = np.sum(values), np.size(values)
    low, high = chi2.ppf([probability / 2, 1 - probability / 2], degrees * count)
    assert low < total < high, f"mean {total / count:.2f} of {degrees}, allowed {low / count:.2f} to {high / count:.2f}"


def angle_between(a, b):
    return float(quaternions.geodesic_angle(a.rotation, b.rotation))


# Forms


def test_the_first_eight_forms_are_the_equivalent_ones():
    truth = body()
    flats = forms.candidates(truth.to_flat())[: forms.EXACT]
    for other in truth.equivalent_forms():
        same = [
            np.allclose(flat[:8], other.to_flat()[:8]) and quaternions.geodesic_angle(flat[8:], other.rotation) < 1e-7
            for flat in flats
        ]
        assert sum(same) == 1


def test_all_forms_are_one_body_where_the_exponents_are_equal(rng):
    truth = body(shape=(0.4, 0.4))
    points = truth.translation + rng.uniform(-0.06, 0.06, (200, 3))
    for flat in forms.candidates(truth.to_flat()):
        np.testing.assert_allclose(Superquadric.from_flat(flat).gauge(points), truth.gauge(points), rtol=1e-9)


def test_the_nearest_form_undoes_any_exact_one_with_its_covariance(rng):
    truth, covariance = body(), correlated(rng)
    for form in range(8):
        seen = draw(truth, covariance, rng, form, np.zeros(11))
        match = forms.nearest(
            truth.to_flat()[None],
            noise()[None],
            seen.superquadric.to_flat()[None],
            state.to_log(seen.covariance, seen.superquadric.size)[None],
            0.3,
        )
        np.testing.assert_allclose(state.difference(truth.to_flat(), match.state[0]), 0, atol=1e-9)
        np.testing.assert_allclose(match.covariance[0], covariance, atol=1e-12)


def test_z_changes_places_only_where_the_exponents_are_alike(rng):
    """A box is recognised with any axis as z; a cylinder is not, as none of its other axes is one of revolution."""
    for shape, allowed in (((0.2, 0.3), True), ((0.2, 0.9), False)):
        truth = body(shape=shape)
        flat = forms.candidates(truth.to_flat())
        flat[:, 3:5] = shape
        count = len(flat)
        match = forms.nearest(
            np.tile(truth.to_flat(), (count, 1)),
            np.tile(noise(), (count, 1, 1)),
            flat,
            np.tile(noise(), (count, 1, 1)),
            0.3,
        )
        turn = quaternions.geodesic_angle(match.state[:, 8:12], truth.rotation)
        assert (turn[: forms.EXACT] < 1e-6).all()
        assert (turn[forms.EXACT :] < 1e-6).all() == allowed


# Honest numbers


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_nees_of_independent_views(share, rng):
    """20 bodies, each frame from another side: the errors are as large as the covariances say."""
    truths = spread_bodies(20, rng)
    tracker = Tracker(TrackerOptions(**{**vars(EXACT), "common_share": share}))
    covariances = [correlated(rng) for _ in truths]
    directions = [(-0.1, 0.1, -1), (1, 0.2, 0.1), (0.1, 1, 0), (0.2, 0, 1), (-1, 0, 0.2), (0, -1, 0.1)]
    for k, direction in enumerate(directions):
        pose = looking_at(truths.translation.mean(axis=0), np.array(direction, dtype=float), 5.0)
        seen = [from_camera(draw(t, c, rng), *pose) for t, c in zip(truths, covariances, strict=True)]
        tracks = tracker.update(seen, 0.1 * k, pose)
        assert [t.id for t in tracks] == list(range(1, 21))
        if k in (0, 1, 5):
            assert_chi_square([nees(t, truth) for t, truth in zip(tracks, truths, strict=True)])
    shrunk = [
        np.prod(t.sigma_size / truth.size) / np.prod(np.sqrt(np.diag(c)[:3]))
        for t, truth, c in zip(tracks, truths, covariances, strict=True)
    ]
    np.testing.assert_allclose(np.cbrt(shrunk), 1 / np.sqrt(len(directions)), rtol=0.1)


def test_nees_of_one_view_with_a_common_error(rng):
    """A still camera repeats its error; 50 frames from two sides are as good as they are said to be."""
    truths = spread_bodies(20, rng)
    tracker = Tracker(TrackerOptions(**{**vars(EXACT), "common_share": 0.5}))
    covariance = correlated(rng)
    middle = truths.translation.mean(axis=0)
    for view, direction in enumerate([(0, 0, -1.0), (1.0, 0, 0)]):
        pose = looking_at(middle, np.array(direction), 20.0)
        common = rng.multivariate_normal(np.zeros(11), 0.5 * covariance, 20)
        for k in range((40, 10)[view]):
            errors = common + rng.multivariate_normal(np.zeros(11), 0.5 * covariance, 20)
            seen = [from_camera(draw(t, covariance, rng, error=e), *pose) for t, e in zip(truths, errors, strict=True)]
            tracks = tracker.update(seen, 4.0 * view + 0.1 * k, pose)
        assert_chi_square([nees(t, truth) for t, truth in zip(tracks, truths, strict=True)])


def test_identical_frames_leave_the_common_error_and_another_view_does_not(rng):
    tracker, seen = Tracker(), draw(body(), noise(), rng)
    first = tracker.update([seen], 0.0)[0].sigma_size
    for k in range(1, 300):
        track = tracker.update([seen], k / 30)[0]
    assert (track.sigma_size > 0.7 * first).all()
    assert (track.sigma_size < 0.8 * first).all()
    assert track.seen == 300
    pose = looking_at(seen.superquadric.translation, np.array([1.0, 0, 0]), 0.8)
    other = tracker.update([from_camera(seen, *pose)], 10.0, pose)[0]
    assert (other.sigma_size < 0.85 * track.sigma_size).all()


def test_a_turning_body_is_as_good_as_a_moving_camera(rng):
    """On a turntable under a still camera: sizes sharpen beyond what one view can tell."""
    still, turning = Tracker(), Tracker()
    covariance = noise(turn=0.01)
    truth = body(turn=(0, 0, 0))
    for k in range(25):
        turned = truth.transformed(quaternions.from_rotation_vector(np.array([0, 0.25 * k, 0])), np.zeros(3))
        turned = Superquadric(turned.size, turned.shape, truth.translation, turned.rotation)
        (one,) = turning.update([draw(turned, covariance, rng)], 0.1 * k)
        (other,) = still.update([draw(truth, covariance, rng)], 0.1 * k)
    assert one.id == 1
    assert np.linalg.norm(error_of(one, turned)[0][8:]) < 0.05
    assert (one.sigma_size < 0.6 * other.sigma_size).all()


def test_thirty_directions_halve_the_size_error():
    """Each view hardly tells the extent along itself."""
    first, last = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        truth, tracker = body(centre=(0, 0, 0)), Tracker()
        for k in range(30):
            direction = rng.standard_normal(3)
            pose = looking_at(truth.translation, direction, 0.8)
            along = np.abs(truth.rotation_matrix.T @ direction) / np.linalg.norm(direction)
            covariance = noise(0.03, 0.05, 0.002, 0.03) + np.diag(np.r_[(0.15 * along) ** 2, np.zeros(8)])
            (track,) = tracker.update([from_camera(draw(truth, covariance, rng), *pose)], 0.1 * k, pose)
            if k == 0:
                first.append(np.abs(error_of(track, truth)[0][:3]).mean())
        last.append(np.abs(error_of(track, truth)[0][:3]).mean())
    assert np.mean(last) < 0.5 * np.mean(first)


def test_what_is_half_seen_drags_nothing(rng):
    truth, tracker = body(), Tracker()
    for k in range(10):
        tracker.update([draw(truth, noise(0.02), rng)], 0.1 * k)
    # A third axis that hides: 40 % too short with a deviation of 50 %, the centre shifted along with it.
    column = np.zeros(11)
    column[2], column[5:8] = 0.5, 0.5 * 0.03 * truth.rotation_matrix[:, 2]
    covariance = noise(0.02) + np.outer(column, column)
    for k in range(10, 40):
        (track,) = tracker.update([draw(truth, covariance, rng, error=-1.0 * column)], 0.1 * k)
    error, _ = error_of(track, truth)
    assert track.id == 1
    assert np.abs(error[:3]).max() < 0.03
    assert np.linalg.norm(error[5:8]) < 0.002


def test_one_wrong_valley_changes_little_and_is_forgotten(rng):
    truth, tracker = body(), Tracker()
    for k in range(10):
        (before,) = tracker.update([draw(truth, noise(0.02), rng)], 0.1 * k)
    wrong = np.zeros(11)
    wrong[2] = 0.8
    (after,) = tracker.update([draw(truth, noise(0.02), rng, error=wrong)], 1.0)
    assert after.id == before.id
    assert np.abs(np.log(after.superquadric.size / before.superquadric.size)).max() < 0.05


def test_a_track_that_began_wrongly_gives_way(rng):
    truth, tracker = body(), Tracker()
    wrong = np.zeros(11)
    wrong[2] = 0.8
    tracker.update([draw(truth, noise(0.02), rng, error=wrong)], 0.0)
    for k in range(1, 12):
        (track,) = tracker.update([draw(truth, noise(0.02), rng)], 0.1 * k)
    assert track.id == 1
    assert np.abs(error_of(track, truth)[0][:3]).max() < 0.05


def test_deviations_three_times_too_small_break_nothing(rng):
    """Real objects are no superquadrics, and their fits know less than they say."""
    truths, tracker, covariance = spread_bodies(6, rng), Tracker(), noise(0.04, 0.05, 0.003, 0.05)
    moving = 0
    for k in range(40):
        seen = [draw(t, covariance, rng) for t in truths]
        tracks = tracker.update([one._replace(covariance=one.covariance / 9) for one in seen], 0.1 * k)
        assert [t.id for t in tracks] == [1, 2, 3, 4, 5, 6]
        moving += sum(bool(t.velocity.any()) for t in tracks)
    assert moving < 0.1 * 6 * 40
    errors = [np.abs(error_of(t, truth)[0][:3]).mean() for t, truth in zip(tracks, truths, strict=True)]
    assert np.mean(errors) < 0.04 * np.sqrt(2 / np.pi)


def test_an_unknown_covariance_has_a_default():
    seen = Seen(body(), np.full((11, 11), np.nan))
    (track,) = Tracker().update([seen], 0.0)
    np.testing.assert_allclose(track.sigma_size / track.superquadric.size, np.hypot(0.15, 0.01), rtol=1e-9)


# One form


@pytest.mark.parametrize(
    ("size", "shape"),
    [((0.05, 0.0495, 0.03), (0.2, 0.5)), ((0.05, 0.0495, 0.0502), (0.2, 0.25)), ((0.06, 0.05, 0.04), (0.2, 0.25))],
    ids=["square", "cube", "box"],
)
def test_axes_never_jump(size, shape, rng):
    """300 frames in which the fit names the axes anew each time; also z, where the exponents are alike."""
    truth, tracker = body(size, shape), Tracker()
    last = None
    for k in range(300):
        seen = draw(truth, noise(0.02, 0.03, 0.001, 0.05), rng)
        if shape[1] - shape[0] < 0.1:
            turn = int(rng.integers(24))
            seen = exchanged(seen, turn) if turn >= forms.EXACT else seen
        (track,) = tracker.update([seen], k / 30)
        assert track.id == 1
        if last is not None:
            assert angle_between(track.superquadric, last) < 0.1
            assert np.abs(np.log(track.superquadric.size / last.size)).max() < 0.05
        last = track.superquadric
    assert abs(np.sort(last.size) - np.sort(truth.size)).max() < 0.02 * truth.size.max()


def test_a_round_body_keeps_its_axis_and_learns_no_turn(rng):
    """A can whose turn about its axis nobody knows: its axis stays, and a still camera sees no new sides."""
    truth, tracker = body((0.04, 0.04, 0.06), (0.1, 1.0)), Tracker()
    covariance = noise(0.02, 0.03, 0.001, 0.02)
    covariance[10, 10] = 1.0
    axis = truth.rotation_matrix[:, 2]
    for k in range(150):
        error = rng.multivariate_normal(np.zeros(11), covariance)
        error[10] = rng.uniform(-np.pi, np.pi)
        (track,) = tracker.update([draw(truth, covariance, rng, error=error)], k / 30)
        assert abs(track.superquadric.rotation_matrix[:, 2] @ axis) > 0.995
    assert track.sigma_size.min() > 0.6 * 0.02 * 0.04


# Ids


def crossing(k, rng, same=True):
    """Two bodies that pass each other within 12 cm at 0.45 m/s each."""
    x = -0.3 + 0.015 * k
    a = body(centre=(x, 0.06, 0.8))
    b = body((0.05, 0.04, 0.03) if same else (0.03, 0.03, 0.06), centre=(-x, -0.06, 0.8))
    return [draw(a, noise(), rng), draw(b, noise(), rng)]


@pytest.mark.parametrize("same", [True, False])
def test_ids_survive_a_crossing(same):
    for seed in range(3):
        rng, tracker = np.random.default_rng(seed), Tracker()
        for k in range(41):
            seen = crossing(k, rng, same)
            order = rng.permutation(2)
            tracks = tracker.update([seen[i] for i in order], k / 30)
            assert [t.id for t in tracks] == [1, 2] if k else len(tracks) == 2
            if k == 0:
                expected = {t.id: order[t.observation] for t in tracks}
            assert {t.id: order[t.observation] for t in tracks} == expected
        speed = np.linalg.norm(tracks[0].velocity)
        assert 0.3 < speed < 0.6


def test_ids_survive_an_occlusion_but_not_an_absence(rng):
    """A wall hides one of two bodies for 10 frames; later its place is seen to be empty."""
    left, right = body(centre=(-0.15, 0, 0.8)), body(centre=(0.15, 0, 0.8))
    wall = body((0.12, 0.2, 0.01), (0.1, 0.1), (0.11, 0, 0.5), (0, 0, 0))
    tracker = Tracker()

    def image(bodies):
        depth, _ = render(Superquadric.stack(bodies), CAMERA)
        return np.where(np.isfinite(depth), depth, 1.5).astype(np.float32)

    for k in range(5):
        tracks = tracker.update(
            [draw(left, noise(), rng), draw(right, noise(), rng)], k / 30, camera=CAMERA, depth=image([left, right])
        )
    for k in range(5, 15):
        tracks = tracker.update([draw(left, noise(), rng)], k / 30, camera=CAMERA, depth=image([left, right, wall]))
        assert [t.state for t in tracks] == [TrackState.CONFIRMED, TrackState.LOST]
        assert tracks[1].observation is None
    tracks = tracker.update([draw(left, noise(), rng), draw(right, noise(), rng)], 0.5)
    assert [t.id for t in tracks] == [1, 2]
    counts = [
        len(tracker.update([draw(left, noise(), rng)], 0.5 + k / 30, camera=CAMERA, depth=image([left])))
        for k in range(1, 8)
    ]
    assert counts == [2, 2, 2, 2, 1, 1, 1]
    tracks = tracker.update([draw(left, noise(), rng), draw(right, noise(), rng)], 0.8)
    assert [t.id for t in tracks] == [1, 3]


def test_what_is_there_but_was_not_recovered_does_not_die(rng):
    truth, tracker = body(), Tracker()
    depth, _ = render(truth, CAMERA)
    depth = np.where(np.isfinite(depth), depth, 1.5)
    for k in range(20):
        tracks = tracker.update([draw(truth, noise(), rng)] if k < 4 else [], k / 30, camera=CAMERA, depth=depth)
    assert [t.state for t in tracks] == [TrackState.LOST]


def test_the_caller_may_know_better_what_is_visible(rng):
    tracker = Tracker()
    tracker.update([draw(body(), noise(), rng)], 0.0)
    for k in range(1, 20):
        assert len(tracker.update([], 0.1 * k, expected_visible=lambda track: track.id != 1)) == 1
    assert len(tracker.update([], 2.0, expected_visible=lambda track: True)) == 1
    assert tracker.update([], 2.1, expected_visible=lambda track: True) == ()


def test_nothing_hidden_lives_for_ever(rng):
    tracker = Tracker(TrackerOptions(forget_after=3.0))
    tracker.update([draw(body(), noise(), rng)], 0.0)
    assert len(tracker.update([], 2.9, expected_visible=lambda track: False)) == 1
    assert tracker.update([], 3.1, expected_visible=lambda track: False) == ()


def test_a_new_body_is_tentative_first(rng):
    tracker, strict = Tracker(), Tracker(TrackerOptions(publish_after=2))
    old, new = body(), body(centre=(0.2, 0, 0.8))
    states, published = [], []
    for k in range(6):
        seen = [draw(old, noise(), rng)] + ([draw(new, noise(), rng)] if k >= 3 else [])
        states.append([t.state.value[0] for t in tracker.update(seen, 0.1 * k)])
        published.append(len(strict.update(seen, 0.1 * k)))
    assert states == [["t"], ["t"], ["c"], ["c", "t"], ["c", "t"], ["c", "c"]]
    assert published == [0, 1, 1, 1, 2, 2]


def test_a_moved_body_is_the_same_in_another_place(rng):
    """Pushed by 4 cm, then carried by 30 cm: sizes go on, the pose starts again."""
    tracker, truth = Tracker(), body()
    stamp = 0.0
    for centre, turn, frames in (((0, 0, 0.8), 0.0, 10), ((0.04, 0, 0.8), 0.0, 10), ((0.3, 0.1, 0.9), 1.0, 10)):
        rotation = quaternions.multiply(quaternions.from_rotation_vector(np.array([0, turn, 0])), truth.rotation)
        truth = Superquadric(truth.size, truth.shape, np.array(centre), rotation)
        stamp += 0.4
        for k in range(frames):
            stamp += 0.1
            tracks = tracker.update([draw(truth, noise(), rng)], stamp)
            assert [t.id for t in tracks] == [1]
            if k >= 1:
                assert np.linalg.norm(tracks[0].superquadric.translation - truth.translation) < 0.004
                assert np.linalg.norm(error_of(tracks[0], truth)[0][8:]) < 0.15
    assert tracks[0].seen == 30
    assert not tracks[0].velocity.any()
    assert np.abs(error_of(tracks[0], truth)[0][:3]).max() < 0.04


def test_a_body_set_down_at_once_does_not_run_on(rng):
    """20 cm in a fifth of a second, then at rest, 10 frames a second: no velocity is made up, no id lost."""
    tracker = Tracker()
    for k in range(10):
        tracks = tracker.update([draw(body(centre=(0.2 * (k > 5), 0, 0.8)), noise(), rng)], 0.25 * k)
        assert [t.id for t in tracks] == [1]
        assert not tracks[0].velocity.any()


def test_a_hidden_body_does_not_lend_its_id_to_its_like(rng):
    """Two cans of a kind: one is hidden, then a third comes into view at some distance."""
    hidden, wall = body(), body((0.2, 0.2, 0.01), (0.1, 0.1), (0, 0, 0.5), (0, 0, 0))
    like = body(centre=(0.3, 0, 0.8))
    for camera in (CAMERA, None):
        tracker = Tracker()
        tracker.update([draw(hidden, noise(), rng)], 0.0, camera=camera)
        tracks = tracker.update([draw(wall, noise(), rng), draw(like, noise(), rng)], 0.5, camera=camera)
        assert next(t.id for t in tracks if t.observation == 1) == (3 if camera else 1)
        assert [t.id for t in tracks][:1] == [1]


def test_another_body_elsewhere_is_another_one(rng):
    tracker = Tracker()
    for k in range(4):
        tracker.update([draw(body(), noise(), rng)], 0.1 * k)
    tracks = tracker.update([draw(body((0.03, 0.02, 0.09), centre=(0.08, 0.1, 0.8)), noise(), rng)], 0.5)
    assert [t.id for t in tracks] == [1, 2]
    assert [t.observation for t in tracks] == [None, 0]


def test_a_stamp_that_jumps_back_resets_and_ids_go_on(rng):
    tracker = Tracker()
    tracker.update([draw(body(), noise(), rng)], 10.0)
    (track,) = tracker.update([draw(body(), noise(), rng)], 9.0)
    assert (track.id, track.seen) == (2, 1)


def test_a_long_gap_forgets_the_pose_and_keeps_the_sizes(rng):
    truth, tracker = body(), Tracker()
    for k in range(5):
        tracker.update([draw(truth, noise(), rng)], 0.1 * k)
    pushed = Superquadric(truth.size, truth.shape, truth.translation + [0.05, 0, 0], truth.rotation)
    (track,) = tracker.update([draw(pushed, noise(), rng)], 8.0)
    assert (track.id, track.seen) == (1, 6)
    np.testing.assert_allclose(track.superquadric.translation, pushed.translation, atol=0.004)
    assert not track.velocity.any()


# Frames


def test_a_motion_of_the_world_changes_nothing(rng):
    """All poses moved rigidly: the same numbers, moved."""
    turn, shift = quaternions.random(1, rng)[0], np.array([1.0, -2.0, 0.5])
    truths = spread_bodies(4, rng)
    here, there = Tracker(), Tracker()
    for k in range(12):
        pose = looking_at(truths.translation.mean(axis=0), np.array([np.sin(0.2 * k), 0.3, -np.cos(0.2 * k)]), 2.0)
        shown = truths if k != 6 else truths[:3]
        seen = [from_camera(draw(t, correlated(rng), rng), *pose) for t in shown]
        matrix = np.eye(4)
        matrix[:3, :3] = quaternions.to_matrix(quaternions.multiply(turn, pose[0]))
        matrix[:3, 3] = quaternions.to_matrix(turn) @ pose[1] + shift
        one, other = here.update(seen, 0.1 * k, pose), there.update(seen, 0.1 * k, matrix)
        assert [(t.id, t.state, t.observation) for t in one] == [(t.id, t.state, t.observation) for t in other]
        for a, b in zip(one, other, strict=True):
            carried = a.superquadric.transformed(turn, shift)
            np.testing.assert_allclose(state.difference(carried.to_flat(), b.superquadric.to_flat()), 0, atol=1e-7)
            expected = state.turned(a.covariance, quaternions.to_matrix(turn))
            np.testing.assert_allclose(b.covariance, expected, atol=1e-9)


def test_open_share_knows_the_image_and_what_stands_in_front():
    bodies = Superquadric.stack([body(), body(centre=(3, 0, 0.8)), body(centre=(0, 0, -0.8))])
    np.testing.assert_array_equal(sight.open_share(bodies, CAMERA), [1, 0, 0])
    wall = Superquadric.stack([body((0.2, 0.2, 0.01), (0.1, 0.1), (0, 0, 0.5), (0, 0, 0))])
    np.testing.assert_array_equal(sight.open_share(bodies, CAMERA, others=wall), [0, 0, 0])
    behind = Superquadric.stack([body((0.2, 0.2, 0.01), (0.1, 0.1), (0, 0, 1.2), (0, 0, 0))])
    np.testing.assert_array_equal(sight.open_share(bodies, CAMERA, others=behind), [1, 0, 0])
    for measured, share in ((np.nan, 0), (0.5, 0), (2.0, 1)):
        depth = np.full((CAMERA.height, CAMERA.width), measured)
        np.testing.assert_array_equal(sight.open_share(bodies, CAMERA, depth), [share, 0, 0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"stamp": np.nan}, "stamp"),
        ({"camera_pose": np.eye(3)}, "4 x 4"),
        ({"camera_pose": np.diag([1.0, 1, -1, 1])}, "rigid"),
        ({"camera_pose": (np.zeros(4), np.zeros(3))}, "camera_pose"),
        ({"camera_pose": (np.ones(3), np.zeros(3))}, "shapes"),
        ({"depth": np.zeros((120, 160))}, "camera"),
        ({"depth": np.zeros((10, 10)), "camera": CAMERA}, "fit"),
        ({"recoveries": [Seen(body(), np.eye(3))]}, r"\(11, 11\)"),
        ({"recoveries": [Seen(Superquadric.stack([body()]), np.eye(11))]}, "single"),
    ],
)
def test_misuse_is_named_and_changes_nothing(arguments, message, rng):
    tracker = Tracker()
    tracker.update([draw(body(), noise(), rng)], 0.0)
    with pytest.raises(ValueError, match=message):
        tracker.update(**{"recoveries": [], "stamp": 0.1, **arguments})
    assert len(tracker.update([], 0.1)) == 1


def test_what_was_handed_out_is_the_callers(rng):
    tracker, seen = Tracker(), draw(body(), noise(), rng)
    (track,) = tracker.update([seen], 0.0)
    kept = track.superquadric.to_flat()
    for array in (track.velocity, track.covariance, track.sigma_size):
        array += 1.0
    (after,) = tracker.update([seen], 0.0)
    np.testing.assert_allclose(after.superquadric.to_flat(), kept, atol=1e-12)
    assert not after.velocity.any()


@pytest.mark.parametrize(
    "options", [{"common_share": 1.0}, {"gate": 0}, {"views": 0}, {"patience": 1.5}, {"fastest": -1}, {"view_angle": 4}]
)
def test_options_are_checked(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        TrackerOptions(**options)


def test_twenty_bodies_take_milliseconds(rng):
    """5 ms on an idle core; the bound leaves room for a busy one."""
    truths, tracker = spread_bodies(20, rng), Tracker()
    spent = []
    for k in range(15):
        seen = [draw(t, noise(), rng) for t in truths]
        began = time.perf_counter()
        tracker.update(seen, 0.1 * k)
        spent.append(time.perf_counter() - began)
    assert min(spent) < 0.015


# The real chain


def frames_about(shown, count, step, rng, sigma=0.001):
    """Recovered frames of a camera that is carried about the middle of a table, with its poses and depth images."""
    middle = np.array([0, 0, shown.bodies.translation[:, 2].mean()])
    normal, recoverer = shown.plane[:3], Recoverer(method="symmetry")
    for k in range(count):
        turn = quaternions.from_rotation_vector(step * k * normal)
        position = middle - quaternions.to_matrix(turn) @ middle
        back = quaternions.conjugate(turn)
        matrix = quaternions.to_matrix(back)
        plane = np.append(matrix @ normal, shown.plane[3] + normal @ position)
        moved = scene.Scene(shown.bodies.transformed(back, -matrix @ position), shown.camera, plane)
        depth, labels = moved.render()
        depth = Ideal(sigma).measured(depth, shown.camera, rng)
        yield recoverer.recover(depth, shown.camera, labels), (turn, position), depth


TABLE_CAMERA = Camera(240, 180, 197.0, 197.0, 119.5, 89.5)


def test_a_camera_that_moves_about_a_table(rng):
    """10 recovered frames: one id for each body, sizes that end better than they began, and true deviations."""
    shown = scene.table_scene(np.random.default_rng(5), 2, TABLE_CAMERA)
    tracker, errors = Tracker(), []
    for k, (frame, pose, depth) in enumerate(frames_about(shown, 10, 0.12, rng)):
        tracks = tracker.update(frame.recovered, 0.1 * k, pose, camera=shown.camera, depth=depth)
        assert [t.id for t in tracks] == [1, 2]
        assert all(t.observation is not None for t in tracks)
        truths = [shown.bodies[frame.recovered[t.observation].label - 1] for t in tracks]
        errors.append([np.abs(error_of(t, truth)[0][:3]).mean() for t, truth in zip(tracks, truths, strict=True)])
    assert np.mean(errors[-1]) < max(np.mean(errors[0]), 0.01)
    assert all(nees(t, truth) < chi2.ppf(0.999, 11) for t, truth in zip(tracks, truths, strict=True))
    assert all(t.state is TrackState.CONFIRMED for t in tracks)


def test_boxes_whose_fits_choose_their_z_axis_anew(rng):
    """Two boxes with nearly equal exponents: what the fit calls z changes with the view, the z of the track stays."""
    shown = scene.table_scene(np.random.default_rng(20), 2, TABLE_CAMERA)
    bodies = shown.bodies
    boxes = Superquadric(bodies.size, np.array([[0.2, 0.18], [0.2, 0.23]]), bodies.translation, bodies.rotation)
    tracker, named, last = Tracker(), set(), {}
    for k, (frame, pose, depth) in enumerate(
        frames_about(scene.Scene(boxes, shown.camera, shown.plane), 10, 0.1, rng, 0.0015)
    ):
        for track in tracker.update(frame.recovered, 0.1 * k, pose, camera=shown.camera, depth=depth):
            recovery = frame.recovered[track.observation]
            axis = quaternions.to_matrix(pose[0]) @ recovery.superquadric.rotation_matrix[:, 2]
            truth = boxes[recovery.label - 1]
            named.add((recovery.label, int(np.abs(truth.rotation_matrix.T @ axis).argmax())))
            if track.id in last:
                assert angle_between(track.superquadric, last[track.id]) < 0.1
            last[track.id] = track.superquadric
    assert set(last) == {1, 2}
    assert len(named) > 2
