"""Scenes with known truth, and what real sensors make of them."""
