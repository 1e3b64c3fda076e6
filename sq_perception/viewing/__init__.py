"""Depth images and superquadrics in a browser: what is drawn, in arrays and words, and the page.  Knows no ROS."""
