"""Hostile messages: nothing that arrives ends a node, and what is wrong is counted and said."""

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

from hostile_messages import IMAGES, MASKS, HostileFrame, Siege, difference, frames, hostile_infos, sound_info
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from running_nodes import Peer, arguments, environment, until
from started_nodes import Children
from std_msgs.msg import Header

from sq_msgs_py.depth_image import DEPTH_ENCODINGS, ImageError, intrinsics_from_message, labels_from_message
from sq_msgs_py.superquadrics import from_message
from sq_perception import Camera, Recoverer
from sq_perception.recordings import publication

FIELDS = ("encoding", "image size", "step", "data")
QUICK = settings(
    max_examples=500, deadline=None, derandomize=True, database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.function_scoped_fixture],
)


def read(reader: Callable[[Any], Any], message: Any) -> tuple[Any, str]:
    """What a reader makes of a message and an empty string, or None and the words of its refusal."""
    try:
        return reader(message), ""
    except ImageError as error:
        return None, str(error)


@QUICK
@given(IMAGES, MASKS)
def test_a_depth_image_and_a_mask_are_read_whole_or_refused_with_their_field(message, mask):
    depth, words = read(lambda one: publication.depth_of(one, False)[0].depth, message)
    if depth is None:
        assert words.split(":")[0] in FIELDS
    else:
        assert message.encoding in DEPTH_ENCODINGS
        assert depth.shape == (message.height, message.width)
        assert (np.isnan(depth) | ((depth > 0) & np.isfinite(depth))).all()
    labels, words = read(labels_from_message, mask)
    if labels is None:
        assert words.split(":")[0] in FIELDS
    else:
        assert (labels.shape, labels.dtype) == ((mask.height, mask.width), np.int32)
        assert labels.min() >= 0


@QUICK
@given(st.data())
def test_a_camera_info_becomes_a_camera_or_is_refused(data):
    known, words = read(intrinsics_from_message, data.draw(hostile_infos(64, 48, Header())))
    if known is None:
        assert words.startswith("camera_info: expected ")
        return
    assert min(known.width, known.height) >= 1
    assert min(known.fx, known.fy) > 0
    assert np.isfinite([known.fx, known.fy, known.cx, known.cy]).all()
    is_known = min(known.fx, known.fy) > 1
    with nullcontext() if is_known else pytest.raises(ValueError, match="focal lengths: expected pixels"):
        Camera(known.width, known.height, known.fx, known.fy, known.cx, known.cy)


@pytest.fixture(scope="module")
def recoverer() -> Recoverer:
    return Recoverer(method="symmetry")


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_whatever_can_be_read_is_recovered_or_has_a_reason(recoverer):
    """Depth that is no scene, seen by cameras that do not exist, is hard data: it never raises."""

    @settings(QUICK, max_examples=250)
    @given(frames(masked=True))
    def check(frame):
        try:
            depth = publication.depth_of(frame.image, False)[0].depth
            known = intrinsics_from_message(frame.info or sound_info(frame.image))
            camera = Camera(known.width, known.height, known.fx, known.fy, known.cx, known.cy)
            labels = None if frame.mask is None else labels_from_message(frame.mask)
        except ValueError:
            return
        if depth.shape != (camera.height, camera.width) or (labels is not None and labels.shape != depth.shape):
            return
        found = recoverer.recover(depth, camera, labels)
        assert len(found.bodies) <= 20
        for body in found.bodies:
            assert np.isfinite(body.superquadric.size).all()
            assert np.isfinite(body.superquadric.translation).all()
        assert found.bodies or found.message

    check()


def test_a_node_survives_counts_and_explains():
    with Peer() as peer, Children(environment()) as children:
        node = children.start("recover_node", arguments("no_frame_warning:=0.0"))
        alive = (node,)
        siege = Siege(peer, "/recover_node", alive)
        answers, reports = peer.answers("/recover_node"), peer.diagnoses("/recover_node")
        first = from_message(peer.ask("/recover_node", *peer.frame(), alive=alive).message)
        assert len(first) == 2
        verdicts = []
        for masked in (False, True):

            @settings(QUICK, max_examples=60)
            @given(frames(masked=masked))
            def strike(frame: HostileFrame) -> None:
                verdicts.append(siege.strike(frame))

            strike()
            if masked:
                peer.silence("mask/image")
                until(lambda: not peer.node.count_publishers("/mask/image"))
            last = from_message(peer.ask("/recover_node", *peer.frame(), alive=alive).message)
            assert difference(last, first) < 4e-3

        assert not [one.message for one in verdicts if one.is_defect]
        assert all(one.message for one in verdicts)
        assert {"encoding", "step", "data"} <= {one.kind for one in verdicts if not one.answered}
        assert any(one.answered for one in verdicts)

        seen = len(reports)
        until(lambda: len(reports) > seen + 1 and reports[-1].count("in work") == 0, alive)
        final = reports[-1]
        assert final.is_balanced
        assert final.count("answered") == len(answers)
        # A frame that was lost was sent again, and perhaps answered twice.
        assert final.count("refused") >= sum(not one.answered for one in verdicts)
        assert final.values["last error"]
        assert "Traceback" not in "\n".join(node.last_lines())
