"""Bodies from frame to frame: one id, one of the equivalent forms, and sizes that sharpen with every new view."""
