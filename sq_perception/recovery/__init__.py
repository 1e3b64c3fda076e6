"""Depth image and camera in, superquadrics out: the only place that chains the stages."""
