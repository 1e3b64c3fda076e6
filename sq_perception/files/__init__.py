"""Files from outside, read within bounds; files for the user, and where figures in them come from."""

__version__ = "0.3.0"
