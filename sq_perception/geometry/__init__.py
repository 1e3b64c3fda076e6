"""Superquadrics and rotations: the mathematics, free of input and output."""

from sq_perception.geometry.superquadric import Superquadric

__all__ = ["Superquadric"]
