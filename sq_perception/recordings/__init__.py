"""Recorded frames and bags in, results out; no ROS installation needed."""
