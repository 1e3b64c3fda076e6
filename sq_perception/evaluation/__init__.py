"""Pictures and figures of what was recovered."""
