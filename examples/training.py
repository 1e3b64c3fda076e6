"""Train a small network with the thesis' occupancy loss for about two minutes, and use it (extra 'train').

    python training.py [STEPS]
"""

import sys
from pathlib import Path

import sq_perception as sq
from sq_perception.learning.train import train
from sq_perception.learning.training_config import TrainingConfig
from sq_perception.simulation.scenes import sample

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 1500
config = TrainingConfig(
    loss="occupancy", pixels=32, steps=steps, batch=64, warm_up=steps // 10, average=0.99, validation=max(steps // 3, 1)
)
train(config, Path("run"), advance=lambda step, loss: print(f"\r{step} of {steps}: {loss:.4f}", end="", flush=True))
frame = sample()  # two minutes do not make a network to trust
found = sq.Recoverer("run/model.safetensors", method="network").recover(frame.depth, frame.camera)
largest = [f"{2e3 * body.superquadric.size.max():.0f} mm" for body in found.recovered]
print(f"\n{len(largest)} bodies:", *largest)
