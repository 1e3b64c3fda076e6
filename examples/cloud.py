"""Point clouds: one of a robot's frame with labels, seen from its camera, and one of a whole object."""

import numpy as np

import sq_perception as sq
from sq_perception.recordings.cloud_file import CloudFrame
from sq_perception.recordings.frame_file import Reading
from sq_perception.simulation.scenes import sample

made = sample()
v, u = np.nonzero(np.isfinite(made.depth))
points = made.camera.unproject(u, v, made.depth[v, u])
inside = np.stack([body.gauge(points) < 1.05 for body in made.bodies])
labels = np.where(inside.any(axis=0), inside.argmax(axis=0) + 1, 0)  # of some network: 0 is background
link = points[:, [2, 0, 1]] * [1, -1, -1]  # x forward, y left, z up
np.savez("scene.npz", points=link, labels=labels)  # or a PCD or PLY with a field `label`

frame = sq.read_frame("scene.npz", reading=Reading(frame=CloudFrame.parse("link")))
options = sq.RecoveryOptions(free_space=frame.has_free_space)
for body in sq.Recoverer().recover(frame.depth, frame.camera, frame.labels, options).recovered:
    print(f"label {body.label}:", np.round(2e3 * body.superquadric.size), "mm", body.status.name)

can = sq.Superquadric([0.033, 0.033, 0.06], [0.1, 1.0], [0.1, 0.2, 0.0], [0.0, 0.0, 0.0, 1.0])
noisy = sq.sample(can, 1000) + 0.001 * np.random.default_rng(0).standard_normal((1000, 3))
fit = sq.fit_points(noisy)
print("the can:", np.round(2e3 * fit.superquadric.size), f"mm, IoU {float(sq.iou(fit.superquadric, can)):.3f}")
