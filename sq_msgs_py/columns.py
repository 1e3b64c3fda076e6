"""Arrays by columns in a sensor_msgs/PointCloud2: one point a row, one named field a number; of bodies, grasps, points.

Readers find fields by name, whatever their order, offset, type and byte order, and leave unknown ones aside.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from sq_msgs_py.depth_image import byte_array
from sq_msgs_py.message_types import MessageTypes, find_type

if TYPE_CHECKING:
    from sensor_msgs.msg import PointCloud2


_NUMPY_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""By the datatypes of sensor_msgs/PointField."""
UINT32, FLOAT32 = 6, 7


def field_types(names: str, unsigned: str) -> tuple[tuple[str, int], ...]:
    """Return fields by their names; all are float32 but the unsigned ones, which are uint32."""
    return tuple((name, UINT32 if name in unsigned.split() else FLOAT32) for name in names.split())


class MessageError(ValueError):
    """A message that does not hold what it should; its text names what was expected and what arrived."""


def column(*names: str, is_finite: bool = False, missing: float = np.nan) -> Mapping[str, Any]:
    """Return a dataclass field's metadata: its fields of the message, whether NaN is forbidden, and what stands for
    missing numbers."""
    return {"names": names, "is_finite": is_finite, "missing": missing}


@dataclass(frozen=True, eq=False)
class Columns:
    """n rows of numbers: the base of frozen dataclasses whose fields are columns (n,) or (n, k), by :func:`column`.

    ``FIELDS``: name and PointField datatype of every field, in the order of the message.  A column that is None is 0 or
    NaN.  Raises ValueError if a column has another shape than the first one asks for, holds what is not finite and has
    to be, or one of its integers is no unsigned 32 bit integer.
    """

    FIELDS: ClassVar[tuple[tuple[str, int], ...]]

    def __post_init__(self) -> None:
        kinds, count = dict(self.FIELDS), len(self)
        for each in fields(self):
            name, names, given = each.name, each.metadata["names"], getattr(self, each.name)
            is_unsigned = kinds[names[0]] == UINT32
            shape = (count,) if len(names) == 1 else (count, len(names))
            if given is None:
                given = np.zeros(shape, np.uint32) if is_unsigned else np.full(shape, each.metadata["missing"])
            values = np.asarray(given)
            if values.size == 0 and count == 0:
                values = values.reshape(shape)
            if values.shape != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {values.shape}")
            if is_unsigned and values.size:
                if not np.issubdtype(values.dtype, np.integer):
                    raise ValueError(f"{name}: expected integers, got {values.dtype}")
                low, high, most = values.min(), values.max(), np.iinfo(np.uint32).max
                if low < 0 or high > most:
                    raise ValueError(f"{name}: expected 0 to {most}, got {low} to {high}")
            with np.errstate(over="ignore"):  # of a stranger's doubles: infinite
                values = values.astype(np.uint32 if is_unsigned else np.float32)
            if each.metadata["is_finite"] and not np.isfinite(values).all():
                raise ValueError(f"{name}: expected finite numbers, got {values.tolist()}")
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(np.atleast_1d(getattr(self, fields(self)[0].name)))


Rows = TypeVar("Rows", bound=Columns)


def to_message(rows: Columns, header: Any, types: MessageTypes = find_type) -> PointCloud2:
    """Return the message of n rows (n may be 0) with the given std_msgs/Header, of the classes in ``types``."""
    layout = np.dtype([(name, "<" + _NUMPY_TYPES[datatype]) for name, datatype in rows.FIELDS])
    points = np.zeros(len(rows), layout)
    for each in fields(rows):
        names = each.metadata["names"]
        values = getattr(rows, each.name).reshape(len(rows), len(names))
        for k, name in enumerate(names):
            points[name] = values[:, k]
    field = types("sensor_msgs/msg/PointField")
    return types("sensor_msgs/msg/PointCloud2")(
        header=header, height=1, width=len(points), is_bigendian=False, point_step=layout.itemsize,
        row_step=layout.itemsize * len(points), data=byte_array(points),
        is_dense=all(bool(np.isfinite(points[name]).all()) for name, _ in rows.FIELDS),
        fields=[
            field(name=name, offset=int(layout.fields[name][1]), datatype=datatype, count=1)  # type: ignore[index]
            for name, datatype in rows.FIELDS
        ],
    )


def from_message(kind: type[Rows], message: PointCloud2) -> Rows:
    """Return the rows of a message; columns that have a default are left out where their fields are not all there.
    Raises MessageError as :func:`cloud_points`, or for columns that ``kind`` does not take."""
    needed = {name for each in fields(kind) if each.default is MISSING for name in each.metadata["names"]}
    known = [name for name, _ in kind.FIELDS]
    points = cloud_points(message, known, [name for name in known if name in needed])
    columns: dict[str, np.ndarray] = {}
    for each in fields(kind):
        names = each.metadata["names"]
        if set(names) <= set(points.dtype.names or ()):
            values = np.stack([points[name] for name in names], axis=-1)
            columns[each.name] = values[:, 0] if len(names) == 1 else values
    try:
        return kind(**columns)
    except ValueError as error:
        raise MessageError(str(error)) from error


def cloud_points(message: PointCloud2, known: Sequence[str], needed: Sequence[str]) -> np.ndarray:
    """Return the points (n,) of a cloud as a structured array of those of the known fields that are there.  Raises
    MessageError for a missing needed field, an unknown layout, or data of another length than it states."""
    order = ">" if message.is_bigendian else "<"
    present = {field.name: field for field in message.fields}
    missing = [name for name in needed if name not in present]
    if missing:
        raise MessageError(f"expected the fields {' '.join(needed)}; missing: {' '.join(missing)}")
    names = [name for name in known if name in present]
    formats = []
    for name in names:
        field = present[name]
        if field.datatype not in _NUMPY_TYPES or field.count != 1:
            raise MessageError(f"field {name}: expected one number, got datatype {field.datatype} x {field.count}")
        formats.append(order + _NUMPY_TYPES[field.datatype])
        if field.offset + np.dtype(formats[-1]).itemsize > message.point_step:
            raise MessageError(
                f"field {name}: offset {field.offset} lies outside a point of {message.point_step} bytes"
            )
    height, width, row_step = int(message.height), int(message.width), int(message.row_step)
    if row_step < width * message.point_step:
        raise MessageError(f"row_step: expected at least {width * message.point_step} bytes, got {row_step}")
    if len(message.data) != height * row_step:
        raise MessageError(f"data: expected height x row_step = {height * row_step} bytes, got {len(message.data)}")
    if height * width == 0:  # whose step may be any number
        return np.empty(0, np.dtype(list(zip(names, formats, strict=True))))
    offsets, step = [present[name].offset for name in names], int(message.point_step)
    layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    rows = np.ndarray((height, width), layout, buffer=memoryview(message.data), strides=(row_step, step))
    return rows.reshape(-1)


def points_from_message(message: PointCloud2) -> np.ndarray:
    """Return points, float32 (height, width, 3), as they stand in a message: NaN or (0, 0, 0) for none, metres."""
    found = cloud_points(message, "xyz", "xyz")
    with np.errstate(over="ignore"):  # doubles that no camera measures: infinite
        points = np.stack([found[name].astype(np.float32) for name in "xyz"], axis=-1)
    return points.reshape(int(message.height), int(message.width), 3)


def labels_of_points(message: PointCloud2, fields: Sequence[str]) -> np.ndarray | None:
    """Return labels (height, width) as they stand in the first of these fields that is there; None without one."""
    present = {field.name for field in message.fields}
    name = next((name for name in fields if name in present), None)
    if name is None:
        return None
    return cloud_points(message, [name], [name])[name].reshape(int(message.height), int(message.width))
