"""A depth image with the outlines of its bodies and, at the best grasp of each, the gripper with its probability."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from sq_perception.evaluation import plots
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.grasping.gripper import Gripper
from sq_perception.grasping.plan import GraspPlan
from sq_perception.imaging.camera import Camera


def draw_grasps(
    ax: Axes, depth: np.ndarray, camera: Camera, bodies: list[Superquadric], plan: GraspPlan, hand: Gripper
) -> None:
    """Everything in the optical frame of the camera."""
    plots.draw_depth(ax, depth)
    plots.draw_outlines(ax, bodies, camera, edges=False, width=1.4)
    for k in range(len(bodies)):
        for grasp in plan.of(k)[:1]:
            for line in hand.wires(grasp.opening):
                pixels = camera.project(grasp.placed(line))
                ax.plot(*pixels.T, color="white", lw=5.0, solid_capstyle="round")
                ax.plot(*pixels.T, color=plots.colour(k), lw=2.6, solid_capstyle="round")
            where = float(pixels[-1, 0]), float(pixels[-1, 1])
            ax.text(*where, f" {grasp.score:.2f}", color=plots.INK, fontsize=11, weight="bold", clip_on=True)
