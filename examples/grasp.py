"""Where a gripper may take the things on the table, by their handles and rims too, the most probable grasp of each."""

import numpy as np

import sq_perception as sq
from sq_perception.grasping.gripper import PANDA
from sq_perception.grasping.planner import grasps_of
from sq_perception.grasping.surroundings import Surroundings
from sq_perception.simulation.scenes import sample

frame = sample()
found = sq.Recoverer().recover(frame.depth, frame.camera, options=sq.RecoveryOptions(parts=True))
plan = grasps_of(found.recovered, PANDA, Surroundings.of_image(frame.depth, frame.camera, found.plane))
best = {grasp.body: grasp for grasp in reversed(plan.grasps)}
for grasp in best.values():
    place = np.round(grasp.position, 3)
    print(f"{grasp.score:.2f} body {grasp.body} at {place}, {1e3 * grasp.opening:.0f} mm open, {grasp.weakest}")
for number, reason in enumerate(plan.reasons):
    if reason:
        print(f"none of body {number}: {reason}")
