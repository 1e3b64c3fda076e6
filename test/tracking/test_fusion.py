"""Fusion of views: one form that lasts, sizes that sharpen, and deviations that are true."""

import numpy as np
import pytest
from scipy.stats import chi2
from tracked_bodies import (
    CAMERA,
    NOTHING,
    Seen,
    angle_between,
    assert_chi_square,
    body,
    correlated,
    draw,
    error_of,
    exchanged,
    from_camera,
    looking_at,
    nees,
    noise,
    nothing_but_the_covariances,
    spread_bodies,
)

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.tracking import association, state
from sq_perception.tracking.tracker import PREDICTED_SHARE, Tracker

# Forms


def test_forms_are_the_equivalent_ones_and_all_are_one_body_where_the_exponents_are_equal(rng):
    truth = body()
    flats = association.candidates(truth.to_flat())[: association.EXACT]
    for other in truth.equivalent_forms():
        same = [
            np.allclose(flat[:8], other.to_flat()[:8]) and quaternions.geodesic_angle(flat[8:], other.rotation) < 1e-7
            for flat in flats
        ]
        assert sum(same) == 1
    truth = body(shape=(0.4, 0.4))
    points = truth.translation + rng.uniform(-0.06, 0.06, (200, 3))
    for flat in association.candidates(truth.to_flat()):
        np.testing.assert_allclose(Superquadric.from_flat(flat).gauge(points), truth.gauge(points), rtol=1e-9)


def test_the_nearest_form_undoes_any_exact_one_with_its_covariance(rng):
    truth, covariance = body(), correlated(rng)
    for form in range(8):
        seen = draw(truth, covariance, rng, form, np.zeros(11))
        states, covariances = association.nearest_form(
            truth.to_flat()[None], state.scale_sizes(noise(), truth.size)[None], seen.superquadric.to_flat()[None],
            seen.covariance[None],
        )
        np.testing.assert_allclose(state.difference(truth.to_flat(), states[0]), 0, atol=1e-9)
        np.testing.assert_allclose(covariances[0], state.scale_sizes(covariance, truth.size), atol=1e-12)


def test_z_changes_places_only_where_the_exponents_are_alike(rng):
    """A box is recognised with any axis as z; a cylinder is not, as none of its other axes is one of revolution."""
    for shape, allowed in (((0.2, 0.3), True), ((0.2, 0.9), False)):
        truth = body(shape=shape)
        flat = association.candidates(truth.to_flat())
        flat[:, 3:5] = shape
        count = len(flat)
        states, _ = association.nearest_form(
            np.tile(truth.to_flat(), (count, 1)), state.scale_sizes(noise(), np.tile(truth.size, (count, 1))), flat,
            state.scale_sizes(noise(), flat[:, :3]),
        )
        turn = quaternions.geodesic_angle(states[:, 8:12], truth.rotation)
        assert (turn[: association.EXACT] < 1e-6).all()
        assert (turn[association.EXACT :] < 1e-6).all() == allowed


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_nees_of_independent_views(share, rng, monkeypatch):
    """20 bodies, each frame from another side: the errors are as large as the covariances say."""
    truths = spread_bodies(20, rng)
    tracker = nothing_but_the_covariances(monkeypatch, share, 0.0)
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


def test_nees_of_one_view_with_a_common_error(rng, monkeypatch):
    """A still camera repeats its error; 50 frames from two sides are as good as they are said to be."""
    truths = spread_bodies(20, rng)
    tracker = nothing_but_the_covariances(monkeypatch, 0.5, 0.0)
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
    assert (other.sigma_size < 0.95 * track.sigma_size).all()


def test_no_number_of_views_lessens_what_all_have_in_common(rng, monkeypatch):
    """An error of the same size on all of 30 sides: the deviation falls to its share and tells the truth."""
    truths, tracker = spread_bodies(20, rng), nothing_but_the_covariances(monkeypatch, 0.25, 0.25)
    covariance = noise()
    middle = truths.translation.mean(axis=0)
    lasting = rng.multivariate_normal(np.zeros(11), 0.25 * covariance, 20)
    for k in range(30):
        pose = looking_at(middle, rng.standard_normal(3), 20.0)
        errors = lasting + rng.multivariate_normal(np.zeros(11), 0.75 * covariance, 20)
        seen = [from_camera(draw(t, covariance, rng, error=e), *pose) for t, e in zip(truths, errors, strict=True)]
        tracks = tracker.update(seen, 0.1 * k, pose)
        if k == 0:
            first = np.array([t.sigma_size / t.superquadric.size for t in tracks])
    last = np.array([t.sigma_size / t.superquadric.size for t in tracks])
    np.testing.assert_allclose(last, 0.5 * first, rtol=0.2)
    sizes = [np.abs(error_of(t, truth)[0][:3]) for t, truth in zip(tracks, truths, strict=True)]
    assert np.mean(np.array(sizes) < 2 * last) > 0.9


def test_most_of_what_a_prediction_errs_by_is_the_same_from_everywhere(rng):
    """Of 20 bodies whose sizes err alike on all of 30 sides, by the share that predictions have in common."""
    truths = spread_bodies(20, rng)
    covariance, trackers = noise(), (Tracker(), Tracker())
    middle, share = truths.translation.mean(axis=0), np.sqrt(PREDICTED_SHARE)
    lasting = share * rng.multivariate_normal(np.zeros(11), covariance, 20)
    for k in range(30):
        pose = looking_at(middle, rng.standard_normal(3), 20.0)
        errors = lasting + np.sqrt(1 - share**2) * rng.multivariate_normal(np.zeros(11), covariance, 20)
        seen = [from_camera(draw(t, covariance, rng, error=e), *pose) for t, e in zip(truths, errors, strict=True)]
        measured, predicted = (
            each.update([one._replace(is_predicted=flag) for one in seen], 0.1 * k, pose)
            for each, flag in zip(trackers, (False, True), strict=True)
        )
    for tracks, least, most in ((measured, 0.0, 0.9), (predicted, 0.9, 1.0)):
        deviation = np.array([t.sigma_size / t.superquadric.size for t in tracks])
        errors = [np.abs(error_of(t, truth)[0][:3]) for t, truth in zip(tracks, truths, strict=True)]
        assert least < np.mean(np.array(errors) < 2 * deviation) <= most


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
    relative = [t.sigma_size / t.superquadric.size for t in (one, other)]
    assert (relative[0] < 0.75 * relative[1]).all()


def test_what_is_half_seen_drags_nothing(rng):
    truth, tracker = body(), Tracker()
    for k in range(10):
        tracker.update([draw(truth, noise(0.02), rng)], 0.1 * k)
    # A third axis that hides: 40 % too short with a deviation of 50 %, the centre shifted along with it.
    column = np.zeros(11)
    column[2], column[5:8] = 0.5, 0.5 * 0.03 * truth.rotation_matrix[:, 2]
    covariance = noise(0.02) + np.outer(column, column)
    for k in range(10, 40):
        (track,) = tracker.update([draw(truth, covariance, rng, error=-0.8 * column)], 0.1 * k)
    error, _ = error_of(track, truth)
    assert track.id == 1
    assert np.abs(error[:3]).max() < 0.03
    assert np.linalg.norm(error[5:8]) < 0.002


@pytest.mark.parametrize("thick", [(0.015, 0.003), (0.003, 0.015)])
@pytest.mark.parametrize("shift", [1.0, 0.0, -1.0])
def test_what_is_flat_and_unsure_becomes_no_thicker_than_it_was_seen(thick, shift):
    """A plate taken for one of half the height 15 mm, then 3 mm, 13 mm unsure, along with its centre: from its bottom
    up, with its centre kept, or from its top down."""
    tracker = Tracker()
    along = np.zeros(11)
    along[[2, 7]] = 0.013
    covariance = np.diag(np.square([0.013, 0.013, 0.002, 0.05, 0.05, *[0.002] * 3, 0.05, 0.05, 1.0]))
    for k in range(30):
        half = thick[k // 4 % 2]
        plate = body((0.105, 0.105, half), (0.1, 1.0), centre=(0, 0, 0.7 + shift * half), turn=(0, 0, 0))
        (track,) = tracker.update([Seen(plate, covariance + np.outer(along, along))], k / 30)
        assert track.id == 1
        assert 0.0029 < track.superquadric.size[2] < 0.0151
        np.testing.assert_allclose(track.superquadric.size[:2], 0.105, atol=0.005)


def test_one_wrong_valley_changes_little_and_a_track_that_began_in_it_gives_way(rng):
    truth, tracker = body(), Tracker()
    for k in range(10):
        (before,) = tracker.update([draw(truth, noise(0.02), rng)], 0.1 * k)
    wrong = np.zeros(11)
    wrong[2] = 1.2
    (after,) = tracker.update([draw(truth, noise(0.02), rng, error=wrong)], 1.0)
    assert after.id == before.id
    assert np.abs(np.log(after.superquadric.size / before.superquadric.size)).max() < 0.05
    truth, tracker = body(), Tracker()
    wrong = np.zeros(11)
    wrong[2] = 1.2
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


@pytest.mark.parametrize("loose", [noise(0.5, 0.3, 0.02, 0.3), state.diagonal(0.01, 0.02, 0.001, 0.02)])
def test_a_first_look_past_a_hand_leaves_no_doubt_in_those_that_follow(loose, rng):
    """A still camera; of the second body the first frame leaves one size open alone.  All is known soon after."""
    truth, tracker, sure = body(), Tracker(), noise(0.01, 0.02, 0.001, 0.02)
    loose[0, 0] = 0.5**2
    for k in range(20):
        (track,) = tracker.update([draw(truth, loose if k == 0 else sure, rng, form=0)], 0.1 * k)
        assert track.id == 1
        assert np.linalg.eigvalsh(track.covariance).min() > 0
    relative = track.sigma_size / truth.size
    assert relative.max() < 0.02
    assert relative.min() > 0.5 * 0.01, "a still camera averages no more out than before"
    assert nees(track, truth) < chi2.ppf(0.999, 11)


@pytest.mark.parametrize("rate", [2, 30])
def test_a_hidden_pose_is_forgotten_once_at_any_frame_rate(rate, rng):
    tracker = Tracker()
    tracker.update([draw(body(), noise(), rng)], 0.0)
    for k in range(1, 20 * rate):
        (track,) = tracker.update([], k / rate, camera=CAMERA, depth=NOTHING)
    np.testing.assert_allclose(np.sqrt(np.diag(track.covariance)[5:]), 1.0, rtol=0.01)


def test_exact_bodies_are_fused_to_themselves_and_unknown_covariances_have_a_default():
    truth, tracker = body(), Tracker()
    (unknown,) = Tracker().update([Seen(truth, np.full((11, 11), np.nan))], 0.0)
    np.testing.assert_allclose(unknown.sigma_size / truth.size, np.hypot(0.15, 0.01), rtol=1e-9)
    for k in range(5):
        (track,) = tracker.update([Seen(truth, np.zeros((11, 11)))], 0.1 * k)
    assert (track.id, track.seen) == (1, 5)
    np.testing.assert_allclose(track.superquadric.to_flat(), truth.to_flat(), atol=1e-12)
    assert np.linalg.eigvalsh(track.covariance).min() > 0


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
            seen = exchanged(seen, turn) if turn >= association.EXACT else seen
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
