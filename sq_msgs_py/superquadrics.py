"""Superquadrics in a sensor_msgs/PointCloud2: one point per body, one named field per number.

Equation, in the body's own frame (F < 1 inside, F = 1 on the surface):

    F(x, y, z) = (|x/a1|^(2/e2) + |y/a2|^(2/e2))^(e2/e1) + |z/a3|^(2/e1)

A body may taper: in place of x and y stand x' = x / s(k_x) and y' = y / s(k_y), the section at z being scaled by

    s(k) = (1 + k z/a3) / (1 + |k|),   for |z| <= a3

so that a1 and a2 are the half sizes at its wide end.  Whoever leaves k aside gets a body that encloses it.

Fields, version 1
-----------------
x y z           centre, metres, in the frame of the header
qx qy qz qw     unit quaternion, body to header frame
a1 a2 a3        HALF sizes along the body's x y z, metres; those at the wide end where it tapers
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
kx ky           tapers, -0.95 to 0.95; 0 for none
objectness      probability that the object is a thing, and no piece of its support or of furniture; 1 for given masks
part            0 for an object's body; 1, 2 ... for its parts, which share its id, label and seen, and have no score

All are float32 but id, status, label, seen, fused, reason and part, which are uint32.  Deviations are NaN where
unknown.  The header copies stamp and frame of the depth image.  Readers find fields by name: a later version may append
fields, and raises VERSION when it changes the meaning of one.  What follows status was appended after 0.2.0; in a cloud
without it integers and tapers are 0 and deviations NaN.

The eight parameter vectors of one body (half turns about the axes, quarter turns about z with a1 and a2 exchanged) are
equally right: compare bodies, never raw parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from enum import IntFlag
from typing import TYPE_CHECKING, Any

import numpy as np

from sq_msgs_py import columns
from sq_msgs_py.columns import Columns, column
from sq_msgs_py.columns import MessageError as MessageError
from sq_msgs_py.message_types import MessageTypes, find_type

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
    """No superquadric came near, so that the body was fitted like the convex hull of the object.  If it is WEAK and no
    size is open, some of the object sticks out, a trigger or a spout: keep clear of what was measured there."""
    CAVITY = 16
    """The camera sees into an open vessel: it can be taken by its rim."""


FIELDS = columns.field_types(
    "x y z qx qy qz qw a1 a2 a3 e1 e2 score residual sigma_a1 sigma_a2 sigma_a3 id status label seen fused reason "
    "sigma_e1 sigma_e2 sigma_c1 sigma_c2 sigma_c3 sigma_r1 sigma_r2 sigma_r3 kx ky objectness part",
    unsigned="id status label seen fused reason part",
)
"""Name and PointField datatype of every field, in the order of the message."""


@dataclass(frozen=True, eq=False)
class SuperquadricArray(Columns):
    """n superquadrics, column by column; see the module for units and conventions.

    Numbers are float32 (n,) or (n, k), id, status, label, seen, fused, reason and part uint32 (n,).  Those with a
    default are 0 if not given, deviations and objectness NaN.  Raises ValueError as
    :class:`~sq_msgs_py.columns.Columns` does.
    """

    FIELDS = FIELDS

    size: np.ndarray = field(metadata=column("a1", "a2", "a3", is_finite=True))
    shape: np.ndarray = field(metadata=column("e1", "e2", is_finite=True))
    translation: np.ndarray = field(metadata=column("x", "y", "z", is_finite=True))
    rotation: np.ndarray = field(metadata=column("qx", "qy", "qz", "qw", is_finite=True))
    score: np.ndarray = field(metadata=column("score"))
    residual: np.ndarray = field(metadata=column("residual"))
    sigma_size: np.ndarray = field(metadata=column("sigma_a1", "sigma_a2", "sigma_a3"))
    id: np.ndarray = field(metadata=column("id"))
    status: np.ndarray = field(metadata=column("status"))
    label: np.ndarray | None = field(default=None, metadata=column("label"))
    seen: np.ndarray | None = field(default=None, metadata=column("seen"))
    fused: np.ndarray | None = field(default=None, metadata=column("fused"))
    reason: np.ndarray | None = field(default=None, metadata=column("reason"))
    sigma_shape: np.ndarray | None = field(default=None, metadata=column("sigma_e1", "sigma_e2"))
    sigma_centre: np.ndarray | None = field(default=None, metadata=column("sigma_c1", "sigma_c2", "sigma_c3"))
    sigma_turn: np.ndarray | None = field(default=None, metadata=column("sigma_r1", "sigma_r2", "sigma_r3"))
    taper: np.ndarray = field(
        default=None,  # type: ignore[arg-type]
        metadata=column("kx", "ky", missing=0.0),
    )
    objectness: np.ndarray | None = field(default=None, metadata=column("objectness"))
    part: np.ndarray = field(default=None, metadata=column("part"))  # type: ignore[arg-type]

    def parts_of(self, number: int) -> SuperquadricArray:
        """Return the parts of the object with this id; none where it is one body."""
        return self.where((self.part > 0) & (self.id == number))

    def followed_by(self, other: SuperquadricArray) -> SuperquadricArray:
        """Join the rows of this array and those of another one."""
        columns = {each.name: (getattr(self, each.name), getattr(other, each.name)) for each in fields(self)}
        return replace(self, **{name: np.concatenate(both) for name, both in columns.items()})

    @property
    def recovered(self) -> SuperquadricArray:
        """The bodies of objects that did not fail, in their order, without parts."""
        return self.where((self.status != FAILED) & (self.part == 0))

    @property
    def with_parts(self) -> tuple[SuperquadricArray, np.ndarray]:
        """The ``recovered`` bodies, then their parts, and whose each row is: positions (n,) in ``recovered``."""
        whole = self.recovered
        parts = self.where((self.part > 0) & np.isin(self.id, whole.id))
        order = np.argsort(whole.id, kind="stable")
        owner = order[np.searchsorted(whole.id, parts.id, sorter=order)]
        return whole.followed_by(parts), np.append(np.arange(len(whole)), owner)

    def where(self, kept: np.ndarray) -> SuperquadricArray:
        """Those of a mask (n,), in their order."""
        return replace(self, **{each.name: getattr(self, each.name)[kept] for each in fields(self)})

    @classmethod
    def empty(cls) -> SuperquadricArray:
        """No superquadric at all."""
        return cls(**{each.name: np.empty(0, np.uint32) for each in fields(cls)})


def to_message(superquadrics: SuperquadricArray, header: Any, types: MessageTypes = find_type) -> PointCloud2:
    """Return the message of n superquadrics (n may be 0) with this std_msgs/Header, of the classes in ``types``."""
    return columns.to_message(superquadrics, header, types)


def from_message(message: PointCloud2) -> SuperquadricArray:
    """Return the superquadrics of a message; fields are found by name, unknown ones are left aside.

    Raises MessageError if a field is missing, has an unknown datatype, a count other than one or an offset outside the
    point, or if the data is not as long as width, height and steps require.
    """
    return columns.from_message(SuperquadricArray, message)
