"""What one more stage of the camera does to the unseen side: the predicted hull, and the body fitted with it.

    python benchmarks/camera_bias.py [--scenes 24] [--first 60000] [--name camera_bias]

Household scenes (:mod:`household_things`) through the simulated D435, true masks given; then one stage more:

| stage | what is changed |
| --- | --- |
| raw | nothing |
| smoothed 3, 6 | a bilateral filter of so many pixels and 30 mm, which no training has |
| spatial | librealsense's spatial filter with its defaults, for the f b of the D435 |
| filled | missing readings, from the farthest neighbour |
| ring 2, 4 | no readings within so many pixels around the things, as a mask from colour has it |
| aligned | to a colour camera 15 mm beside, points; the masks with it |
| low | depths 1 % too small, and the truth with them |

Things at least half visible and of 400 pixels.  Far sides are those along the line of sight to the thing's middle: of
the hull in the one of its directions that is nearest to it.  Millimetres, positive where the far side is too far;
shifts are differences to the raw image, with their standard errors; sigma is that of the prediction.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import cv2
import household_things
import numpy as np
from common import report
from common.scene_verdict import HALF
from common.tabletop import Placed, Tabletop

from sq_perception.fitting.fit import Fit, Status
from sq_perception.fitting.priors import HullPrior
from sq_perception.imaging.camera import Camera
from sq_perception.recovery import methods
from sq_perception.recovery.recoverer import FrameRecovery, Recoverer
from sq_perception.recovery.seen_object import SeenObject
from sq_perception.simulation import camera_stages
from sq_perception.simulation.sensor_noise import preset

FEWEST_PIXELS = 400
BESIDE = 0.015
LOW = 0.99
NAN = np.float32(np.nan)


@dataclass(frozen=True, eq=False)
class Image:
    """Depth and labels (height, width), and how the truth changes with them: p to scale (p - beside)."""

    depth: np.ndarray
    labels: np.ndarray
    scale: float = 1.0
    beside: float = 0.0


@dataclass(frozen=True)
class Side:
    """One thing of one image: errors of the far sides of its hull and body, of all directions, and sigma, mm."""

    key: tuple[int, int]
    kind: str
    hull: float
    body: float
    all: np.ndarray
    sigma: np.ndarray


def _smoothed(scene: Tabletop, pixels: int) -> Image:
    known = np.isfinite(scene.depth)
    smooth = cv2.bilateralFilter(np.where(known, scene.depth, np.float32(0)), -1, 0.03, pixels)
    return Image(np.where(known, smooth, NAN), scene.labels)


def _spatial(scene: Tabletop) -> Image:
    return Image(camera_stages.spatial(scene.depth, 0.5, 20 * preset("realsense_d435").quantum, 2), scene.labels)


def _ring(scene: Tabletop, pixels: int) -> Image:
    brush = np.ones((2 * pixels + 1, 2 * pixels + 1), np.uint8)
    around = (cv2.dilate((scene.labels > 0).view(np.uint8), brush) > 0) & (scene.labels == 0)
    return Image(np.where(around, NAN, scene.depth), scene.labels)


def _aligned(scene: Tabletop) -> Image:
    camera, place = scene.camera, np.array([-BESIDE, 0.0, 0.0])

    def moved(depth: np.ndarray) -> np.ndarray:
        return camera_stages.align(depth.astype(np.float32), camera, place, camera, False)

    depth, labels = moved(scene.depth), np.zeros_like(scene.labels)
    for label in np.unique(scene.labels[scene.labels > 0]):
        of_one = moved(np.where(scene.labels == label, scene.depth, NAN))
        labels[np.isfinite(of_one) & (of_one <= depth)] = label
    return Image(depth, labels, beside=BESIDE)


STAGES: dict[str, Callable[[Tabletop], Image]] = {
    "raw": lambda scene: Image(scene.depth, scene.labels),
    "smoothed 3": lambda scene: _smoothed(scene, 3),
    "smoothed 6": lambda scene: _smoothed(scene, 6),
    "spatial": _spatial,
    "filled": lambda scene: Image(camera_stages.fill(scene.depth, "farthest"), scene.labels),
    "ring 2": lambda scene: _ring(scene, 2),
    "ring 4": lambda scene: _ring(scene, 4),
    "aligned": _aligned,
    "low": lambda scene: Image(scene.depth * np.float32(LOW), scene.labels, LOW),
}


def with_hulls(
    recoverer: Recoverer, depth: np.ndarray, camera: Camera, labels: np.ndarray
) -> tuple[FrameRecovery, dict[int, HullPrior]]:
    """Recover a frame with given masks; also return the predicted hull of each label that has one."""
    hulls: dict[int, HullPrior] = {}
    fitted = methods.fit_view

    def kept(one: SeenObject, *rest: Any) -> Fit:
        hull = None if one.prediction is None else one.prediction.hull()
        if hull is not None:
            hulls[one.label] = hull
        return fitted(one, *rest)

    with patch.object(methods, "fit_view", kept):
        return recoverer.recover(depth, camera, labels), hulls


def far_side(hull: HullPrior, corners: np.ndarray) -> float:
    """Error of a hull's far side beside true corners (n, 3), metres: in its direction nearest to the line of sight."""
    nearest = int(np.argmax(hull.directions @ corners.mean(axis=0)))
    return float(hull.support[nearest] - (corners @ hull.directions[nearest]).max())


def sides(scene: Tabletop, image: Image, recoverer: Recoverer) -> list[Side]:
    """The far sides of the things of a scene as they are recovered from an image of it."""
    found, hulls = with_hulls(recoverer, image.depth, scene.camera, image.labels)
    bodies = {body.label: body for body in found.bodies if body.status != Status.FAILED}
    return [
        _side(scene.seed, each, image, bodies[each.label].superquadric, hulls[each.label])
        for each in scene.placed
        if each.label in bodies and each.label in hulls and each.pixels >= FEWEST_PIXELS and each.visible_share >= HALF
    ]


def _side(seed: int, placed: Placed, image: Image, body: Any, hull: HullPrior) -> Side:
    corners = image.scale * (placed.hull - np.array([image.beside, 0.0, 0.0]))
    sight = corners.mean(axis=0) / np.linalg.norm(corners.mean(axis=0))
    far = float(sight @ body.translation + body.support(sight[None])[0] - (corners @ sight).max())
    errors = hull.support - (corners @ hull.directions.T).max(axis=0)
    deviation = np.sqrt(hull.freedom / (hull.freedom - 2) * np.diag(hull.covariance))
    key = seed, placed.label
    return Side(key, placed.thing.kind, 1e3 * far_side(hull, corners), 1e3 * far, 1e3 * errors, 1e3 * deviation)


def figures(by_stage: dict[str, list[Side]]) -> dict[str, Any]:
    """Means, absolute means and shifts of every stage."""
    raw = {side.key: side for side in by_stage["raw"]}
    result: dict[str, Any] = {}
    for name, found in by_stage.items():
        pairs = [(side, raw[side.key]) for side in found if side.key in raw]
        both = np.array([[side.hull, side.body] for side in found])
        shift = np.array([[side.hull - old.hull, side.body - old.body] for side, old in pairs])
        ratio = np.concatenate([side.all / side.sigma for side in found])
        result[name] = {
            "count": len(found),
            "mean": both.mean(axis=0).tolist(),
            "absolute": np.abs(both).mean(axis=0).tolist(),
            "shift": shift.mean(axis=0).tolist(),
            "error": (shift.std(axis=0) / np.sqrt(len(shift))).tolist(),
            "all": float(np.mean([np.abs(side.all).mean() for side in found])),
            "ratio": float(np.sqrt(np.mean(ratio**2))),
        }
    return result


def by_kind(found: list[Side]) -> dict[str, list[float]]:
    """Mean absolute error of all directions and error over sigma of each kind of thing, and how many there are."""
    kinds: dict[str, list[float]] = {}
    for kind in sorted({side.kind for side in found}):
        mine = [side for side in found if side.kind == kind]
        ratio = np.concatenate([side.all / side.sigma for side in mine])
        kinds[kind] = [np.mean([np.abs(side.all).mean() for side in mine]), np.sqrt(np.mean(ratio**2)), len(mine)]
    return {kind: [float(each) for each in values] for kind, values in kinds.items()}


def table(result: dict[str, Any]) -> str:
    rows = []
    for name, one in result.items():
        row = {"stage": name}
        for k, what in enumerate(("hull", "body")):
            row[f"{what}: far side (absolute)"] = f"{one['mean'][k]:+.1f} ({one['absolute'][k]:.1f})"
            row[f"{what}: shift"] = f"{one['shift'][k]:+.1f} +- {one['error'][k]:.1f}"
        rows.append({**row, "hull, all directions": f"{one['all']:.1f}", "error / sigma": f"{one['ratio']:.2f}"})
    return report.table_of(rows)


def kinds_table(result: dict[str, list[float]]) -> str:
    header = ["raw", *result]
    errors = ["error, mm", *(f"{error:.1f}" for error, _, _ in result.values())]
    ratios = ["error / sigma", *(f"{ratio:.2f}" for _, ratio, _ in result.values())]
    return report.table(header, [errors, ratios])


def main() -> None:
    parser = report.parser(__doc__, "camera_bias")
    parser.add_argument("--scenes", type=int, default=24, help="number of household scenes")
    parser.add_argument("--first", type=int, default=60000, help="seed of the first one")
    options = parser.parse_args()
    recoverer = Recoverer()
    found: dict[str, list[Side]] = {name: [] for name in STAGES}
    for seed in range(options.first, options.first + options.scenes):
        scene = household_things.scene(seed, "stereo")
        for name, stage in STAGES.items():
            found[name] += sides(scene, stage(scene), recoverer)
    stages, kinds = figures(found), by_kind(found["raw"])
    text = f"{table(stages)}\n\n{kinds_table(kinds)}"
    seeds = {"scenes": options.scenes, "first": options.first}
    report.write(options.name, {**seeds, "stages": stages, "kinds": kinds}, text)


if __name__ == "__main__":
    main()
