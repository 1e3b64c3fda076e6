"""Contact-GraspNet as a process of its own, for benchmarks/picking.py: depth images in, grasps out.

    python benchmarks/picking.py --contact-graspnet "ENVIRONMENT/bin/python benchmarks/contact_graspnet.py"

Lines of the standard input name .npz files with ``depth`` (metres, NaN where nothing was measured), ``K`` and
``world_from_optical`` (4, 4); each is answered by a line of JSON, a list of [position of the TCP, rotation x y z w,
opening, score, row, column], all in the optical frame, the best first; row and column are of the contact's pixel.

The network is Sundermeyer et al., Contact-GraspNet, ICRA 2021, in the port ``cgn-pytorch`` 0.4.3 (PyPI, MIT), whose
wheel has the weights.  Its environment: Python 3.11, torch 2.13 and torch_geometric of PyPI, scipy, pyyaml, and with
``--no-deps`` cgn-pytorch alone, trimesh and tqdm; what it imports for pictures is not needed.  torch_cluster's three
operators are stated here in torch and SciPy.  As its page asks, points are given in the world's frame, z up, less
their mean; the least score is that of the original's configuration (TEST: second_thres).

The port's prediction of a width has a sign, that of the side on which the other contact lies, and is halved where it
places the gripper; ``inference`` of the package clips it at half of the opening and takes negative ones for 0.  It is
clipped at the whole here, and the fingers come wide open.
"""

from __future__ import annotations

import json
import os
import sys
import types
from typing import Any

import numpy as np
import torch
import torch_geometric.nn
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

DEPTH, OPENING = 0.1034, 0.08
"""From the origin of a grasp to its TCP, and the widest opening: those the network was trained with."""
LEAST = 0.19
FARTHEST = 1.2
"""Metres; points beyond are not given to it."""
POINTS, CONTACTS = 20000, 2048


def farthest_points(x: torch.Tensor, batch: torch.Tensor | None = None, ratio: float = 0.5, **_: Any) -> torch.Tensor:
    """Indices of points (n, 3), each the farthest from those before it."""
    coordinates = np.ascontiguousarray(x.detach().numpy().T)
    chosen, distance = [0], np.full(len(x), np.inf, np.float32)
    for _step in range(int(np.ceil(float(ratio) * len(x))) - 1):
        away = coordinates - coordinates[:, chosen[-1], None]
        np.minimum(distance, (away * away).sum(axis=0), out=distance)
        chosen.append(int(distance.argmax()))
    return torch.tensor(chosen)


def radius(
    x: torch.Tensor,
    y: torch.Tensor,
    r: float,
    batch_x: torch.Tensor | None = None,
    batch_y: torch.Tensor | None = None,
    max_num_neighbors: int = 32,
    **_: Any,
) -> torch.Tensor:
    """Pairs (2, m) of points y and their neighbours x within r, the first of them."""
    near = cKDTree(x.detach().numpy()).query_ball_point(y.detach().numpy(), r, return_sorted=True)
    kept = [one[:max_num_neighbors] for one in near]
    rows = np.repeat(np.arange(len(kept)), [len(one) for one in kept])
    return torch.tensor(np.stack([rows, np.concatenate(kept)]).astype(np.int64))


def interpolated(
    x: torch.Tensor,
    pos_x: torch.Tensor,
    pos_y: torch.Tensor,
    batch_x: torch.Tensor | None = None,
    batch_y: torch.Tensor | None = None,
    k: int = 3,
    **_: Any,
) -> torch.Tensor:
    """Features at places pos_y from those of the k nearest, by the inverse of the squared distance."""
    distance, index = cKDTree(pos_x.detach().numpy()).query(pos_y.detach().numpy(), k=k)
    distance, index = distance.reshape(-1, k), index.reshape(-1, k)
    weight = torch.tensor(1 / np.clip(distance**2, 1e-16, None), dtype=x.dtype)
    return (x[torch.tensor(index)] * weight[..., None]).sum(1) / weight.sum(1, keepdim=True)


def network() -> Any:
    """The model with its published weights."""
    torch_geometric.nn.fps, torch_geometric.nn.radius = farthest_points, radius
    torch_geometric.nn.knn_interpolate = interpolated
    for name in ("meshcat", "meshcat.geometry", "meshcat.transformations", "importlib_resources", "IPython", "imageio"):
        sys.modules.setdefault(name, types.ModuleType(name))
    sys.modules["meshcat"].geometry = sys.modules["meshcat.geometry"]
    sys.modules["importlib_resources"].files = __import__("importlib.resources").resources.files
    sys.modules["IPython"].embed = None
    load = torch.load
    torch.load = lambda *given, **more: load(*given, **{**more, "weights_only": True})
    from cgn_pytorch import from_pretrained

    model, _, _ = from_pretrained(device="cpu")
    return model.eval()


def answer(model: Any, depth: np.ndarray, K: np.ndarray, world_from_optical: np.ndarray) -> list[list[Any]]:
    """Grasps of one image as in the module."""
    rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0) & (depth < FARTHEST))
    kept = np.random.default_rng(0).permutation(len(rows))[:POINTS]
    rows, columns = rows[kept], columns[kept]
    if len(rows) < CONTACTS:
        return []
    z = depth[rows, columns].astype(float)
    optical = np.stack([(columns - K[0, 2]) * z / K[0, 0], (rows - K[1, 2]) * z / K[1, 1], z], axis=1)
    turn, shift = world_from_optical[:3, :3], world_from_optical[:3, 3]
    points = optical @ turn.T + shift
    mean = points.mean(axis=0)
    cloud = torch.tensor(points - mean, dtype=torch.float32)
    batch = torch.zeros(len(cloud), dtype=torch.int64)
    contacts = farthest_points(cloud, ratio=CONTACTS / len(cloud))
    with torch.no_grad():
        at, poses, logits, _, _, _ = model(
            cloud[:, 3:], pcd_poses=cloud, batch=batch, idxs=contacts, gripper_depth=DEPTH, gripper_width=2 * OPENING
        )
    scores = torch.sigmoid(logits).reshape(-1).numpy()
    poses, at = poses.reshape(-1, 4, 4).numpy(), at.reshape(-1, 3).numpy()
    nearest = cKDTree(cloud.numpy()).query(at)[1]
    found = []
    for k in np.argsort(-scores, kind="stable"):
        if scores[k] < LEAST:
            break
        y, approach = poses[k, :3, 0].astype(float), poses[k, :3, 2].astype(float)
        frame = turn.T @ np.stack([np.cross(y, approach), y, approach], axis=1)
        tcp = turn.T @ (poses[k, :3, 3] + DEPTH * approach + mean - shift)
        found.append(
            [
                tcp.tolist(),
                Rotation.from_matrix(frame).as_quat().tolist(),
                OPENING,
                float(scores[k]),
                int(rows[nearest[k]]),
                int(columns[nearest[k]]),
            ]
        )
    return found


def main() -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # the package prints
    torch.set_num_threads(1)
    model = network()
    for line in sys.stdin:
        with np.load(line.strip()) as file:
            grasps = answer(model, file["depth"], file["K"], file["world_from_optical"])
        answers.write(json.dumps(grasps) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
