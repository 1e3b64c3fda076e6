"""Bodies as obstacles of a planner or simulator, larger by two standard deviations."""

import numpy as np

import sq_perception as sq
from sq_perception.recordings import scene_export
from sq_perception.simulation.scenes import sample

frame = sample()
found = sq.Recoverer().recover(frame.depth, frame.camera).recovered
bodies = sq.Superquadric.stack([body.superquadric for body in found])
grown = scene_export.inflate(bodies, np.array([body.covariance for body in found]), sigmas=2.0)
for form in ("urdf", "sdf", "mjcf", "curobo"):
    (path,) = scene_export.write(grown, f"table{scene_export.SUFFIXES[form]}", form, frame="camera")
    print(path, [solid.kind for solid in scene_export.solids(grown, form)])
