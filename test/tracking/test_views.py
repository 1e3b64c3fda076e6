"""A still scene, whose axes keep their names, and several cameras: what one leaves open another one tells."""

import numpy as np
import pytest
from tracked_bodies import (
    CAMERA,
    Seen,
    body,
    draw,
    error_of,
    from_camera,
    image_of,
    looking_at,
    nees,
    noise,
    spread_bodies,
)
from tracked_bodies import angle_between as turn

from sq_perception import Recoverer, Superquadric
from sq_perception.simulation.scenes import table_scene
from sq_perception.simulation.sensor_noise import preset
from sq_perception.tracking import state
from sq_perception.tracking.session import TrackingSession
from sq_perception.tracking.views import View, fuse_views

FRAMES = 13


@pytest.fixture(scope="module")
def recoverer():
    return Recoverer()


@pytest.mark.parametrize(("seed", "has_masks"), [(5, True), (6, False), (15, False)])
def test_axes_keep_their_names_in_a_still_scene(recoverer, seed, has_masks):
    """Round bodies, whose turn no image tells, and boxes and ovals, of which fits take now this axis as z, now that."""
    scene, noise = table_scene(np.random.default_rng(seed), 5), preset("realsense_d435")
    rng = np.random.default_rng([seed, 1])
    depth, labels = scene.render()
    sessions = {"tracked": TrackingSession(), "by themselves": TrackingSession()}
    last, own_turns = {}, 0
    for k in range(FRAMES):
        image = noise.measure(depth, scene.camera, rng)
        seen = recoverer.recover(image, scene.camera, labels if has_masks else None).recovered
        for name, session in sessions.items():
            is_pose_known = name == "tracked" or k == 0
            for one, raw in zip(session.follow(seen, k / 30, is_pose_known=is_pose_known), seen, strict=True):
                before = last.get((name, one.id), one.superquadric)
                assert turn(before, one.superquadric) < np.pi / 4, (name, k, one.id)
                last[name, one.id] = one.superquadric
                own = [turn(before, form) for form in raw.superquadric.equivalent_forms()]
                own_turns += min(own) > np.pi / 4
    assert own_turns, "without a track axes change places"


def unsure_along(truth, direction, deviation=0.2):
    """The covariance, sizes as shares, of a look from a direction that hardly tells the extent along itself."""
    along = np.abs(truth.rotation_matrix.T @ direction) / np.linalg.norm(direction)
    return noise(0.02, 0.03, 0.001, 0.02) + np.diag(np.r_[(deviation * along) ** 2, np.zeros(8)])


def test_two_cameras_across_each_other_leave_no_size_open(rng):
    truth = body(turn=(0, 0, 0))
    views = []
    for direction in (np.array([0.0, 0, -1]), np.array([1.0, 0, 0])):
        pose = looking_at(truth.translation, direction, 0.8)
        seen = draw(truth, unsure_along(truth, direction), rng)
        views.append(View([from_camera(seen, *pose)], pose))
    (one,), (other,), (both,) = fuse_views(views[:1]), fuse_views(views[1:]), fuse_views(views)
    assert both.seen == 2
    relative = [np.sort(each.sigma_size / each.superquadric.size) for each in (one, other, both)]
    assert relative[0][2] > 0.15
    assert relative[1][2] > 0.15
    assert relative[2][2] < 0.05
    assert nees(both, truth) < 40
    assert np.abs(error_of(both, truth)[0][:3]).max() < 0.1


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_every_body_is_there_once_whoever_sees_it(order, rng):
    """The third camera sees but one of two bodies: a wall hides the other one from it."""
    assert fuse_views([]) == ()
    truths = spread_bodies(2, rng)
    wall = Superquadric([0.15, 0.3, 0.01], [0.1, 0.1], [0.3, 0.0, 0.4], [0, 0, 0, 1.0])
    views = []
    for number, x in enumerate((-0.4, 0.4, 0.15)):
        pose = looking_at(truths.translation.mean(axis=0), np.array([x, 0.05, -1.0]), 0.9)
        shown = truths if number < 2 else truths[:1]
        bodies = [from_camera(draw(each, noise(), rng), *pose) for each in shown]
        scene = [*truths, wall] if number == 2 else truths
        local = [from_camera(Seen(each, np.eye(11)), *pose).superquadric for each in scene]
        views.append(View(bodies, pose, CAMERA, image_of(local, 3.0)))
    tracks = fuse_views(views[k] for k in order)
    assert sorted(track.seen for track in tracks) == [2, 3]
    for truth in truths:
        (track,) = (each for each in tracks if np.linalg.norm(each.superquadric.translation - truth.translation) < 0.05)
        assert np.linalg.norm(state.difference(truth.to_flat(), track.superquadric.to_flat())[5:8]) < 0.01
