"""The networks that predict bodies, hulls and masks: losses, data, training, checkpoints."""
