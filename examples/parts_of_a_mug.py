"""A mug of two parts, a cup and a handle, decomposed."""

import numpy as np

import sq_perception as sq

cup = sq.Superquadric([0.04, 0.04, 0.05], [0.1, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
handle = sq.Superquadric([0.03, 0.008, 0.03], [0.4, 0.4], [0.055, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
surface = [sq.sample(cup, 2000), sq.sample(handle, 600)]
points = np.concatenate([surface[0][handle.gauge(surface[0]) > 1], surface[1][cup.gauge(surface[1]) > 1]])

parts = sq.decompose(points, most=4)
for fit, share in zip(parts, parts.shares, strict=True):
    print(f"{share:.0%} of the points:", np.round(2e3 * fit.superquadric.size), "mm")
distance = parts.signed_distance(np.array([[0.0, 0.1, 0.0]]))
print("distance of a point beside the mug:", np.round(1e3 * distance, 1), "mm")
sq.write_mesh([fit.superquadric for fit in parts], "mug.glb")
