"""Superquadrics from depth images: geometry, imaging, fitting, learning and ROS 2 nodes."""

__version__ = "0.2.0"
