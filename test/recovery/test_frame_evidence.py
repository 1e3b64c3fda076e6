"""What a frame shows of its objects together: pieces of one thing, fragments, and what may go on in another."""

import numpy as np
import pytest
from table_scenes import VGA, Table

from sq_perception.fitting.fit import Fit, Status
from sq_perception.recovery import methods, seen_object
from sq_perception.recovery.recoverer import Recoverer
from sq_perception.segmentation.evidence import FrameEvidence
from sq_perception.segmentation.objectness import posterior

TABLE = Table()


def two_boxes() -> tuple[list[seen_object.SeenObject], Fit]:
    """A box with one of the same width on it, seen as two objects, and the exact body of the lower one."""
    lower = TABLE.body(0, 0, (0.05, 0.04, 0.03))
    depth, labels = TABLE.see([lower, TABLE.body(0, 0, (0.05, 0.04, 0.02), height=0.06)])
    objects = seen_object.objects(depth, FrameEvidence(labels, (1, 2)), VGA)
    return objects, Fit(lower.canonical_form(), 0.0, Status.CONVERGED, "converged", covariance=1e-6 * np.eye(11))


@pytest.mark.parametrize("likely", [0.1, 0.4])
def test_second_moments_are_those_of_a_body_that_may_reach_over_both(likely: float) -> None:
    """The stack is 4 cm higher: with probability q half of its height and its centre are 2 cm more along the axis."""
    (_, upper), fit = two_boxes()
    found = methods.widen(fit, [(likely, upper)])
    axis = int(np.abs(fit.superquadric.rotation_matrix.T @ TABLE.plane[:3]).argmax())
    added = np.diag(found.covariance - fit.covariance)
    assert added[axis] == pytest.approx(likely * 0.02**2, rel=0.1)
    assert added[5:8].sum() == pytest.approx(likely * 0.02**2, rel=0.1)
    assert np.delete(added[:3], axis) == pytest.approx(0, abs=likely * 0.002**2)
    assert found.status == Status.WEAK
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()


def test_what_lies_within_the_body_and_what_is_surely_another_add_nothing() -> None:
    (lower, upper), fit = two_boxes()
    for others in ([(1.0, lower)], [(0.0, upper)], []):
        found = methods.widen(fit, others)
        np.testing.assert_allclose(found.covariance, fit.covariance, atol=1e-8)
        assert found.status == Status.CONVERGED


def test_pairs_keep_their_probability_when_others_go() -> None:
    labels = np.repeat(np.array([[1, 1, 1, 2, 2, 3]], np.int32), 4, axis=0)
    same = np.array([[0, 0.1, 0.2], [0.1, 0, 0.3], [0.2, 0.3, 0]])
    found = FrameEvidence(labels, (1, 2, 3), affinity=same).keep({3: 0.9, 2: 0.8})
    assert found.ids == (1, 2)
    assert found.affinity is not None
    assert found.affinity[0, 1] == found.affinity[1, 0] == 0.3


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
    labels[(truth == 1) & (np.arange(depth.shape[1]) < columns[0] + 4)] = 2
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
