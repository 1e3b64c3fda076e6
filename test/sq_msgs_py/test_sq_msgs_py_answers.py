"""What ~/recover and ~/plan answer: columns come back as they were, and nothing hostile is taken for an answer."""

import json
from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pytest
from random_bodies import random_bodies

from sq_msgs_py.answers import from_response, grasps_from_response, text_of
from sq_msgs_py.grasps import GraspArray
from sq_msgs_py.superquadrics import MessageError

HEADER = SimpleNamespace(frame_id="camera", stamp=SimpleNamespace(sec=7, nanosec=5))


def bodies(count):
    return random_bodies(count, np.random.default_rng(count))


def answered(text, success=True):
    return from_response(SimpleNamespace(success=success, message=text))


RNG = np.random.default_rng(1)
GRASPS = GraspArray(RNG.random((3, 3)), RNG.random((3, 4)), *RNG.random((3, 3)), np.array([7, 2**31, 7]))


@pytest.mark.parametrize("given", [bodies(0), bodies(1), bodies(5), GRASPS], ids=["0", "1", "5", "grasps"])
def test_every_column_comes_back_bit_by_bit_and_the_one_kind_is_not_taken_for_the_other(given):
    text = text_of(given, HEADER, "words")
    assert "NaN" not in text
    response = SimpleNamespace(success=True, message=text)
    reader, other, name = from_response, grasps_from_response, "~/plan"
    if given is GRASPS:
        reader, other, name = grasps_from_response, from_response, "~/recover"
    found = reader(response)
    assert (found.frame_id, found.stamp, found.summary) == ("camera", 7_000_000_005, "words")
    for column in fields(given):
        read = found.grasps if given is GRASPS else found.bodies
        before, after = getattr(given, column.name), getattr(read, column.name)
        assert before.dtype == after.dtype
        np.testing.assert_array_equal(before, after)
    with pytest.raises(MessageError, match=name):
        other(response)


def test_a_node_of_another_version_knows_more_or_less():
    document = json.loads(text_of(bodies(2), HEADER, ""))
    for row in document["superquadrics"]:
        del row["label"]
        row["colour"] = "red"
    assert answered(json.dumps(document)).bodies.label.tolist() == [0, 0]


def test_what_is_no_answer_is_refused():
    with pytest.raises(MessageError, match="no frame within 5 s"):
        answered("no frame within 5 s", success=False)
    good = json.loads(text_of(bodies(1), HEADER, ""))
    row = good["superquadrics"][0]
    changes = [{"size": [1.0, None, 1.0]}, {"size": [1.0]}, {"id": -1}, {"id": 10**40}, {"id": "a"}, {"score": {}}]
    hostile = [{**good, "superquadrics": [{**row, **change}]} for change in changes]
    hostile += [{**good, "superquadrics": [{}]}, {**good, "superquadrics": 3}, {**good, "stamp": None}, {}, [], 3]
    for text in ["2 bodies in 8 ms", "[" * 10**5, *map(json.dumps, hostile)]:
        with pytest.raises(MessageError, match="~/recover"):
            answered(text)
