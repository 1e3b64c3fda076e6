"""Segments to train on: what is the object's, what is not, and what is unknown."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sq_perception.imaging.segment_view import IMAGE, MEASURED, SEGMENT
from sq_perception.segmentation.evidence import FrameEvidence
from sq_perception.simulation import segment_views
from sq_perception.simulation.segment_views import NO, UNKNOWN, YES, SegmentViews, draw_segment_views


@pytest.fixture(scope="module")
def drawn() -> SegmentViews:
    return draw_segment_views(10, np.random.default_rng(4))


def test_truth_is_known_where_something_was_measured(drawn: SegmentViews) -> None:
    assert len(drawn.images) == len(drawn.truth) > 10
    np.testing.assert_array_equal(drawn.truth == UNKNOWN, drawn.images[..., MEASURED] == 0)


def test_most_of_a_segment_is_its_object(drawn: SegmentViews) -> None:
    inside = (drawn.images[..., SEGMENT] > 0) & (drawn.truth != UNKNOWN)
    own = (inside & (drawn.truth == YES)).sum(axis=(1, 2)) / inside.sum(axis=(1, 2))
    assert np.median(own) > 0.85
    assert (drawn.truth[inside] == NO).any()


def test_borders_cut_some(drawn: SegmentViews) -> None:
    """Cells outside of the image beside cells of the segment."""
    outside = drawn.images[..., IMAGE] == 0
    beside = (outside[:, 1:] & (drawn.images[:, :-1, :, SEGMENT] > 0)) | (
        outside[:, :-1] & (drawn.images[:, 1:, :, SEGMENT] > 0)
    )
    assert 0 < np.count_nonzero(beside.any(axis=(1, 2))) < len(drawn.images)


def test_scenes_without_segments_give_an_empty_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = FrameEvidence(np.zeros((1, 1), np.int32))
    monkeypatch.setattr(segment_views.segments, "segment", lambda *_: nothing)
    assert draw_segment_views(1, np.random.default_rng(1)).truth.shape == (0, 64, 64)


def test_pieces_of_merged_things_show_one_thing_each_or_none(monkeypatch: pytest.MonkeyPatch) -> None:
    find = segment_views.segments.segment

    def merged(*image: Any) -> FrameEvidence:
        found = find(*image)
        return replace(found, labels=(found.labels > 0).astype(np.int32), ids=(1,) if found.ids else ())

    monkeypatch.setattr(segment_views.segments, "segment", merged)
    scenes = 3
    drawn = draw_segment_views(scenes, np.random.default_rng(2))
    inside = (drawn.images[..., SEGMENT] > 0) & (drawn.truth != UNKNOWN)
    pure = (inside & (drawn.truth == YES)).sum(axis=(1, 2)) / inside.sum(axis=(1, 2))
    assert np.count_nonzero((pure > 0) & (pure < 0.7)) <= scenes
    assert np.count_nonzero(pure >= 0.7) > 2 * scenes
