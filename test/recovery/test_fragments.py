"""A fragment of a thing is left out once its body is known; a thing of its own beside another one is not."""

from __future__ import annotations

import numpy as np
import pytest
from table_scenes import VGA, Table

from sq_perception.recovery.recoverer import Recoverer
from sq_perception.segmentation import objectness
from sq_perception.segmentation.evidence import FrameEvidence


def test_it_is_less_likely_the_more_it_is_one_with_another_and_the_worse_its_body_is():
    by_pair = [objectness.of_its_own(same, 0.7) for same in (0.0, 0.1, 0.4, 0.49)]
    by_score = [objectness.of_its_own(0.3, score) for score in (0.1, 0.4, 0.9)]
    assert by_pair == sorted(by_pair, reverse=True)
    assert by_score == sorted(by_score)


def test_only_much_larger_objects_have_fragments():
    labels = np.repeat(np.array([1, 1, 1, 2, 2, 3], np.int32), 10)[None]
    same = np.array([[0, 0.4, 0.3], [0.4, 0, 0.2], [0.3, 0.2, 0]])
    assert FrameEvidence(labels, (1, 2, 3), affinity=same).same_as_larger() == {3: 0.3}
    assert FrameEvidence(labels, (1, 2, 3)).same_as_larger() == {}, "no network said anything"


@pytest.mark.parametrize(("same", "is_kept"), [(0.0, True), (0.499, False)])
def test_a_fragment_is_no_body_and_has_no_pixels(same, is_kept):
    """The face of a box, less a strip of it, and that strip, whose body explains little of its view."""
    table = Table(pitch=0.9)
    depth, truth = table.see([table.body(0.0, 0.0, (0.06, 0.05, 0.05))], 1e-3)
    columns = np.flatnonzero((truth == 1).any(axis=0))
    labels = truth.astype(np.int32)
    strip = np.arange(depth.shape[1]) < columns[0] + 4
    labels[(truth == 1) & strip] = 2
    pairs = np.array([[0.0, same], [same, 0.0]])
    chain = Recoverer(method="symmetry", threads=1)
    readings = chain.read(depth, VGA)
    found = chain.find_objects(readings, FrameEvidence(labels, (1, 2), affinity=pairs))
    recovery = chain.recover_objects(readings, found)
    assert [body.label for body in recovery.bodies] == ([1, 2] if is_kept else [1])
    assert (recovery.labels == 2).any() == is_kept
    assert (recovery.labels == 1).sum() == (labels == 1).sum()
