"""Scanned household objects, which are no superquadrics: how close a fit from one side comes to the best possible.

    python benchmarks/scanned_objects.py [--poses 20] [--objects "apple; pear"] [--name scanned_objects]

Nine YCB scans (../shared/data/ycb_meshes), depth rasterised from the mesh, a pinhole camera of 640 x 480 pixels, 60
degrees wide, at 0.5 to 1 m, noise of sigma = 1.5 mm at 1 m growing with z^2, whole millimetres, true masks.

    floating               any orientation, nothing measured behind the object; a pixel without depth is none of its own
    floating, NaN unknown  the same images, where a pixel without depth is unknown
    on plane               lying on a stable face, seen from 30 to 60 degrees above, the plane measured behind and given

Volume IoU is against the convex hull of the scan.  The oracle is the superquadric with the largest such IoU
(:mod:`hull_oracle`); ``share`` is IoU over the oracle's.
``2 sigma`` is the share of half sizes within two reported standard deviations of half the hull's extent along the same
axis.  Times are of one pinned thread, milliseconds.
"""

from __future__ import annotations

if __name__ == "__main__":
    import one_thread  # noqa: F401

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mesh_scene
import numpy as np
import report
import trimesh
from both_fits import Both, both
from hull_oracle import Columns, oracle
from mesh_things import scanned_meshes

from sq_perception.fitting import surface_fit
from sq_perception.fitting.fit import Status
from sq_perception.geometry import Superquadric
from sq_perception.geometry import rotation as quaternions

SEED = 9000
POOR = 0.8
"""Fits with a smaller share of the oracle are counted."""
WORST = 12


@dataclass(frozen=True)
class Placement:
    """How the objects are placed, with seeds of their own, what is known of empty pixels, and the share asked for."""

    poser: Callable[[trimesh.Trimesh], mesh_scene.Poser]
    seed: int
    goal: str
    nan_is_empty: bool = True


SETTINGS = {
    "floating": Placement(mesh_scene.floating, SEED, "0.90"),
    "floating, NaN unknown": Placement(mesh_scene.floating, SEED, "-", nan_is_empty=False),
    "on plane": Placement(mesh_scene.resting, SEED + 1, "0.93"),
}
CLASSIC_GOAL = "half"


@dataclass(frozen=True)
class Scan:
    """One object: its mesh, its convex hull, the hull's columns, and its place in the sorted folder."""

    name: str
    number: int
    mesh: trimesh.Trimesh
    hull: trimesh.Trimesh
    columns: Columns


@dataclass(frozen=True)
class FittedScan:
    """Both fits of one image; the body in the frame of the mesh."""

    scan: Scan
    pose: int
    found: Both
    body: Superquadric
    iou: float
    classic_iou: float
    extent: np.ndarray
    """Half extents (3,) of the hull along the axes of the body, metres."""

    @property
    def covered(self) -> np.ndarray:
        return np.abs(self.body.size - self.extent) <= 2 * self.found.fit.sigma_size


def scans(folder: Path, wanted: str) -> list[Scan]:
    """The scans whose names contain one of the wanted parts, all without any."""
    parts = [part.strip().replace("_", " ") for part in wanted.split(";") if part.strip()]
    return [
        Scan(name, number, mesh, hull, Columns.of(hull.vertices))
        for number, (name, mesh, hull) in enumerate(scanned_meshes(folder))
        if not parts or any(part in name for part in parts)
    ]


def image(scan: Scan, setting: Placement, pose: int, poser: mesh_scene.Poser) -> mesh_scene.MeshView:
    """The image of one pose; the same however many are asked for."""
    return mesh_scene.view(scan.mesh, poser, np.random.default_rng([setting.seed, scan.number, pose]))


def in_mesh_frame(body: Superquadric, view: mesh_scene.MeshView) -> Superquadric:
    """A body of the optical frame where the hull is."""
    return body.transformed(quaternions.from_matrix(view.rotation.T), -view.rotation.T @ view.translation)


def outcome(scan: Scan, setting: Placement, pose: int, view: mesh_scene.MeshView) -> FittedScan:
    """Fit one image with both methods."""
    options = surface_fit.FitOptions(plane=view.plane, nan_is_empty=setting.nan_is_empty)
    found = both(view.depth, view.mask, view.camera, options)
    body = in_mesh_frame(found.fit.superquadric, view)
    classic = in_mesh_frame(found.classic.superquadric, view)
    extent = np.ptp(scan.hull.vertices @ body.rotation_matrix, axis=0) / 2
    return FittedScan(scan, pose, found, body, scan.columns.iou(body), scan.columns.iou(classic), extent)


def summary(outcomes: list[FittedScan], best: dict[str, float]) -> dict[str, Any]:
    """The figures of some images; ``best`` is the oracle's IoU of each object."""
    limit = np.array([best[each.scan.name] for each in outcomes])
    iou = np.array([each.iou for each in outcomes])
    classic = np.array([each.classic_iou for each in outcomes])
    return {
        "oracle": float(100 * limit.mean()),
        "iou": report.spread(100 * iou),
        "share": report.spread(iou / limit),
        "poor": float(100 * np.mean(iou / limit < POOR)),
        "classic_iou": report.spread(100 * classic),
        "classic_share": report.spread(classic / limit),
        "milliseconds": report.spread(np.array([each.found.milliseconds for each in outcomes])),
        "classic_milliseconds": report.spread(np.array([each.found.classic_milliseconds for each in outcomes])),
        "within_2_sigma": float(100 * np.mean([each.covered for each in outcomes])),
        "status": {s.name.lower(): sum(each.found.fit.status == s for each in outcomes) for s in Status},
    }


def line(name: str, figures: dict[str, Any], goal: str, classic_goal: str) -> dict[str, str]:
    """A row of the table."""
    ms, classic_ms = figures["milliseconds"], figures["classic_milliseconds"]
    return {
        "object": name,
        "oracle IoU %": f"{figures['oracle']:.1f}",
        "IoU %": f"{figures['iou']['mean']:.1f} +- {figures['iou']['std']:.1f}",
        "min": f"{figures['iou']['min']:.0f}",
        "share": f"{figures['share']['mean']:.3f}",
        "goal": goal,
        f"share < {POOR} (%)": f"{figures['poor']:.0f}",
        "ms median / p95": f"{ms['median']:.1f} / {ms['p95']:.1f}",
        "2 sigma %": f"{figures['within_2_sigma']:.0f}",
        "converged / weak / failed": " / ".join(str(count) for count in figures["status"].values()),
        "classic IoU %": f"{figures['classic_iou']['mean']:.1f}",
        "classic share": f"{figures['classic_share']['mean']:.3f}",
        "expected": classic_goal,
        "classic ms": f"{classic_ms['median']:.1f}",
    }


def worst_line(setting: str, each: FittedScan, best: dict[str, float]) -> dict[str, str]:
    sizes = [" ".join(f"{1e3 * x:.0f}" for x in values) for values in (each.body.size, each.extent)]
    return {
        "setting": setting,
        "object": each.scan.name,
        "pose": str(each.pose),
        "share": f"{each.iou / best[each.scan.name]:.2f}",
        "half sizes / those of the hull along them, mm": " / ".join(sizes),
        "e1 e2": " ".join(f"{e:.2f}" for e in each.body.shape),
        "verdict": each.found.verdict,
    }


def main() -> None:
    parser = report.parser(__doc__, "scanned_objects")
    parser.add_argument("--poses", type=int, default=20, help="images of every object in either setting")
    parser.add_argument("--objects", default="", help="parts of names of objects, separated by semicolons")
    options = parser.parse_args()
    data = report.shared_data("ycb_meshes")
    if data is None:
        sys.exit(0)
    report.pin()
    surface_fit.warm_up()
    objects = scans(data, options.objects)
    bodies = {scan.name: oracle(scan.hull) for scan in objects}
    best = {scan.name: scan.columns.iou(bodies[scan.name]) for scan in objects}
    result: dict[str, Any] = {"oracle": {name: body.to_flat().tolist() for name, body in bodies.items()}}
    tables, worst = [], []
    for setting, how in SETTINGS.items():
        found: list[FittedScan] = []
        rows = []
        for scan in objects:
            poser = how.poser(scan.hull)
            found += [outcome(scan, how, pose, image(scan, how, pose, poser)) for pose in range(options.poses)]
            figures = summary(found[-options.poses :], best)
            result[f"{setting}, {scan.name}"] = figures
            rows.append(line(scan.name, figures, "", ""))
            print(setting, "|", " | ".join(rows[-1].values()), flush=True)
        result[setting] = summary(found, best)
        rows.append(line("**all**", result[setting], how.goal, CLASSIC_GOAL))
        tables.append(f"{setting}, {options.poses} poses of each object\n\n{report.table_of(rows)}")
        found.sort(key=lambda each: each.iou / best[each.scan.name])
        worst += [worst_line(setting, each, best) for each in found[:WORST]]
    result["worst"] = worst
    tables.append(f"The worst of each setting\n\n{report.table_of(worst)}")
    report.write(options.name, {"options": vars(options), **result}, "\n\n".join(tables))


if __name__ == "__main__":
    main()
