"""From a depth image to bodies with standard deviations."""

import sq_perception as sq
from sq_perception.simulation.scenes import sample

frame = sample()  # or sq.read_frame("table.npz"): depth (height, width) in metres and a camera
found = sq.Recoverer().recover(frame.depth, frame.camera)
for body in found.recovered:
    edges, sigma = 2e3 * body.superquadric.size, 2e3 * body.sigma_size
    print(body.status.name, "x".join(f"{a:.0f}" for a in edges), "mm +-", "x".join(f"{s:.0f}" for s in sigma))
