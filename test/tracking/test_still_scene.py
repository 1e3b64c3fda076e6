"""Nothing moves before a noisy camera: no axis of a body on tf may turn, in tracks or in single frames."""

from __future__ import annotations

import numpy as np
import pytest
from tracked_bodies import angle_between as turn

from sq_perception.recovery.recoverer import Recoverer
from sq_perception.simulation.scenes import table_scene
from sq_perception.simulation.sensor_noise import preset
from sq_perception.tracking.session import TrackingSession

FRAMES = 13


@pytest.fixture(scope="module")
def recoverer():
    return Recoverer()


@pytest.mark.parametrize(("seed", "has_masks"), [(4, True), (6, False), (15, False)])
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
