"""The regressor that reads a superquadric off a canonical view: network, losses, data, training, checkpoints."""
