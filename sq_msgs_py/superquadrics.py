"""Superquadrics in a sensor_msgs/PointCloud2: one point per body, one named field per number.

Equation, in the body's own frame (F < 1 inside, F = 1 on the surface):

    F(x, y, z) = (|x/a1|^(2/e2) + |y/a2|^(2/e2))^(e2/e1) + |z/a3|^(2/e1)

Fields, version 1
-----------------
x y z           centre, metres, in the frame of the header
qx qy qz qw     unit quaternion, body to header frame
a1 a2 a3        HALF sizes along the body's x y z, metres
e1 e2           exponents: e1 along z, e2 in the xy plane; 0.1 is a box, 1 an ellipsoid, 2 an octahedron
score           0 to 1: agreement of the soft-rendered body with the image
residual        root mean square distance of the seen points to the surface, metres
sigma_a1..a3    standard deviations of the half sizes, metres
id              of its track, kept from frame to frame (failed bodies: 2^31 + label); untracked, the label of its mask
status          0 converged, 1 converged but the view leaves something open, 2 failed
label           of the mask that the body was fitted to; 0 where there is none
seen            frames that showed the body so far, this one included; 0 where nobody counted
fused           1 where the numbers are those of a track, 0 where they are this frame's own
reason          why the status is 1, and what else there is to know of the fit: the bits of :class:`Reason`
sigma_e1 sigma_e2    standard deviations of the exponents
sigma_c1..c3    standard deviations of the centre along the body's axes x y z, metres
sigma_r1..r3    standard deviations of the rotation about the body's axes x y z, radians

All are float32 but id, status, label, seen, fused and reason, which are uint32.  Deviations are NaN where unknown.  The
header copies stamp and frame of the depth image.  Readers find fields by name: a later version may append fields, and
raises VERSION when it changes the meaning of one.  What follows status was appended after 0.2.0; in a cloud without it
integers are 0 and deviations NaN.

The eight parameter vectors of one body (half turns about the axes, quarter turns about z with a1 and a2 exchanged) are
equally right: compare bodies, never raw parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from enum import IntFlag
from typing import TYPE_CHECKING, Any

import numpy as np

from sq_msgs_py.depth_image import byte_array
from sq_msgs_py.message_types import MessageTypes, installed

if TYPE_CHECKING:
    from sensor_msgs.msg import PointCloud2

VERSION = 1
CONVERGED, WEAK, FAILED = 0, 1, 2


class Reason(IntFlag):
    """Why a body is WEAK, and what else there is to know of its fit, by the axes that the message gives the body."""

    OPEN_X = 1
    """The frame leaves the half size along the body's x open; the track of other views may know it."""
    OPEN_Y = 2
    OPEN_Z = 4
    HULL = 8
    """No superquadric came near, so that the body was fitted like the convex hull of the object."""


_NUMPY_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""By the datatypes of sensor_msgs/PointField."""
UINT32, FLOAT32 = 6, 7

FIELDS: tuple[tuple[str, int], ...] = tuple(
    (name, FLOAT32)
    for name in (
        *("x", "y", "z", "qx", "qy", "qz", "qw", "a1", "a2", "a3", "e1", "e2"),
        *("score", "residual", "sigma_a1", "sigma_a2", "sigma_a3"),
    )
) + tuple((name, UINT32) for name in ("id", "status", "label", "seen", "fused", "reason"))
FIELDS += tuple((f"sigma_{name}", FLOAT32) for name in ("e1", "e2", "c1", "c2", "c3", "r1", "r2", "r3"))
"""Name and PointField datatype of every field, in the order of the message."""
_UNSIGNED = tuple(name for name, kind in FIELDS if kind == UINT32)

_COLUMNS = {
    "size": ("a1", "a2", "a3"),
    "shape": ("e1", "e2"),
    "translation": ("x", "y", "z"),
    "rotation": ("qx", "qy", "qz", "qw"),
    "score": ("score",),
    "residual": ("residual",),
    "sigma_size": ("sigma_a1", "sigma_a2", "sigma_a3"),
    "id": ("id",),
    "status": ("status",),
    **{name: (name,) for name in ("label", "seen", "fused", "reason")},
    "sigma_shape": ("sigma_e1", "sigma_e2"),
    "sigma_centre": ("sigma_c1", "sigma_c2", "sigma_c3"),
    "sigma_turn": ("sigma_r1", "sigma_r2", "sigma_r3"),
}
_NEEDED = tuple(name for name, _ in FIELDS[: [name for name, _ in FIELDS].index("label")])
"""Fields that every cloud has."""


class MessageError(ValueError):
    """A PointCloud2 that holds no superquadrics; says what was expected and what arrived."""


@dataclass(frozen=True, eq=False)
class SuperquadricArray:
    """n superquadrics, column by column; see the module for units and conventions.

    Attributes
    ----------
    size : (n, 3) float32
    shape : (n, 2) float32
    translation : (n, 3) float32
    rotation : (n, 4) float32
    score, residual : (n,) float32
    sigma_size : (n, 3) float32
    id, status : (n,) uint32
    label, seen, fused, reason : (n,) uint32
        0 if not given.
    sigma_shape : (n, 2) float32
    sigma_centre, sigma_turn : (n, 3) float32
        NaN if not given.

    Raises
    ------
    ValueError
        If a column has another shape than the size column asks for, a half size, exponent, centre or quaternion is not
        finite, or one of the integers is no unsigned 32 bit integer.
    """

    size: np.ndarray
    shape: np.ndarray
    translation: np.ndarray
    rotation: np.ndarray
    score: np.ndarray
    residual: np.ndarray
    sigma_size: np.ndarray
    id: np.ndarray
    status: np.ndarray
    label: np.ndarray | None = None
    seen: np.ndarray | None = None
    fused: np.ndarray | None = None
    reason: np.ndarray | None = None
    sigma_shape: np.ndarray | None = None
    sigma_centre: np.ndarray | None = None
    sigma_turn: np.ndarray | None = None

    def __post_init__(self) -> None:
        count = len(np.atleast_1d(self.size))
        for column in fields(self):
            names = _COLUMNS[column.name]
            given = getattr(self, column.name)
            shape = (count,) if len(names) == 1 else (count, len(names))
            if given is None:
                given = np.zeros(shape, np.uint32) if column.name in _UNSIGNED else np.full(shape, np.nan)
            values = np.asarray(given)
            if values.size == 0 and count == 0:
                values = values.reshape(shape)
            if values.shape != shape:
                raise ValueError(f"{column.name}: expected shape {shape}, got {values.shape}")
            if column.name in _UNSIGNED:
                _check_unsigned(column.name, values)
                values = values.astype(np.uint32)
            else:
                values = values.astype(np.float32)
            if column.name in ("size", "shape", "translation", "rotation") and not np.isfinite(values).all():
                raise ValueError(f"{column.name}: expected finite numbers, got {values.tolist()}")
            object.__setattr__(self, column.name, values)

    def __len__(self) -> int:
        return len(self.size)

    @property
    def recovered(self) -> SuperquadricArray:
        """Those that did not fail, in their order."""
        return self.where(self.status != FAILED)

    def where(self, kept: np.ndarray) -> SuperquadricArray:
        """Those of a mask (n,), in their order."""
        return replace(self, **{column.name: getattr(self, column.name)[kept] for column in fields(self)})

    @classmethod
    def empty(cls) -> SuperquadricArray:
        """No superquadric at all."""
        return cls(
            **{name: np.empty(0, np.uint32 if name in _UNSIGNED else np.float32) for name in _COLUMNS},
        )


def to_message(superquadrics: SuperquadricArray, header: Any, types: MessageTypes = installed) -> PointCloud2:
    """The message of n superquadrics (n may be 0) with the given std_msgs/Header, of the classes in ``types``."""
    columns: dict[str, np.ndarray] = {}
    for column, names in _COLUMNS.items():
        values = getattr(superquadrics, column).reshape(len(superquadrics), len(names))
        columns.update({name: values[:, k] for k, name in enumerate(names)})
    return cloud(columns, FIELDS, header, types)


def cloud(
    columns: Mapping[str, np.ndarray],
    described: Sequence[tuple[str, int]],
    header: Any,
    types: MessageTypes = installed,
) -> PointCloud2:
    """A PointCloud2 with one point a row of some columns (n,), whose fields have these names and datatypes."""
    layout = np.dtype([(name, "<" + _NUMPY_TYPES[datatype]) for name, datatype in described])
    points = np.zeros(len(columns[described[0][0]]), layout)
    for name, _ in described:
        points[name] = columns[name]
    field = types("sensor_msgs/msg/PointField")
    message: PointCloud2 = types("sensor_msgs/msg/PointCloud2")(
        header=header,
        height=1,
        width=len(points),
        fields=[
            field(name=name, offset=int(layout.fields[name][1]), datatype=datatype, count=1)  # type: ignore[index]
            for name, datatype in described
        ],
        is_bigendian=False,
        point_step=layout.itemsize,
        row_step=layout.itemsize * len(points),
        data=byte_array(points),
        is_dense=all(bool(np.isfinite(columns[name]).all()) for name, _ in described),
    )
    return message


def from_message(message: PointCloud2) -> SuperquadricArray:
    """The superquadrics of a message; fields are found by name, unknown ones are left aside.

    Raises
    ------
    MessageError
        If a field is missing, has an unknown datatype, a count other than one or an offset outside the point, or if the
        data is not as long as width, height and steps say.
    """
    points = cloud_points(message, FIELDS, _NEEDED)
    columns: dict[str, np.ndarray] = {}
    for column, names in _COLUMNS.items():
        if not set(names) <= set(points.dtype.names or ()):
            continue  # a cloud of an earlier version
        values = np.stack([points[name] for name in names], axis=-1)
        columns[column] = values[:, 0] if len(names) == 1 else values
    try:
        return SuperquadricArray(**columns)
    except ValueError as error:
        raise MessageError(str(error)) from error


def cloud_points(message: PointCloud2, described: Sequence[tuple[str, int]], needed: Sequence[str]) -> np.ndarray:
    """The points (n,) of a cloud as a structured array of those of the described fields that are there.

    Raises
    ------
    MessageError
        As :func:`from_message`, for fields that are needed.
    """
    order = ">" if message.is_bigendian else "<"
    present = {field.name: field for field in message.fields}
    missing = [name for name in needed if name not in present]
    if missing:
        raise MessageError(f"expected the fields {' '.join(needed)}; missing: {' '.join(missing)}")
    names = [name for name, _ in described if name in present]
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
    offsets = [present[name].offset for name in names]
    layout = np.dtype(
        {
            "names": names,
            "formats": formats,
            "offsets": offsets,
            "itemsize": int(message.point_step),
        }
    )
    if height * width == 0:
        return np.empty(0, layout)
    rows = np.ndarray((height, width), layout, buffer=memoryview(message.data), strides=(row_step, message.point_step))
    return rows.reshape(-1)


def _check_unsigned(name: str, values: np.ndarray) -> None:
    if values.size and not np.issubdtype(values.dtype, np.integer):
        raise ValueError(f"{name}: expected integers, got {values.dtype}")
    if values.size and (values.min() < 0 or values.max() > np.iinfo(np.uint32).max):
        raise ValueError(f"{name}: expected 0 to {np.iinfo(np.uint32).max}, got {values.min()} to {values.max()}")
