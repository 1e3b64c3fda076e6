"""Messages to NumPy and back for superquadrics and the images they come from; needs numpy and message packages only."""
