"""Objects of a depth image: the support plane away, what stands on it taken apart."""
