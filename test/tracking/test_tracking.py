"""Tracking: ids that last through crossings, hands and hiding, whatever frame the world has."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2
from tracked_bodies import (
    CAMERA,
    NOTHING,
    Seen,
    angle_between,
    body,
    correlated,
    draw,
    error_of,
    from_camera,
    image_of,
    looking_at,
    nees,
    noise,
    spread_bodies,
)

from sq_perception import Camera, Recoverer, Superquadric
from sq_perception.geometry import rotation as quaternions
from sq_perception.simulation import scenes
from sq_perception.simulation.sensor_noise import Ideal
from sq_perception.tracking import association, state, visibility
from sq_perception.tracking import tracker as tracker_module
from sq_perception.tracking.tracker import FORGET_AFTER, Tracker, TrackState

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
        assert 0.3 < np.linalg.norm(tracks[0].velocity) < 0.6


def test_ids_survive_an_occlusion_but_not_an_absence(rng):
    """A wall hides one of two bodies for 10 frames; later its place is seen to be empty."""
    left, right = body(centre=(-0.15, 0, 0.8)), body(centre=(0.15, 0, 0.8))
    wall = body((0.12, 0.2, 0.01), (0.1, 0.1), (0.11, 0, 0.5), (0, 0, 0))
    tracker = Tracker()
    for k in range(5):
        seen = [draw(left, noise(), rng), draw(right, noise(), rng)]
        tracks = tracker.update(seen, k / 30, camera=CAMERA, depth=image_of([left, right]))
    for k in range(5, 15):
        tracks = tracker.update([draw(left, noise(), rng)], k / 30, camera=CAMERA, depth=image_of([left, right, wall]))
        assert [t.state for t in tracks] == [TrackState.CONFIRMED, TrackState.LOST]
        assert tracks[1].observation is None
    tracks = tracker.update([draw(left, noise(), rng), draw(right, noise(), rng)], 0.5)
    assert [t.id for t in tracks] == [1, 2]
    alone, counts = image_of([left]), []
    for k in range(1, 8):
        counts.append(len(tracker.update([draw(left, noise(), rng)], 0.5 + k / 30, camera=CAMERA, depth=alone)))
    assert counts == [2, 2, 2, 2, 1, 1, 1]
    tracks = tracker.update([draw(left, noise(), rng), draw(right, noise(), rng)], 0.8)
    assert [t.id for t in tracks] == [1, 3]


def test_what_is_hidden_or_not_recovered_does_not_die_but_lives_not_for_ever(rng):
    truth, tracker = body(), Tracker()
    depth = image_of(truth)
    for k in range(20):
        tracks = tracker.update([draw(truth, noise(), rng)] if k < 4 else [], k / 30, camera=CAMERA, depth=depth)
    assert [t.state for t in tracks] == [TrackState.LOST]
    tracker = Tracker()
    tracker.update([draw(body(), noise(), rng)], 0.0)
    assert len(tracker.update([], FORGET_AFTER - 0.1, camera=CAMERA, depth=NOTHING)) == 1
    assert tracker.update([], FORGET_AFTER + 0.1, camera=CAMERA, depth=NOTHING) == ()
    tracker, masked = Tracker(), np.ma.masked_array(np.full((CAMERA.height, CAMERA.width), 9.0), True)
    tracker.update([draw(body(), noise(), rng)], 0.0)
    for k in range(1, 60):
        tracks = tracker.update([], FORGET_AFTER * k / 100, camera=CAMERA, depth=masked)
    assert len(tracks) == 1


STRAIGHT = {"turn": (0, 0, 0)}
WHOLE, CUT, REST = body((0.06, 0.05, 0.05), **STRAIGHT), body((0.05,) * 3, centre=(0.475, 0, 0.8), **STRAIGHT), body()
PIECE, BESIDE = (body((0.02,) * 3, centre=(x, 0, 0.8), **STRAIGHT) for x in (0.05, 0.085))


@pytest.mark.parametrize(
    ("stays", "other", "scene", "lives"),
    [
        (WHOLE, PIECE, [WHOLE, BESIDE], False),
        (WHOLE, BESIDE, [WHOLE, BESIDE], True),
        (REST, CUT, [REST], False),
        (REST, CUT, [REST, CUT], True),
    ],
    ids=["a piece of it", "beside it", "cut by the border, gone", "cut by the border, there"],
)
def test_what_is_recovered_no_more_lives_as_long_as_the_image_shows_it(rng, stays, other, scene, lives):
    """A piece lies in what is seen whole, though its centre is no nearer to the whole one's than another thing's may
    be; a third of what the border cuts would be within the image, where the table is seen, or it."""
    depth, tracker = image_of(scene), Tracker()
    for k in range(20):
        seen = [draw(each, noise(), rng) for each in ([stays, other] if k < 4 else [stays])]
        tracks = tracker.update(seen, k / 30, camera=CAMERA, depth=depth)
    assert [t.id for t in tracks] == ([1, 2] if lives else [1])


def test_a_new_body_is_tentative_first(rng):
    tracker = Tracker()
    old, new = body(), body(centre=(0.2, 0, 0.8))
    states = []
    for k in range(6):
        seen = [draw(old, noise(), rng)] + ([draw(new, noise(), rng)] if k >= 3 else [])
        states.append([t.state.value[0] for t in tracker.update(seen, 0.1 * k)])
    assert states == [["t"], ["t"], ["c"], ["c", "t"], ["c", "t"], ["c", "c"]]


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
    """20 cm in a quarter of a second, then at rest: no velocity is made up, no id lost."""
    tracker = Tracker()
    for k in range(10):
        tracks = tracker.update([draw(body(centre=(0.2 * (k > 5), 0, 0.8)), noise(), rng)], 0.25 * k)
        assert [t.id for t in tracks] == [1]
        assert not tracks[0].velocity.any()


def test_a_hidden_body_does_not_lend_its_id_to_its_like(rng):
    """Two cans of a kind: one is hidden, then a third comes into view at some distance."""
    hidden, wall = body(), body((0.2, 0.2, 0.01), (0.1, 0.1), (0, 0, 0.5), (0, 0, 0))
    like = body(centre=(0.3, 0, 0.8))
    for frame in ({"camera": CAMERA, "depth": image_of([hidden, wall, like], np.inf)}, {}):
        tracker = Tracker()
        tracker.update([draw(hidden, noise(), rng)], 0.0)
        tracks = tracker.update([draw(wall, noise(), rng), draw(like, noise(), rng)], 0.5, **frame)
        assert next(t.id for t in tracks if t.observation == 1) == (3 if frame else 1)
        assert [t.id for t in tracks][:1] == [1]


def test_a_piece_cut_off_does_not_become_a_rival(rng):
    """A segmentation cuts a body in two, for one frame and for five: the larger piece has its id."""
    truth, tracker = body((0.06, 0.04, 0.03)), Tracker()
    halves = [
        body((0.03 + s * 0.008, 0.04, 0.03), centre=truth.translation + s * 0.015 * truth.rotation_matrix[:, 0])
        for s in (1, -1)
    ]
    loose = noise(0.1, 0.1, 0.01, 0.1)
    for k in range(40):
        cut = k == 10 or 20 <= k < 25
        seen = [draw(half, loose, rng) for half in halves] if cut else [draw(truth, noise(), rng)]
        tracks = tracker.update(seen, 0.1 * k)
        assert next(t.id for t in tracks if t.observation == 0) == 1
        assert len({t.id for t in tracks if t.observation is not None}) == len(seen)
    assert [t.id for t in tracks] == [1]


def test_many_tracks_are_no_burden(rng, monkeypatch):
    """A new body in another place each frame, the older ones hidden: the oldest are given up."""
    monkeypatch.setattr(tracker_module, "MOST", 5)
    tracker = Tracker()
    for k in range(12):
        seen = draw(body(centre=(0.3 * k, 0, 0.8)), noise(), rng)
        tracks = tracker.update([seen], 0.01 * k, camera=CAMERA, depth=NOTHING)
    assert [t.id for t in tracks] == [8, 9, 10, 11, 12]
    assert tracker.births == 12


def test_a_body_that_jumps_is_said_not_to_be_followed_at_first(rng):
    tracker, follows = Tracker(), []
    for k in range(12):
        (track,) = tracker.update([draw(body(centre=(0.03 * (k > 5), 0, 0.8)), noise(), rng)], 0.1 * k)
        follows.append(track.follows)
    assert follows == [k != 6 for k in range(12)]
    assert not tracker.update([], 1.3)[0].follows


def test_another_body_elsewhere_is_another_one_and_a_long_gap_forgets_the_pose_and_keeps_the_sizes(rng):
    truth, tracker, other = body(), Tracker(), Tracker()
    for k in range(5):
        for each in (tracker, other):
            each.update([draw(truth, noise(), rng)], 0.1 * k)
    tracks = other.update([draw(body((0.03, 0.02, 0.09), centre=(0.08, 0.1, 0.8)), noise(), rng)], 0.6)
    assert [(t.id, t.observation) for t in tracks] == [(1, None), (2, 0)]
    pushed = Superquadric(truth.size, truth.shape, truth.translation + [0.05, 0, 0], truth.rotation)
    (track,) = tracker.update([draw(pushed, noise(), rng)], 8.0)
    assert (track.id, track.seen) == (1, 6)
    np.testing.assert_allclose(track.superquadric.translation, pushed.translation, atol=0.004)
    assert not track.velocity.any()


def test_a_motion_of_the_world_changes_nothing(rng):
    """All poses moved rigidly: the same numbers, moved, also of a first look that leaves one direction open."""
    turn, shift = quaternions.random(1, rng)[0], np.array([1.0, -2.0, 0.5])
    truths = spread_bodies(4, rng)
    here, there = Tracker(), Tracker()
    for k in range(12):
        pose = looking_at(truths.translation.mean(axis=0), np.array([np.sin(0.2 * k), 0.3, -np.cos(0.2 * k)]), 2.0)
        shown = truths if k != 6 else truths[:3]
        loose = np.diag([0.0] * 7 + [(k == 0) * 0.02**2] + [0.0] * 3)
        seen = [from_camera(draw(t, correlated(rng) + loose, rng), *pose) for t in shown]
        matrix = np.eye(4)
        matrix[:3, :3] = quaternions.to_matrix(quaternions.multiply(turn, pose[0]))
        matrix[:3, 3] = quaternions.to_matrix(turn) @ pose[1] + shift
        one, other = here.update(seen, 0.1 * k, pose), there.update(seen, 0.1 * k, matrix)
        assert [(t.id, t.state, t.observation) for t in one] == [(t.id, t.state, t.observation) for t in other]
        for a, b in zip(one, other, strict=True):
            carried = a.superquadric.transformed(turn, shift)
            np.testing.assert_allclose(state.difference(carried.to_flat(), b.superquadric.to_flat()), 0, atol=1e-7)
            expected = state.rotate(a.covariance, quaternions.to_matrix(turn))
            np.testing.assert_allclose(b.covariance, expected, atol=1e-9)


@pytest.mark.parametrize("speed", [0.4, 0.6, 0.7, 0.8, 0.95])
def test_equal_things_on_a_belt_keep_their_ids(rng, speed):
    """Up to the speed of a hand: what a track has not followed yet lies farther from it than one frame's way."""
    tracker, ids = Tracker(), {k: set() for k in range(4)}
    for k in range(30):
        places = [-0.15 * n + speed * k / 30 for n in ids]
        seen = [draw(body(centre=(x, 0, 0.8)), noise(0.01), rng) for x in places]
        for track in tracker.update(seen, k / 30):
            if track.observation is not None:
                ids[track.observation].add(track.id)
    assert ids == {n: {n + 1} for n in ids}


def test_open_share_knows_the_image_and_what_stands_in_front():
    bodies = Superquadric.stack([body(), body(centre=(3, 0, 0.8)), body(centre=(0, 0, -0.8))])
    for measured, share in ((np.nan, 0), (0.5, 0), (2.0, 1)):
        depth = np.full((CAMERA.height, CAMERA.width), measured)
        np.testing.assert_array_equal(visibility.open_share(bodies, CAMERA, depth), [share, 0, 0])


@pytest.mark.parametrize("nothing", [np.nan, 0.0])
def test_what_is_gone_is_seen_to_have_gone_by_an_image_of_single_readings(nothing):
    """Of depth registered to three times as many pixels a side hardly a point of a body has a reading of its own."""
    row, column = np.indices((CAMERA.height, CAMERA.width))
    depth = np.where((row % 3 == 1) & (column % 3 == 1), 2.0, nothing)
    bodies = Superquadric.stack([body(), body(centre=(0.05, 0.03, 0.7)), body(centre=(0, 0, 3))])
    np.testing.assert_array_equal(visibility.open_share(bodies, CAMERA, depth), [1, 1, 0])


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
        ({"depth": np.full((CAMERA.height, CAMERA.width), 500, np.uint16), "camera": CAMERA}, "float image"),
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
        moved = scenes.Scene(shown.bodies.transformed(back, -matrix @ position), shown.camera, plane)
        depth, labels = moved.render()
        depth = Ideal(sigma).measure(depth, shown.camera, rng)
        yield recoverer.recover(depth, shown.camera, labels), (turn, position), depth


TABLE_CAMERA = Camera(240, 180, 197.0, 197.0, 119.5, 89.5)


def test_a_camera_that_moves_about_a_table(rng):
    """10 recovered frames: one id for each body, sizes that end better than they began, and true deviations."""
    shown = scenes.table_scene(np.random.default_rng(5), 2, TABLE_CAMERA)
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
    shown = scenes.table_scene(np.random.default_rng(20), 2, TABLE_CAMERA)
    bodies = shown.bodies
    boxes = Superquadric(bodies.size, np.array([[0.2, 0.18], [0.2, 0.23]]), bodies.translation, bodies.rotation)
    tracker, named, last = Tracker(), set(), {}
    for k, (frame, pose, depth) in enumerate(
        frames_about(scenes.Scene(boxes, shown.camera, shown.plane), 10, 0.1, rng, 0.0015)
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


def test_limits_of_chi_squared_and_cheapest_pairs_are_scipys_also_where_many_cost_the_same(rng):
    for freedom, limit in association.LIMITS.items():
        assert limit == pytest.approx(chi2.ppf(0.999, freedom), rel=1e-12)
    for _ in range(300):
        cost = rng.normal(size=np.sort(rng.integers(1, 9, 2)))
        cost[rng.random(cost.shape) < 0.5] = 2.0
        pairs = association.cheapest(cost)
        assert (pairs.sum(axis=1) == 1).all()
        assert (pairs.sum(axis=0) <= 1).all()
        assert cost[pairs].sum() == pytest.approx(cost[linear_sum_assignment(cost)].sum())
