"""Grasps of a parallel gripper on recovered bodies, each with the probability that it holds."""
