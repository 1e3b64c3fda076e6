"""One scene of two cameras whose poses are known: what one leaves open, the other one sees."""

from dataclasses import replace

import numpy as np

import sq_perception as sq
from sq_perception.geometry import rotation
from sq_perception.simulation.scenes import Scene, sample
from sq_perception.tracking.views import View, fuse_views

made = sample()
up, middle = np.array([0.0, -0.819, -0.574]), np.array([0.0, 0.0, 0.85])  # of the table
turn = rotation.from_rotation_vector(np.deg2rad(60) * up)
matrix = rotation.to_matrix(turn)
place = middle - matrix @ middle  # the second camera went about the table by 60 degrees
there = made.bodies.transformed(rotation.conjugate(turn), -matrix.T @ place)
depth, _ = Scene(there, made.camera, np.append(matrix.T @ up, -up @ middle + up @ place)).render()
second = replace(made, depth=depth.astype(np.float32))

recoverer, views = sq.Recoverer(), []
for frame, pose in ((made, (np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))), (second, (turn, place))):
    found = recoverer.recover(frame.depth, frame.camera)
    views.append(View(found.recovered, pose, frame.camera, frame.depth))
for name, some in (("one camera", views[:1]), ("two", views)):
    for track in fuse_views(some):
        sigma = 2e3 * track.sigma_size
        print(name, np.round(2e3 * track.superquadric.size), "mm +-", np.round(sigma, 1))
