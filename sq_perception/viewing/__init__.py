"""Depth images and superquadrics in a browser: what is drawn, as arrays and text, and the page.  Knows no ROS."""
