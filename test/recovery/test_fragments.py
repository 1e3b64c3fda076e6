"""A fragment of a thing is left out once its body is known, and that is said; a thing beside another one is not."""

import numpy as np
import pytest
from table_scenes import VGA, Table

from sq_perception.recovery.recoverer import Recoverer
from sq_perception.segmentation.evidence import FrameEvidence
from sq_perception.segmentation.objectness import posterior


@pytest.mark.parametrize(
    ("what", "values"),
    [
        ("likely", (0.2, 0.5, 0.9, 1.0)), ("uncertainty", (np.nan, 1.0, 0.3, 0.1, 0.0)), ("pixels", (1.0, 2.0, 20.0)),
        ("affinity", (1.0, 0.3, 0.1, 0.0)), ("overlap", (1.0, 0.5, 0.0)),
    ],
)
def test_a_thing_is_likelier_the_surer_it_and_its_size_are_the_more_is_seen_and_the_less_another_one_explains_it(
    what, values
):
    usual = {"likely": 0.5, "uncertainty": 0.3, "pixels": 2.0, "affinity": 0.0, "overlap": 0.0}
    each = [posterior(**usual | {what: value}) for value in values]
    assert 0 < each[0] < each[-1] < 1
    assert each == sorted(each)


@pytest.mark.parametrize(("likely", "affinity", "is_kept"), [(0.9, 0.0, True), (0.2, 0.1, False), (0.9, 0.9, False)])
def test_a_fragment_is_no_body_has_no_pixels_and_is_said(likely, affinity, is_kept):
    """The face of a box, less a strip of it, and that strip, whose body has no depth."""
    table = Table(pitch=0.9)
    depth, truth = table.see([table.body(0.0, 0.0, (0.06, 0.05, 0.05))], 1e-3)
    columns = np.flatnonzero((truth == 1).any(axis=0))
    labels = truth.astype(np.int32)
    strip = np.arange(depth.shape[1]) < columns[0] + 4
    labels[(truth == 1) & strip] = 2
    evidence = FrameEvidence(
        labels, (1, 2), objectness=(0.99, likely), membership=np.ones(labels.shape, np.float32),
        affinity=affinity * (1 - np.eye(2)),
    )
    chain = Recoverer(method="symmetry", threads=1)
    readings = chain.read(depth, VGA)
    recovery = chain.recover_objects(readings, chain.find_objects(readings, evidence))
    assert [body.label for body in recovery.bodies] == ([1, 2] if is_kept else [1])
    assert ("1 left out, each a fragment" in recovery.message) != is_kept
    assert (recovery.labels == 2).any() == is_kept
    assert (recovery.labels == 1).sum() == (labels == 1).sum()
    given = chain.recover(depth, VGA, labels).bodies
    assert [body.objectness for body in given] == [1.0, 1.0], "masks from outside are not judged"
