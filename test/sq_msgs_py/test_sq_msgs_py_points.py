"""Points of a cloud as they lie in it: any byte order, number type, padding and order of fields."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sq_msgs_py.columns import points_from_message
from sq_msgs_py.superquadrics import MessageError

POINTS = np.arange(24, dtype=float).reshape(2, 4, 3)
KINDS = {"f4": 7, "f8": 8, "i2": 3}


def message(kind: str = "f4", order: str = "<", names: str = "zyx", padding: int = 0) -> Any:
    size = np.dtype(kind).itemsize
    step, offsets = 3 * size + padding, {name: k * size for k, name in enumerate(names)}
    layout = {"names": [*names], "formats": [order + kind] * 3, "offsets": [*offsets.values()], "itemsize": step}
    rows = np.zeros((2, 4 + padding), np.dtype(layout))
    for name in names:
        rows[name][:, :4] = POINTS[..., "xyz".index(name)]
    fields = [SimpleNamespace(name=name, offset=at, datatype=KINDS[kind], count=1) for name, at in offsets.items()]
    steps = {"point_step": step, "row_step": step * (4 + padding)}
    return SimpleNamespace(height=2, width=4, fields=fields, is_bigendian=order == ">", data=rows.tobytes(), **steps)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("names", "padding"), [("xyz", 0), ("zyx", 5)])
def test_points_are_read_whatever_their_layout(kind, order, names, padding):
    np.testing.assert_array_equal(points_from_message(message(kind, order, names, padding)), POINTS)


def test_clouds_without_points_and_points_that_no_camera_measures() -> None:
    empty = message()
    vars(empty).update(height=0, data=b"")
    assert points_from_message(empty).shape == (0, 4, 3)
    vars(empty).update(width=0, point_step=2**32 - 1, row_step=0)
    assert points_from_message(empty).shape == (0, 0, 3), "the step of no point may be any number"
    with pytest.raises(MessageError, match="row_step"):
        points_from_message(SimpleNamespace(**{**vars(message()), "row_step": 3}))
    far = message("f8")
    far.data = np.full(len(far.data) // 8, 1e300).tobytes()
    assert np.isinf(points_from_message(far)).all()
