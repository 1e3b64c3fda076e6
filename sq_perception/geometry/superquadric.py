"""The superquadric: one equation, its gauge, and what follows from them in closed form.

Equation
--------
In the object's own frame, with half sizes a1 a2 a3 and exponents e1 (along z) and e2 (in the xy plane),

    F(x, y, z) = (|x/a1|^(2/e2) + |y/a2|^(2/e2))^(e2/e1) + |z/a3|^(2/e1)              (thesis, equation 3.7)

is below 1 inside, 1 on the surface and above 1 outside.  The gauge

    g = F^(e1/2) = || ( || (x/a1, y/a2) ||_{2/e2},  z/a3 ) ||_{2/e1}

is a norm for e1, e2 <= 2: degree one, convex, g = 1 on the surface.  All else is computed from g: F = g^(2/e1), and the
thesis' adjusted function F^e1 = g^2 (equation 6.4).

A tapered body (A. Barr 1984; F. Solina, R. Bajcsy, PAMI 12(2), 1990) has the gauge g(x', y', z) with

    x' = x / (1 + k_x z/a3),    y' = y / (1 + k_y z/a3),    |k| < 1:

its section at z is scaled by 1 + k z/a3, from 1 - k at its lower to 1 + k at its upper end; a1 and a2 are the half
sizes of the section in the middle.  Beyond the narrow end the scale stays that of the end.  g is then no norm, and the
body need not be convex: for exponents up to 1 it is where k_x = k_y and |k| < 0.7, and nearly so otherwise.

Each of the two p-norms, p = 2/e, is evaluated in ratio form: the larger term is factored out and the rest goes through
log1p.  Nothing overflows down to e = 0.01, no epsilon shifts the surface, and gradients are finite on the axes.

Conventions
-----------
Metres and radians; ``rotation`` is a quaternion x y z w from object to parent frame, ``translation`` the centre in the
parent frame.  The flat order is a1 a2 a3 e1 e2 t1 t2 t3 qx qy qz qw (thesis, equation 3.12); where tapers are known,
k_x and k_y come after it.

Reference: A. Jaklic, A. Leonardis, F. Solina, Segmentation and Recovery of Superquadrics, Kluwer 2000, chapter 2.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from array_api_compat import array_namespace, is_torch_array

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.body_numbers import LEAST_CONJUGATE, LENGTHS, check_turn, floating, one_body

Array = Any  # a NumPy array or a torch tensor

NUMBERS = sum(LENGTHS.values())
FLAT_LENGTH = NUMBERS - LENGTHS["taper"]  # numbers of a body with and without its taper
_NEGLIGIBLE_RATIO = 1e-30
_HALF_TURNS = np.array([[0.0, 0, 0, 1], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]])
_QUARTER_TURN = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])


@dataclass(frozen=True, eq=False)
class Superquadric:
    """A superquadric or a batch of them, in NumPy or in torch.

    Attributes
    ----------
    size : (..., 3)
        Half sizes a1 a2 a3 in metres, positive.
    shape : (..., 2)
        Exponents e1 (along z) and e2 (in xy), in (0, 2]: 0.1 is a box, 1 an ellipsoid, 2 an octahedron.
    translation : (..., 3)
        The centre in the parent frame, metres.
    rotation : (..., 4)
        Unit quaternion x y z w, object to parent.
    taper : (..., 2), optional
        k_x and k_y, each from -0.95 to 0.95; 0 if not given.

    Raises
    ------
    ValueError
        If a field has the wrong length, or (NumPy only: a tensor may live on a busy device) is not finite, not positive
        or names no rotation.  NumPy quaternions are normalised on the way in.
    """

    size: Array
    shape: Array
    translation: Array
    rotation: Array
    taper: Array = None

    def __post_init__(self) -> None:
        taper = self.taper
        if taper is None:
            taper = 0 * self.size[..., :2] if is_torch_array(self.size) else np.zeros(2)
        parts = [self.size, self.shape, self.translation, self.rotation, taper]
        if (numbers := one_body(parts)) is not None:
            fixed = numbers[0:3], numbers[3:5], numbers[5:8], numbers[8:12], numbers[12:14]
            self.__dict__.update(zip(LENGTHS, fixed, strict=True))
            return
        tensors = [is_torch_array(part) for part in parts]
        if any(tensors) and not all(tensors):
            raise ValueError("a Superquadric is all NumPy or all torch, not a mixture")
        if not tensors[0]:
            parts = [floating(part) for part in parts]
        for (name, length), part in zip(LENGTHS.items(), parts, strict=True):
            if part.ndim == 0 or part.shape[-1] != length:
                raise ValueError(f"{name}: expected shape (..., {length}), got {tuple(part.shape)}")
        if tensors[0]:
            self.__dict__["taper"] = taper
            return
        parts[3] = check_turn(parts)
        batch = np.broadcast_shapes(*{part.shape[:-1] for part in parts})
        for (name, length), part in zip(LENGTHS.items(), parts, strict=True):
            shown = part.view() if part.shape[:-1] == batch else np.broadcast_to(part, (*batch, length))
            shown.setflags(write=False)  # as those that were broadcast
            self.__dict__[name] = shown

    # Batches and flat vectors

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """The leading dimensions; () for a single body."""
        return tuple(self.size.shape[:-1])

    def __getitem__(self, index: Any) -> Superquadric:
        """Index the leading dimensions."""
        if not self.batch_shape:  # a slice would be of its numbers
            raise TypeError("a single Superquadric cannot be indexed")
        return Superquadric(*(getattr(self, name)[index] for name in LENGTHS))

    def __len__(self) -> int:
        if not self.batch_shape:
            raise TypeError("a single Superquadric has no length")
        return self.batch_shape[0]

    def __iter__(self) -> Iterator[Superquadric]:
        return (self[i] for i in range(len(self)))

    @property
    def is_tapered(self) -> bool:
        """Whether any of the bodies tapers."""
        return bool((self.taper != 0).any())

    def to_flat(self) -> Array:
        """Return flat parameters (..., 12): a1 a2 a3 e1 e2 t1 t2 t3 qx qy qz qw.  Raises ValueError for bodies that
        taper, as this order has no place for it."""
        if self.is_tapered:
            raise ValueError("expected bodies without a taper; `to_numbers` has a place for it")
        return self.to_numbers()[..., :FLAT_LENGTH]

    def to_numbers(self) -> Array:
        """Return all parameters (..., 14): those of :meth:`to_flat`, then k_x k_y."""
        xp = array_namespace(self.size)
        return xp.concat([self.size, self.shape, self.translation, self.rotation, self.taper], axis=-1)

    @classmethod
    def from_flat(cls, flat: Array) -> Superquadric:
        """Invert :meth:`to_flat` and, for arrays (..., 14), :meth:`to_numbers`."""
        if not is_torch_array(flat):
            flat = np.asarray(flat, dtype=float)
        if flat.ndim == 0 or flat.shape[-1] not in (FLAT_LENGTH, NUMBERS):
            raise ValueError(f"expected flat parameters of shape (..., {FLAT_LENGTH}), got {tuple(flat.shape)}")
        taper = flat[..., FLAT_LENGTH:] if flat.shape[-1] == NUMBERS else None
        return cls(flat[..., 0:3], flat[..., 3:5], flat[..., 5:8], flat[..., 8:12], taper)

    @classmethod
    def at_origin(cls, size: np.ndarray, shape: np.ndarray, taper: np.ndarray | None = None) -> Superquadric:
        """Make bodies of these sizes (..., 3), exponents (..., 2) and tapers (..., 2) in their own frame."""
        size, shape = np.asarray(size, float), np.asarray(shape, float)
        return cls(size, shape, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), taper)

    @classmethod
    def stack(cls, bodies: list[Superquadric]) -> Superquadric:
        """Stack equally shaped bodies to a batch (n, ...); an empty list gives an empty NumPy batch."""
        if not bodies:
            return cls(np.empty((0, 3)), np.empty((0, 2)), np.empty((0, 3)), np.empty((0, 4)))
        xp = array_namespace(bodies[0].size)
        return cls.from_flat(xp.stack([body.to_numbers() for body in bodies]))

    def untapered(self) -> Superquadric:
        """Return the bodies without taper, all sections as large as at the wide end: they enclose the tapered ones."""
        return Superquadric(self.size * self._largest(), self.shape, self.translation, self.rotation)

    def with_taper(self, taper: Array) -> Superquadric:
        """Invert :meth:`untapered`, for untapered bodies."""
        shaped = Superquadric(self.size, self.shape, self.translation, self.rotation, taper)
        return Superquadric(self.size / shaped._largest(), self.shape, self.translation, self.rotation, taper)

    def _largest(self) -> Array:
        """Return half sizes (..., 3) at the wide end, as multiples of those in the middle."""
        xp = array_namespace(self.size)
        return 1 + xp.concat([xp.abs(self.taper), 0 * self.taper[..., :1]], axis=-1)

    # Motion

    @property
    def rotation_matrix(self) -> Array:
        """Return the rotation from object to parent, (..., 3, 3)."""
        return quaternions.to_matrix(self.rotation)

    def to_object(self, points: Array) -> Array:
        """Transform points (..., N, 3) from the parent frame to the object's frame."""
        return (points - self.translation[..., None, :]) @ self.rotation_matrix

    def to_parent(self, points: Array) -> Array:
        """Transform points (..., N, 3) from the object's frame to the parent frame."""
        xp = array_namespace(points)
        return points @ xp.linalg.matrix_transpose(self.rotation_matrix) + self.translation[..., None, :]

    def transformed(self, rotation: Array, translation: Array, scale: float | Array = 1.0) -> Superquadric:
        """Return the same body in another frame: p_new = scale * R(rotation) p + translation.

        Half sizes grow with ``scale`` (a number, or an array (..., 1)); shape and taper stay.
        """
        matrix = quaternions.to_matrix(rotation)
        moved = (matrix @ self.translation[..., None])[..., 0] * scale + translation
        turned = quaternions.multiply(rotation, self.rotation)
        return Superquadric(self.size * scale, self.shape, moved, turned, self.taper)

    # The surface

    def gauge(self, points: Array) -> Array:
        """Return g at points (..., N, 3) of the parent frame, shape (..., N); 1 on the surface."""
        return nested_norm(*self._in_units(self.to_object(points))[1])

    def _in_units(self, points: Array) -> tuple[Array, tuple[Array, ...]]:
        """Return the scale of the sections at points of the object's frame, and the arguments of the nested norm."""
        xp = array_namespace(points)
        x, y, z = (xp.abs(points[..., k]) / self.size[..., None, k] for k in range(3))
        scale = self._section(points)
        return scale, (x / scale[..., 0], y / scale[..., 1], z, self.shape[..., None, 0], self.shape[..., None, 1])

    def _section(self, points: Array) -> Array:
        """Return the scale (..., N, 2) of the sections at points (..., N, 3) of the object's frame."""
        xp = array_namespace(points)
        high = (points[..., 2] / self.size[..., None, 2])[..., None]
        taper = self.taper[..., None, :]
        scale, narrow = 1 + taper * high, 1 - xp.abs(taper)
        return xp.where(scale >= narrow, scale, narrow)  # no maximum: its gradient is half where both are 1

    def inside_outside(self, points: Array) -> Array:
        """Return F at points (..., N, 3), shape (..., N) (thesis, equation 3.7); may overflow far from sharp bodies."""
        return self.gauge(points) ** (2 / self.shape[..., None, 0])

    def adjusted_inside_outside(self, points: Array) -> Array:
        """Return F^e1 = g^2 at points (..., N, 3), shape (..., N) (thesis, equation 6.4)."""
        return self.gauge(points) ** 2

    def occupancy(self, points: Array, sharpness: float | Array) -> Array:
        """Return soft occupancy sigma(s (1 - F^e1)) at points (..., N, 3), in (0, 1) (thesis, equation 6.6)."""
        xp = array_namespace(points)
        exponent = xp.clip(-sharpness * (1 - self.adjusted_inside_outside(points)), -60.0, 60.0)
        return 1 / (1 + xp.exp(exponent))

    def gauge_gradient(self, points: Array) -> Array:
        """Return the gradient of g at points (..., N, 3) in the parent frame, shape (..., N, 3); zero at the centre."""
        return self._gauge_and_gradient(points)[1]

    def normals(self, points: Array) -> Array:
        """Return outward unit normals at surface points (..., N, 3) in the parent frame, shape (..., N, 3)."""
        gradient = self.gauge_gradient(points)
        xp = array_namespace(gradient)
        return gradient / xp.sqrt(xp.sum(gradient * gradient, axis=-1, keepdims=True))

    def sampson_distance(self, points: Array) -> Array:
        """Return (g - 1) / |grad g| of points (..., N, 3), the first order distance, metres, positive outside."""
        gauge, gradient = self._gauge_and_gradient(points)
        xp = array_namespace(gradient)
        length = xp.sqrt(xp.sum(gradient * gradient, axis=-1))
        return (gauge - 1) / xp.where(length > 0, length, xp.ones_like(length))

    def signed_distance(self, points: np.ndarray, *, gradient: bool = False) -> Any:
        """Return a lower bound of the signed distance of points (N, 3), metres, negative inside; NumPy only.

        Of the nearest body of a batch (k,), shape (N,), and with ``gradient`` its gradient (N, 3) too.  The bound, and
        where it is exact: :mod:`sq_perception.geometry.signed_distance`.
        """
        from sq_perception.geometry.signed_distance import signed_distance

        found = signed_distance(self, points)
        return found if gradient else found[0]

    def _gauge_and_gradient(self, points: Array) -> tuple[Array, Array]:
        p = self.to_object(points)
        xp = array_namespace(p)
        scale, arguments = self._in_units(p)
        gauge, slopes = nested_norm_and_slopes(*arguments)
        gradient = xp.stack(slopes, axis=-1) * xp.sign(p) / self.size[..., None, :]
        across = gradient[..., :2] / scale
        taper = self.taper[..., None, :]
        grows = xp.where(scale > 1 - xp.abs(taper), taper, 0 * taper) / self.size[..., None, 2:]
        along = gradient[..., 2] - xp.sum(across * p[..., :2] * grows / scale, axis=-1)
        gradient = xp.concat([across, along[..., None]], axis=-1)
        return gauge, gradient @ xp.linalg.matrix_transpose(self.rotation_matrix)

    def parametric_points(self, eta: Array, omega: Array) -> Array:
        """Return surface points (..., N, 3) in the parent frame at angles (N,) (thesis, equation 3.5).  ``eta`` in
        [-pi/2, pi/2] runs from pole to pole, ``omega`` in [-pi, pi) around z."""
        xp = array_namespace(self.size, eta)
        e1, e2 = self.shape[..., None, 0], self.shape[..., None, 1]
        ring = _signed_power(xp.cos(eta), e1)
        unit = xp.stack(
            [
                ring * _signed_power(xp.cos(omega), e2),
                ring * _signed_power(xp.sin(omega), e2),
                _signed_power(xp.sin(eta), e1) * xp.ones_like(omega),
            ],
            axis=-1,
        )
        scale = 1 + self.taper[..., None, :] * unit[..., 2:]
        unit = xp.concat([unit[..., :2] * scale, unit[..., 2:]], axis=-1)
        return self.to_parent(unit * self.size[..., None, :])

    def sample_surface(self, count: int, rng: np.random.Generator, oversampling: int = 12) -> np.ndarray:
        """Return nearly uniform surface points (..., count, 3) in the parent frame; NumPy only.

        Random directions v on the sphere, stretched by the half sizes, hit the untapered surface at p = a v / g.  Such
        a point stands for the area a1 a2 a3 r^3 |grad g| (r = 1 / g(a v), from the volume of a thin cone), so that
        systematic resampling with this weight out of ``oversampling * count`` candidates is uniform in area.  A taper
        moves the points along, and changes areas by f_x f_y times the change of |grad g|, f the scale of the section.
        """
        shape = (*self.batch_shape, oversampling * count, 3)
        direction = rng.standard_normal(shape)
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        local = Superquadric.at_origin(self.size, self.shape, self.taper)
        stretched = direction * self.size[..., None, :]
        gauge = Superquadric.at_origin(self.size, self.shape).gauge(stretched)
        points = stretched / gauge[..., None]
        scale = local._section(points)
        points[..., :2] *= scale
        area = np.linalg.norm(local.gauge_gradient(points), axis=-1) / gauge**3 * np.prod(scale, axis=-1)
        cumulative = np.cumsum(area, axis=-1)
        cumulative /= cumulative[..., -1:]
        steps = (np.arange(count) + rng.random((*self.batch_shape, 1))) / count
        # One sorted list for the whole batch: body k's weights fill the interval [k, k + 1].
        offset = np.arange(int(np.prod(self.batch_shape))).reshape(*self.batch_shape, 1)
        chosen = np.searchsorted((cumulative + offset).ravel(), (steps + offset).ravel()).reshape(steps.shape)
        chosen = np.minimum(chosen - offset * shape[-2], shape[-2] - 1)
        return self.to_parent(np.take_along_axis(points, chosen[..., None], axis=-2))

    # Closed forms

    def volume(self) -> np.ndarray:
        """Return the volume (...), m^3, of NumPy bodies: 2 a1 a2 a3 e1 e2 B(e1/2 + 1, e1) B(e2/2, e2/2) (1 + k_x k_y
        m).  m = B(3 e1/2, e1 + 1) / B(e1/2, e1 + 1) is the mean of (z/a3)^2 over the untapered body."""
        from scipy.special import beta  # here: a node that recovers does without

        size, shape = self.size, self.shape
        e1, e2 = shape[..., 0], shape[..., 1]
        straight = 2 * np.prod(size, axis=-1) * e1 * e2 * beta(e1 / 2 + 1, e1) * beta(e2 / 2, e2 / 2)
        return straight * (1 + np.prod(self.taper, axis=-1) * beta(1.5 * e1, e1 + 1) / beta(0.5 * e1, e1 + 1))

    def support(self, directions: Array) -> Array:
        """Return the support function, max of n.p over the body minus n.t, for unit n (..., N, 3), shape (..., N).

        The dual of the gauge: the same nested norm of a * |R^T n| with each exponent p = 2/e replaced by its conjugate
        2/(2 - e), that is e by 2 - e, but for octahedra.  The body touches the plane n.p = n.t + support.

        Of a body that tapers it is the largest support of its sections, see :func:`support_of_sections`.
        """
        n = directions @ self.rotation_matrix
        xp = array_namespace(n)
        q = xp.abs(n) * self.size[..., None, :]
        conjugate = xp.clip(2 - self.shape, min=LEAST_CONJUGATE)[..., None, :]
        if self.is_tapered:
            return support_of_sections(q, n[..., 2] * self.size[..., None, 2], conjugate, self.taper[..., None, :])
        return nested_norm(q[..., 0], q[..., 1], q[..., 2], conjugate[..., 0], conjugate[..., 1])

    def bounding_box(self) -> tuple[Array, Array]:
        """Return lower and upper corner (..., 3) of the axis-aligned box in the parent frame."""
        xp = array_namespace(self.size)
        ways = xp.eye(3, dtype=self.size.dtype)
        above = self.support(ways)
        below = self.support(-ways) if self.is_tapered else above
        return self.translation - below, self.translation + above

    # The same body, other numbers

    def equivalent_forms(self) -> Superquadric:
        """Return the 8 parameter vectors of the same body, batch shape (8, ...).  Half turns about x, y, z and none,
        then the same four after a quarter turn about z with a1 and a2 exchanged."""
        xp = array_namespace(self.size)
        turns = np.concatenate([_HALF_TURNS, quaternions.multiply(_QUARTER_TURN, _HALF_TURNS)])
        exchanged = xp.stack([self.size[..., k] for k in (1, 0, 2)], axis=-1)
        taper, other = self.taper, xp.stack([self.taper[..., k] for k in (1, 0)], axis=-1)
        tapers = [taper, -taper, -taper, taper, other, -other, -other, other]
        forms = []
        for turn, size, ends in zip(turns, [self.size] * 4 + [exchanged] * 4, tapers, strict=True):
            step = xp.asarray(turn, dtype=self.rotation.dtype) + xp.zeros_like(self.rotation)
            turned = quaternions.multiply(self.rotation, step)
            forms.append(xp.concat([size, self.shape, self.translation, turned, ends], axis=-1))
        return Superquadric.from_flat(xp.stack(forms))

    def canonical_form(self) -> Superquadric:
        """Return the form of the 8 with a1 >= a2, then the smallest rotation angle, then qw >= 0.

        NumPy bodies only.  A half turn about an axis moves that axis' component of the quaternion to qw, up to sign, so
        that the largest component names the half turn of the smallest angle; among equals qw, then x, y, z wins.
        Where a1 = a2 no quarter turn is tried, and of two forms of equal angles either may come out: such bodies have
        several representatives.
        """
        swapped = self.size[..., :1] < self.size[..., 1:2]
        size = np.where(swapped, self.size[..., [1, 0, 2]], self.size)
        q = quaternions.multiply(self.rotation, np.where(swapped, _QUARTER_TURN, _HALF_TURNS[0]))
        largest = np.argmax(np.round(np.abs(q[..., [3, 0, 1, 2]]), 12), axis=-1)
        q = quaternions.multiply(q, _HALF_TURNS[largest])
        q = q * np.where(q[..., 3:] < 0, -1.0, 1.0)
        # Half turns about x and y exchange the ends of the z axis, and with them the sign of the taper.
        ends = np.where((largest == 1) | (largest == 2), -1.0, 1.0)[..., None]
        taper = np.where(swapped, self.taper[..., ::-1], self.taper) * ends + 0.0  # no -0
        return Superquadric(size, self.shape, self.translation, q, taper)


def support_of_sections(q: Array, along: Array, conjugate: Array, taper: Array) -> Array:
    """Return the support (..., N) of tapered bodies: the largest of their sections.

    The section at z = t a3 has n_z a3 t + sigma S(t): (t, sigma) runs on the profile, a unit ball, and S is the dual
    norm of (a1 f1 n_x, a2 f2 n_y).  Along the profile, t = +-sin^e1(w) and sigma = cos^e1(w), octahedra have several
    maxima: the best of some points is followed by golden sections.

    q: (..., N, 3), a |n|, n the direction in the object's frame.
    along: (..., N), n_z a3.
    conjugate: (..., 1, 2), 2 - e.
    taper: (..., 1, 2).
    """
    least = 1e-12  # least sine and cosine of a point on a profile: the derivatives of their powers stay finite
    scan, golden = 25, (math.sqrt(5) - 1) / 2
    xp = array_namespace(q)
    e1, e2 = 2 - conjugate[..., 0], conjugate[..., 1]

    def at(w: Array) -> Array:
        """The support by one point of the profile."""
        sine, cosine = xp.abs(xp.sin(w)), xp.clip(xp.cos(w), min=least)
        t = xp.sign(w) * xp.clip(sine, min=least) ** e1 * (sine > 0)
        u, v = q[..., 0] * (1 + taper[..., 0] * t), q[..., 1] * (1 + taper[..., 1] * t)
        return along * t + cosine**e1 * p_norm(u, v, e2)

    step = math.pi / (scan - 1)
    still = 0 * (along + q[..., 0] + taper[..., 0])
    values = xp.stack([at(k * step - math.pi / 2 + still) for k in range(scan)], axis=-1)
    low = (xp.argmax(values, axis=-1) - 1) * step - math.pi / 2 + still
    high = low + 2 * step
    for _ in range(45):
        left, right = high - golden * (high - low), low + golden * (high - low)
        falls = at(left) > at(right)
        low, high = xp.where(falls, low, left), xp.where(falls, right, high)
    return xp.maximum(at((low + high) / 2), xp.max(values, axis=-1))


def nested_norm(x: Array, y: Array, z: Array, e1: Array, e2: Array) -> Array:
    """Return || ( || (x, y) ||_{2/e2}, z ) ||_{2/e1} for x, y, z >= 0: the gauge in units of the half sizes."""
    return p_norm(p_norm(x, y, e2), z, e1)


def nested_norm_and_slopes(
    x: Array, y: Array, z: Array, e1: Array, e2: Array
) -> tuple[Array, tuple[Array, Array, Array]]:
    """Return the nested norm and its partial derivatives with respect to x, y and z."""
    h, h_x, h_y = _p_norm_and_slopes(x, y, e2)
    g, g_h, g_z = _p_norm_and_slopes(h, z, e1)
    return g, (g_h * h_x, g_h * h_y, g_z)


def p_norm(u: Array, v: Array, e: Array) -> Array:
    """Return (u^(2/e) + v^(2/e))^(e/2) for u, v >= 0, elementwise, in ratio form.  Guarded twice, so that neither value
    nor gradient is anything but finite at u = 0, v = 0 or both."""
    big, power = _ratio_form(u, v, e)
    xp = array_namespace(big)
    return big * xp.exp(0.5 * e * xp.log1p(power))


def _ratio_form(u: Array, v: Array, e: Array) -> tuple[Array, Array]:
    """Return the larger of u and v, and (smaller / larger)^(2/e)."""
    xp = array_namespace(u, v)
    big, small = xp.maximum(u, v), xp.minimum(u, v)
    ratio = small / xp.where(big > 0, big, xp.ones_like(big))
    kept = ratio > _NEGLIGIBLE_RATIO
    safe = xp.where(kept, ratio, xp.ones_like(ratio))
    power = xp.exp(2 / e * xp.log(safe))
    return big, xp.where(kept, power, xp.zeros_like(power))


def _p_norm_and_slopes(u: Array, v: Array, e: Array) -> tuple[Array, Array, Array]:
    """Return the p-norm and its partial derivatives with respect to u and v."""
    big, power = _ratio_form(u, v, e)
    xp = array_namespace(big)
    log_sum = xp.log1p(power)
    norm = big * xp.exp(0.5 * e * log_sum)
    of_big = xp.exp((0.5 * e - 1) * log_sum)
    ratio = xp.minimum(u, v) / xp.where(big > 0, big, xp.ones_like(big))
    safe = xp.where(ratio > _NEGLIGIBLE_RATIO, ratio, xp.ones_like(ratio))
    of_small = of_big * power / safe
    first = u >= v
    return norm, xp.where(first, of_big, of_small), xp.where(first, of_small, of_big)


def _signed_power(base: Array, exponent: Array) -> Array:
    xp = array_namespace(base)
    return xp.sign(base) * xp.abs(base) ** exponent
