"""Runs of ``sq-perception recover`` on rendered frames of two bodies, with their masks, and on plain images."""

import json

import cv2
import numpy as np
import yaml

from sq_perception import Camera, Superquadric
from sq_perception.commands import main
from sq_perception.imaging import raycast

CAMERA = Camera(160, 120, 200.0, 200.0, 79.5, 59.5)
BODIES = Superquadric(
    [[0.05, 0.04, 0.08], [0.03, 0.03, 0.05]], [[0.2, 0.9], [0.5, 1.0]], [[-0.08, 0.01, 0.7], [0.1, 0.0, 0.6]],
    [[0.4, 0.2, 0.1, 0.8], [0.7, 0.1, 0.3, 0.6]],
)


def save_npz(path, depth=None, bodies=BODIES, labels=(0, 1, 2)):
    """A frame of the bodies, whose masks have these labels after that of the background; in a folder that is made."""
    rendered, index = raycast.render(bodies, CAMERA)
    depth = np.where(np.isfinite(rendered), rendered, np.nan).astype(np.float32) if depth is None else depth
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, depth=depth, K=CAMERA.matrix, labels=np.array(labels)[index + 1])
    return path


def save_png(path, millimetres=1000):
    cv2.imwrite(str(path), np.full((120, 160), millimetres, np.uint16))
    return path


def camera_yaml(path, focal=200.0, distortion=0.0):
    k = [focal, 0, 79.5, 0, focal, 59.5, 0, 0, 1]
    p = [focal, 0, 79.5, 0, 0, focal, 59.5, 0, 0, 0, 1, 0]
    info = {"image_width": 160, "image_height": 120, "camera_matrix": {"data": k}, "projection_matrix": {"data": p}}
    path.write_text(yaml.safe_dump({**info, "distortion_coefficients": {"data": [distortion, 0, 0, 0, 0]}}))
    return path


def recover(tmp_path, *arguments, code=0):
    out = tmp_path / "out.json"
    assert run(*arguments, "--json", out) == code
    return json.loads(out.read_text())["frames"]


def run(*arguments):
    return main.main(["recover", *map(str, arguments), "--method", "symmetry"])
