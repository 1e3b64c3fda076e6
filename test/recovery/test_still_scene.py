"""Frames that repeat others: what stands still is not recovered again, and what changed is noticed at once."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from table_scenes import Table

from sq_perception.fitting.fit import Status
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.recovery import still_scene
from sq_perception.recovery.recoverer import Recoverer, RecoveryOptions
from sq_perception.recovery.still_scene import StillScene
from sq_perception.tracking import state
from sq_perception.tracking.tracker import Tracker

CAMERA = Camera(320, 240, 270.0, 270.0, 159.5, 119.5)
TABLE = Table(np.deg2rad(50), distance=0.8)
PLACES = ((-0.16, 0.0), (0.0, 0.0), (0.16, 0.02))


def standing(x, y, size=(0.04, 0.035, 0.05), shape=(0.3, 0.4), yaw=0.5):
    return TABLE.body(x, y, size, shape, yaw)


STILL = tuple(standing(*place) for place in PLACES)


def image(bodies, seed, camera=CAMERA):
    return TABLE.see(bodies, 0.001, seed, camera)[0]


def changed(k, body):
    return (*STILL[:k], body, *STILL[k + 1 :])


@pytest.fixture(scope="module")
def recoverer():
    return Recoverer(method="symmetry")


def after(recoverer, last, depth, labels=None, options=None, camera=CAMERA):
    """What a frame leaves to the next, itself after another one."""
    return still_scene.follow(recoverer, recoverer.read(depth, camera, labels, options), last)


def with_bodies(last, bodies):
    return replace(last, recovery=replace(last.recovery, bodies=tuple(bodies)))


def repeated(recoverer, last, depth, options=None, camera=CAMERA):
    return still_scene.repeat(last, recoverer.read(depth, camera, None, options))


@pytest.fixture(scope="module")
def first(recoverer):
    return after(recoverer, None, image(STILL, 0))


def place_of(recovery, body):
    return int(np.argmin([np.linalg.norm(one.superquadric.translation - body.translation) for one in recovery.bodies]))


def test_what_stands_still_is_the_frame_alone_within_its_sigma(recoverer, first):
    assert [one.repeats for one in first.recovery.bodies] == [0] * len(STILL)
    scene = StillScene(recoverer, first)
    for seed in range(1, 5):
        depth = image(STILL, seed)
        frame = scene.recover(depth, CAMERA)
        assert [one.repeats for one in frame.bodies] == [seed] * len(STILL)
        assert frame.milliseconds["fit"] == 0
        alone = recoverer.recover(depth, CAMERA)
        for body in frame.bodies:
            other = alone.bodies[place_of(alone, body.superquadric)]
            for part in (state.SIZE, state.CENTRE):
                off = (other.superquadric.to_flat() - body.superquadric.to_flat())[:8][part]
                total = (body.covariance + other.covariance)[part, part]
                assert state.mahalanobis(total, off) < chi2.ppf(1 - 1e-5, 3)


@pytest.mark.parametrize("k", range(3))
@pytest.mark.parametrize(
    "become",
    [
        lambda x, y: standing(x + 0.004, y),
        lambda x, y: standing(x, y - 0.004),
        lambda x, y: standing(x, y, yaw=0.65),
        lambda x, y: standing(x, y, shape=(1.0, 1.0)),
        lambda x, y: standing(x, y, shape=(0.1, 1.0)),
        lambda x, y: standing(x, y, size=(0.04, 0.035, 0.046)),
    ],
    ids=["slid", "drawn nearer", "turned", "swapped for a ball", "swapped for a can", "swapped for a lower one"],
)
def test_a_change_is_noticed_at_once_and_the_others_stand(recoverer, first, k, become):
    became = become(*PLACES[k])
    frame = after(recoverer, first, image(changed(k, became), 7))
    assert len(frame.recovery.bodies) == len(STILL)
    changed_one = place_of(frame.recovery, became)
    for j, one in enumerate(frame.recovery.bodies):
        assert one.repeats == (j != changed_one)
    # And it is known as by the frame alone.
    alone = recoverer.recover(image(changed(k, became), 7), CAMERA)
    np.testing.assert_allclose(
        frame.recovery.bodies[changed_one].superquadric.to_flat(),
        alone.bodies[place_of(alone, became)].superquadric.to_flat(),
        atol=1e-9,
    )


def test_what_is_put_down_or_taken_away_is_noticed_at_once(recoverer, first):
    frame = after(recoverer, first, image((*STILL, standing(0.08, 0.16, size=(0.02, 0.02, 0.025))), 8))
    assert sorted(one.repeats for one in frame.recovery.bodies) == [0, 1, 1, 1]
    frame = after(recoverer, frame, image(STILL[:2], 9))
    assert [one.repeats for one in frame.recovery.bodies] == [2, 2]


def test_readings_that_come_and_go_at_a_hole_are_nothing_new_but_a_thing_in_it_is(recoverer):
    """A hole in the table beside the things, of which a part is measured in the next frame."""
    hole = slice(190, 220), slice(40, 70)
    with_hole = image(STILL, 0)
    with_hole[hole] = np.nan
    first = after(recoverer, None, with_hole)
    smaller = image(STILL, 1)
    smaller[194:216, 44:66] = np.nan
    assert repeated(recoverer, first, smaller).segmentation is not None
    thing = image(STILL, 1)
    thing[hole] -= np.float32(0.03)
    assert repeated(recoverer, first, thing).segmentation is None


def test_a_thing_without_readings_is_gone_at_once_and_no_frame_after_it_fails(recoverer, first):
    """Taken away where nothing is measured behind it, or covered: the band around it reads as before."""
    label = first.recovery.bodies[0].label
    frame = first
    for seed in range(1, 13):  # longer than the turn of a weak body takes
        lost = image(STILL, seed)
        lost[first.recovery.labels == label] = np.nan
        frame = after(recoverer, frame, lost)
        assert len(frame.recovery.bodies) == len(STILL) - 1
        if seed == 1:
            assert [one.repeats for one in frame.recovery.bodies] == [1, 1]
    assert len(after(recoverer, frame, image(STILL, 20)).recovery.bodies) == len(STILL)


def test_given_segments_are_not_taken_for_own_ones(recoverer, first):
    labels = np.where(first.recovery.labels == first.recovery.bodies[0].label, 5, 0).astype(np.int32)
    given = after(recoverer, None, image(STILL, 1), labels)
    assert [one.label for one in given.recovery.bodies] == [5]
    assert len(after(recoverer, given, image(STILL, 2)).recovery.bodies) == len(STILL)


def test_slow_motion_adds_up_until_it_is_noticed(recoverer, first):
    frame, x = first, PLACES[1][0]
    for step in range(1, 16):
        x += 0.0005
        body = standing(x, PLACES[1][1])
        frame = after(recoverer, frame, image(changed(1, body), 20 + step))
        found = frame.recovery.bodies[place_of(frame.recovery, body)]
        if found.repeats == 0:
            break
    assert 0 < step * 0.5 < 4
    assert np.linalg.norm(found.superquadric.translation - body.translation) < 0.003


def test_a_camera_that_moved_repeats_nothing(recoverer, first):
    def moved(shift, turn=(0, 0, 0)):
        turn = quaternions.from_rotation_vector(np.array(turn))
        return [one.transformed(turn, np.array(shift)) for one in STILL]

    for bodies in (moved((0.01, 0, 0)), moved((0, 0, 0), (0, 0, 0.03))):
        # The table is not seen to move by these: the bodies have to tell.
        assert not any(one.repeats for one in after(recoverer, first, image(bodies, 3)).recovery.bodies)
    assert repeated(recoverer, first, image(STILL, 4) - np.float32(0.004)) is still_scene.NOTHING


def test_other_options_cameras_and_segments_repeat_nothing(recoverer, first):
    depth = image(STILL, 5)
    options = RecoveryOptions(method="symmetry")
    assert repeated(recoverer, first, depth, options).segmentation is not None
    assert not repeated(recoverer, first, depth, replace(options, max_size=0.5)).bodies
    assert not repeated(recoverer, first, depth, options, replace(CAMERA, cx=150.0)).bodies
    small = Camera(60, 40, 50.0, 50.0, 29.5, 19.5)
    assert not after(recoverer, first, np.full((40, 60), 1, np.float32), camera=small).recovery.bodies
    halves = np.where(first.recovery.labels == 1, np.where(np.arange(CAMERA.width) % 2, 7, 8), first.recovery.labels)
    frame = after(recoverer, first, depth, halves)
    assert {one.label: one.repeats for one in frame.recovery.bodies} == {2: 1, 3: 1, 7: 0, 8: 0}


def test_options_are_compared_whatever_sequences_they_are_given_as(recoverer):
    box, turn, nowhere = (-5.0, -5.0, -5.0, 5.0, 5.0, 5.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
    as_tuples = RecoveryOptions(
        method="symmetry", depth_range=(0.0, 5.0), workspace=box, workspace_pose=(turn, nowhere)
    )
    as_arrays = RecoveryOptions(
        method="symmetry",
        depth_range=np.array([0.0, 5.0]),
        workspace=np.array(box),
        workspace_pose=(np.array(turn), np.array(nowhere)),
    )
    frame = after(recoverer, None, image(STILL, 0), options=as_tuples)
    frame = after(recoverer, frame, image(STILL, 5), options=as_arrays)
    assert [one.repeats for one in frame.recovery.bodies] == [1, 1, 1]


def test_given_masks_that_stay_repeat_too_unless_their_labels_are_huge(recoverer):
    """Tables by label would be larger than the memory."""
    _, index = raycast.render(Superquadric.stack(list(STILL)), CAMERA)
    labels = (index + 1).astype(np.int32)
    before = after(recoverer, None, image(STILL, 10), labels)
    following = after(recoverer, before, image(STILL, 11), labels)
    assert [one.repeats for one in following.recovery.bodies] == [1, 1, 1]
    labels = np.where(index >= 0, 2**31 - 1 - index, 0).astype(np.int32)
    again = after(recoverer, after(recoverer, None, image(STILL, 0), labels), image(STILL, 1), labels)
    assert sorted(body.label for body in again.recovery.bodies) == [2**31 - 3, 2**31 - 2, 2**31 - 1]
    assert not any(body.repeats for body in again.recovery.bodies)


@pytest.mark.parametrize("status", [Status.CONVERGED, Status.WEAK])
def test_each_body_has_its_turn_one_at_a_time_and_a_weak_one_sooner(recoverer, first, status):
    limit = {Status.CONVERGED: 30, Status.WEAK: 10}[status]
    bodies = [
        replace(one, fit=replace(one.fit, status=status), repeats=limit + k)
        for k, one in enumerate(first.recovery.bodies)
    ]
    kept = repeated(recoverer, with_bodies(first, bodies), image(STILL, 1))
    assert set(kept.bodies) == {one.label for one in bodies[:-1]}
    assert kept.segmentation is first.segmentation
    young = [replace(one, repeats=limit - 1) for one in bodies]
    assert repeated(recoverer, with_bodies(first, young), image(STILL, 1)).segmentation is not None


def test_a_turn_takes_the_old_segments_until_they_are_old(recoverer, first):
    """The body is fitted to the new readings of the same pixels, unless something moved or the segments are old."""
    waiting = with_bodies(first, [replace(first.recovery.bodies[0], repeats=30), *first.recovery.bodies[1:]])
    frame = after(recoverer, waiting, image(STILL, 1))
    assert [one.repeats for one in frame.recovery.bodies] == [0, 1, 1]
    assert frame.recovery.labels is first.recovery.labels
    assert frame.age == 1
    here = frame.recovery.labels[:: frame.stride, :: frame.stride]
    assert (frame.depth != first.depth)[here == frame.recovery.bodies[0].label].all()
    assert (frame.depth == first.depth)[here == frame.recovery.bodies[1].label].all()
    alone = recoverer.recover(image(STILL, 1), CAMERA, first.recovery.labels)
    np.testing.assert_allclose(
        frame.recovery.bodies[0].superquadric.to_flat(), alone.bodies[0].superquadric.to_flat(), atol=2e-3
    )

    assert after(recoverer, first, image(STILL, 2)).age == 1
    frame = after(recoverer, replace(waiting, age=30), image(STILL, 1))
    assert frame.recovery.labels is not first.recovery.labels
    assert frame.age == 0
    moved = after(recoverer, waiting, image(changed(1, standing(0.02, 0.0)), 3))
    assert moved.recovery.labels is not first.recovery.labels, "another one was pushed while it was this one's turn"


def test_outliers_of_a_segment_are_none_of_its_body_when_its_turn_comes():
    """With the network of masks: the pixels that it took from a segment stay taken."""
    recoverer = Recoverer()
    first = after(recoverer, None, image(STILL, 0))
    segments = first.segmentation
    mask = first.recovery.labels == first.recovery.bodies[0].label
    taken = mask & (np.arange(CAMERA.width) > np.median(np.nonzero(mask)[1]))
    half = replace(segments, membership=np.where(taken, 0, 1).astype(np.float32))
    waiting = with_bodies(first, [replace(first.recovery.bodies[0], repeats=30), *first.recovery.bodies[1:]])
    waiting = replace(waiting, segmentation=half)
    frame = after(recoverer, waiting, image(STILL, 1))
    assert frame.recovery.bodies[0].repeats == 0
    assert frame.segmentation is half
    whole = recoverer.recover(image(STILL, 1), CAMERA, first.recovery.labels)
    assert (
        np.linalg.norm(frame.recovery.bodies[0].superquadric.to_flat() - whole.bodies[0].superquadric.to_flat()) > 1e-3
    )


def test_a_tracker_counts_the_error_of_a_repeated_answer_once(recoverer, first):
    tracker, frame = Tracker(), first
    before = tracker.update(first.recovery.recovered, 0.0)
    for seed in range(1, 6):
        frame = after(recoverer, frame, image(STILL, seed))
        tracks = tracker.update(frame.recovery.recovered, seed / 30)
    for old, new in zip(before, tracks, strict=True):
        np.testing.assert_array_equal(new.superquadric.to_flat(), old.superquadric.to_flat())
        assert (new.sigma_size >= old.sigma_size).all()
        assert new.follows
        assert new.seen == 6
    # The same answers as new ones: six looks would be surer, and are not.
    fooled = Tracker()
    for k in range(6):
        surer = fooled.update(first.recovery.recovered, k / 30)
    assert all((a.sigma_size < b.sigma_size).all() for a, b in zip(surer, tracks, strict=True))
