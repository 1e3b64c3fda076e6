"""Things of known size in recorded frames: the figures of a scene whose truth is made here."""

import numpy as np
import public_frames
import pytest
from camera_bias import far_side
from common import tabletop

from sq_perception import RecordedFrame, Recoverer
from sq_perception.fitting.priors import HullPrior
from sq_perception.geometry.union import DIRECTIONS

SCENE = 3


def test_a_far_side_errs_by_what_was_added(rng: np.random.Generator) -> None:
    corners = rng.uniform(-0.05, 0.05, (8, 3)) + [0.0, 0.0, 0.8]
    middle = corners.mean(axis=0)
    directions = np.vstack([DIRECTIONS, middle / np.linalg.norm(middle)])
    support = (corners @ directions.T).max(axis=0)
    support[-1] += 0.007
    hull = HullPrior(directions, support, np.eye(len(directions)), 0.1)
    assert far_side(hull, corners) == pytest.approx(0.007)


def test_a_scene_has_the_figures_of_its_truth() -> None:
    scene = tabletop.scene(SCENE)
    objects = []
    for each in scene.placed:
        thing = {"name": each.thing.name, "kind": each.thing.kind, "hull": each.thing.hull.tolist()}
        pose = np.block([[each.rotation, each.translation[:, None]], [np.zeros(3), 1.0]]).tolist()
        objects.append({**thing, "label": each.label, "size": each.thing.edges.tolist(), "pose": pose})
    frame = RecordedFrame(scene.depth, scene.camera, scene.labels, "scene")
    found, bodies = public_frames.answers("scene", {"sensor": "simulated", "objects": objects}, frame, Recoverer())
    figures = public_frames.summary(found)
    assert bodies >= figures["found"] >= len(objects) - 1  # three quarters of one are hidden
    assert figures["posed"] == len(objects)
    assert figures["iou"] > 85
    assert figures["edges median"] < 4
    assert figures["far side"] < 6
    assert figures["beyond 3"] < 5
