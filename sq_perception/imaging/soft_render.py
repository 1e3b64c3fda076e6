"""Soft images of superquadrics: the thesis' differentiable renderer on a grid and along lines of sight.

Grids (thesis, chapters 6.3.2 and 7.4)
--------------------------------------
Occupancy (6.6) on a grid of points, voxel k = 1..n of a line of sight counted from the viewer:

    V = sigma(s (1 - F^e1))

depth projection (7.9, 7.10) along the line of sight:

    A_k = exp(-tau sum_{l <= k} V_l),        T(V) = 1 - 1/n sum_k A_k

A_k stays 1 until a voxel is hit and then drops to 0, so the sum counts the empty voxels before the surface: T is the
image of the unit cube (:mod:`sq_perception.imaging.unit_cube`), z of the nearest surface, near 0 where there is none.
s is the sharpness of a body's boundary, tau that of the hit; both large make T the exact image, up to half a voxel.

Lines of sight
--------------
A line of sight is parallel to z at (x, y), seen from large z.  Along it the gauge g is convex, so that it has one
nearest approach z*, the minimiser of g, found by bisection of dg/dz; a value above min g is reached once in front of z*
and once behind it.

    the line misses the body      min g > 1
    d(min g)/dy = dg/dy at z*     (the minimiser's own motion does not count), so z* needs no gradient

Soft depth is T as the number n of voxels grows with the density D = n tau held fixed:

    T = z_0 - int_0^z_0 exp(-D int_z^z_0 V dz') dz,        V = sigma(s (1 - F^e1)) = sigma(s (1 - g^2)).

V is neither 0 nor 1 in a layer of about a / s only.  A grid must be finer than that, 64^3 voxels at the thesis' s; here
``cells`` cells lie where the line crosses the layer, and V is constant in each of them, so that the inner integrals
are exact: cost and accuracy do not depend on s.  Where the cells lie carries no gradient, as T does not depend on it.

All functions are torch, batched over bodies (n,) in the cube frame (y up, z towards the viewer), and differentiable;
lines (r, 2) = (x, y) are shared by all bodies or (n, r, 2).
"""

from __future__ import annotations

import math

import torch

from sq_perception.geometry.superquadric import Superquadric, nested_norm, nested_norm_and_slopes


def grid_points(resolution: int) -> torch.Tensor:
    """Points (resolution,) of [0, 1], ends included: an axis of the thesis' grid and of its images."""
    return torch.linspace(0, 1, resolution, dtype=torch.float64)


def occupancy_grid(bodies: Superquadric, axis: torch.Tensor, sharpness: float) -> torch.Tensor:
    """Soft occupancy of each body, (n, rows, columns, voxels).

    bodies: Torch batch (n,).
    axis: (r,), coordinates shared by x, y and z, ascending.  Rows run from the largest y down, columns along x, voxels
        from the viewer (largest z) away.
    sharpness: s, positive.
    """
    _check_positive("s", sharpness)
    y, x, z = torch.meshgrid(axis.flip(0), axis, axis.flip(0), indexing="ij")
    points = torch.stack([x, y, z], dim=-1).reshape(-1, 3)
    return bodies.occupancy(points, sharpness).reshape(-1, *x.shape)


def depth_projection(occupancy: torch.Tensor, tau: float) -> torch.Tensor:
    """T(V) of occupancy grids (..., voxels), shape (...), in [0, 1] (equations 7.9 and 7.10)."""
    _check_positive("tau", tau)
    return 1 - torch.exp(-tau * occupancy.cumsum(dim=-1)).mean(dim=-1)


def _check_positive(name: str, value: float) -> None:
    if not value > 0:
        raise ValueError(f"{name}: expected a positive number, got {value}")


def of_view(
    view: torch.Tensor, stride: int = 1, row: int = 0, column: int = 0, framing: str = "cropped"
) -> tuple[torch.Tensor, torch.Tensor]:
    """Lines (r, 2) of every ``stride``-th pixel of views (n, p, p), and the views' values (n, r) there.  Column k of a
    cropped canonical view is seen along x = (k + 1/2) / p; of a full frame, x = k / (p - 1)."""
    pixels = view.shape[-1]
    columns = torch.arange(pixels, dtype=torch.float64, device=view.device)
    centres = (columns / (pixels - 1) if framing == "full" else (columns + 0.5) / pixels).to(view.dtype)
    y, x = torch.meshgrid(1 - centres[row::stride], centres[column::stride], indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2), view[..., row::stride, column::stride].flatten(-2)


def gauge(bodies: Superquadric, lines: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
    """g (n, r) on each line at heights z (n, r)."""
    return bodies.gauge(_points(lines, z))


@torch.no_grad()
def nearest_approach(bodies: Superquadric, lines: torch.Tensor) -> torch.Tensor:
    """z* (n, r), where g is least along each line; without gradient."""
    return _Search(bodies, lines).nearest()


def free_space_excess(bodies: Superquadric, lines: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
    """How deep each line runs inside the body before it ends: max(0, 1 - min g), (n, r), differentiable.  ``depth`` (n,
    r) is z where the line met a surface, and 0 or less where it met none and goes on for ever."""
    end = torch.where(depth > 0, depth, torch.full_like(depth, -math.inf))
    return (1 - gauge(bodies, lines, torch.maximum(nearest_approach(bodies, lines), end))).clamp(min=0)


def soft_depth(
    bodies: Superquadric, lines: torch.Tensor, sharpness: float, density: float, cells: int = 12
) -> torch.Tensor:
    """T (n, r) of each body alone, at least 0; see the module.

    sharpness: s of the occupancy, positive.
    density: D = n tau of a grid of n voxels, positive.
    cells: Cells a line.
    """
    if not (sharpness > 0 and density > 0 and cells > 0):
        raise ValueError(f"expected positive s, D and cells, got {sharpness}, {density}, {cells}")
    first, last = _layer(bodies, lines, sharpness, density)
    step = (first - last) / cells
    share = (torch.arange(cells, dtype=first.dtype, device=first.device) + 0.5) / cells
    z = first[..., None] - (first - last)[..., None] * share
    points = _points(lines[..., :, None, :], z)
    occupancy = bodies.occupancy(points.flatten(1, 2), sharpness).reshape(z.shape)
    thickness = density * step[..., None] * occupancy
    behind = thickness.cumsum(-1)
    passed = torch.exp(thickness - behind) * _mean_of_decay(thickness)
    return first - step * passed.sum(-1) - last * torch.exp(-behind[..., -1])


@torch.no_grad()
def _layer(
    bodies: Superquadric, lines: torch.Tensor, sharpness: float, density: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """First and last z (n, r), seen from the viewer, between which a line's soft depth is decided."""
    # The layer ends where s (g^2 - 1) or the optical depth has this value: V, or what is still seen, is below 1/400.
    layer = 6.0
    search = _Search(bodies, lines)
    nearest = search.nearest()
    least = search.gauge(nearest)
    # A line that passes the layer by meets the body's faint outside all the same: where it is least faint.
    level = torch.sqrt(least.clamp(min=1.0) ** 2 + layer / sharpness)
    # g grows by 1 over every reach, less what it was: far enough out every level is passed.
    span = (level + least) * search.reach
    first = search.crossing(level, nearest, nearest + span)
    behind = search.crossing(level, nearest, nearest - span)
    entry = search.crossing(torch.ones_like(least), nearest, first)
    hit = entry - (first - entry) - layer / density
    last = torch.where(least < 1, torch.maximum(hit, behind), behind)
    first = first.clamp(min=0.0)
    return first, torch.minimum(last.clamp(min=0.0), first)


class _Search:
    """Lines in each body's own frame, scaled by its half sizes, so that a look at g costs two norms and no more."""

    def __init__(self, bodies: Superquadric, lines: torch.Tensor) -> None:
        count, toward = (len(bodies), lines.shape[-2]), torch.tensor([[0.0, 0.0, 1.0]]).to(bodies.size)
        origin = bodies.to_object(_points(lines, lines.new_zeros(count))) / bodies.size[:, None, :]
        direction = bodies.rotation_matrix[:, 2, :] / bodies.size
        self._origin = [origin[..., k].contiguous() for k in range(3)]
        self._direction = [direction[:, k, None] for k in range(3)]
        self._shape = bodies.shape[:, :1], bodies.shape[:, 1:]
        # Halvings of the body's extent along z.  Training is in single precision and needs no more than where to put
        # its cells; double precision is asked for by checks of gradients.
        self._halvings = 40 if lines.dtype == torch.float64 else 9
        self._middle = bodies.translation[:, 2:].expand(count)
        self.reach = bodies.support(toward)  # half the body's extent along z, (n, 1)

    def gauge(self, z: torch.Tensor) -> torch.Tensor:
        x, y, z = (torch.abs(o + z * d) for o, d in zip(self._origin, self._direction, strict=True))
        return nested_norm(x, y, z, *self._shape)

    def nearest(self) -> torch.Tensor:
        low, high = self._middle - self.reach, self._middle + self.reach
        for _ in range(self._halvings):
            middle = 0.5 * (low + high)
            falling = self._slope(middle) < 0
            low, high = torch.where(falling, middle, low), torch.where(falling, high, middle)
        return 0.5 * (low + high)

    def crossing(self, level: torch.Tensor, inside: torch.Tensor, outside: torch.Tensor) -> torch.Tensor:
        """z between ``inside``, where g <= level, and ``outside``, where g >= level; else ``inside``."""
        for _ in range(self._halvings):
            middle = 0.5 * (inside + outside)
            below = self.gauge(middle) < level
            inside, outside = torch.where(below, middle, inside), torch.where(below, outside, middle)
        return 0.5 * (inside + outside)

    def _slope(self, z: torch.Tensor) -> torch.Tensor:
        x, y, z = (o + z * d for o, d in zip(self._origin, self._direction, strict=True))
        _, slopes = nested_norm_and_slopes(torch.abs(x), torch.abs(y), torch.abs(z), *self._shape)
        along = [k * d for k, d in zip(slopes, self._direction, strict=True)]
        return torch.sign(x) * along[0] + torch.sign(y) * along[1] + torch.sign(z) * along[2]


def _mean_of_decay(thickness: torch.Tensor) -> torch.Tensor:
    """(1 - exp(-x)) / x for x >= 0, the mean of what is left across a cell; smooth through zero."""
    small = thickness < 1e-3
    safe = torch.where(small, torch.ones_like(thickness), thickness)
    return torch.where(small, 1 - 0.5 * thickness, -torch.expm1(-safe) / safe)


def _points(lines: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
    return torch.cat([lines.expand(*z.shape, 2), z[..., None]], dim=-1)
