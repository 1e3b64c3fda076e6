"""The residuals of the fits once more, in torch: short to read, any device, autograd.

The kernels of :mod:`sq_perception.fitting.residuals` are compared with this; symbols as there.  Bodies are single torch
:class:`Superquadric` objects, rays are origins and directions (n, 3) in the optical frame.  Scales that the kernels
hold fixed in their derivatives are detached here.
"""

import torch

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric

_BISECTIONS = 80


def moved(body: Superquadric, step: torch.Tensor) -> Superquadric:
    """The body after a step (13,): d log a, d e, d t, a rotation vector in the object frame and d k."""
    turn = quaternions.from_rotation_vector(step[8:11])
    return Superquadric(
        body.size * torch.exp(step[0:3]), body.shape + step[3:5], body.translation + step[5:8],
        quaternions.multiply(body.rotation, turn), body.taper + step[11:13],
    )


def classic(body: Superquadric, points: torch.Tensor) -> torch.Tensor:
    """sqrt(a1 a2 a3) (F^e1 - 1) at points (n, 3), shape (n,)."""
    return torch.sqrt(torch.prod(body.size)) * (body.adjusted_inside_outside(points) - 1)


def sampson(body: Superquadric, points: torch.Tensor) -> torch.Tensor:
    """(g - 1) / |grad g| at points (n, 3), metres, shape (n,)."""
    return (body.gauge(points) - 1) / _slope(body, points).detach().norm(dim=-1)


def rendered(
    body: Superquadric, origin: torch.Tensor, direction: torch.Tensor, depth: torch.Tensor, grazing: float
) -> torch.Tensor:
    """(z_hit - z) c of rays that hit the body, metres; the gradient flows through the intersection."""
    lowest = _lowest(body, origin, direction)
    near, far = lowest - 4 * body.size.detach().max(), lowest
    for _ in range(_BISECTIONS):
        middle = (near + far) / 2
        outside = body.gauge(origin + middle[:, None] * direction).detach() > 1
        near, far = torch.where(outside, middle, near), torch.where(outside, far, middle)
    hit = origin + far[:, None] * direction
    slope = _slope(body, hit).detach()
    along = (slope * direction).sum(-1)
    across = grazing * slope.square().sum(-1) * direction.square().sum(-1)
    z_hit = far - (body.gauge(hit) - 1) / along
    return (z_hit - depth) * along.abs() / torch.sqrt(along.square() + across)


def outline(
    body: Superquadric, origin: torch.Tensor, direction: torch.Tensor, free_depth: torch.Tensor
) -> torch.Tensor:
    """(1 - min g) / |grad g| along rays up to a depth, metres: positive where a ray runs inside the body."""
    point = origin + torch.minimum(_lowest(body, origin, direction), free_depth)[:, None] * direction
    return (1 - body.gauge(point)) / _slope(body, point).detach().norm(dim=-1)


def lowest_height(body: Superquadric, plane: torch.Tensor) -> torch.Tensor:
    """Height () of the body's lowest point above the plane n.x + d, metres."""
    return plane[:3] @ body.translation + plane[3] - body.support(-plane[None, :3])[0]


def leaning(body: Superquadric, plane: torch.Tensor) -> torch.Tensor:
    """The two components (2,) of the normal across the object axis nearest to it: 0 for a body lying on a face."""
    normal = plane[:3] @ body.rotation_matrix
    upright = int(normal.detach().abs().argmax())
    return torch.stack([normal[k] for k in range(3) if k != upright])


def proportion(body: Superquadric) -> torch.Tensor:
    """log a_k minus the mean of the three, shape (3,)."""
    logs = torch.log(body.size)
    return logs - logs.mean()


def roundness(body: Superquadric) -> torch.Tensor:
    """log(a1 / a2) and 1 - e2 (2,): 0 for a body of revolution."""
    return torch.stack([torch.log(body.size[0] / body.size[1]), 1 - body.shape[1]])


def surprise(body: Superquadric, expected: torch.Tensor) -> torch.Tensor:
    """log a_k minus that of expected half sizes (3,)."""
    return torch.log(body.size / expected)


def _slope(body: Superquadric, points: torch.Tensor) -> torch.Tensor:
    return body.gauge_gradient(points)


def _lowest(body: Superquadric, origin: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """Depth (n,) of the smallest gauge on each ray, by bisection of its slope; carries no gradient."""
    with torch.no_grad():
        middle = ((body.translation - origin) * direction).sum(-1) / direction.square().sum(-1)
        reach = 4 * body.size.max()
        near, far = middle - reach, middle + reach
        for _ in range(_BISECTIONS):
            middle = (near + far) / 2
            rising = (_slope(body, origin + middle[:, None] * direction) * direction).sum(-1) > 0
            near, far = torch.where(rising, near, middle), torch.where(rising, middle, far)
        return (near + far) / 2
