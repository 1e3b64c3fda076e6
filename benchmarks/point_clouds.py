"""Superquadrics from point clouds without a camera: one body, and the parts of a thing, against other programs.

    EMS_FOLDER=... EMS_PYTHON=... SAGE_PYTHON=... python benchmarks/point_clouds.py --bodies 100 --things 6

Single bodies: the thesis' protocol (half sizes 25 to 75 of 256, exponents 0.1 to 1, any rotation), 1500 points, evenly
on the surface; noise is normal, its standard deviation a share of the longest full edge; outliers are spread evenly
through the bounding box, half as large again, and replace points; a half cloud has the points whose normals are less
than 90 degrees from a random direction.  Score: IoU of the solids.

Parts: household things of benchmarks/household_things, 3000 points, evenly on the outside of the union, cavities
filled; score: IoU of the filled solid, by 20 000 random points of the box, a twelfth larger on each side.

Others run in Python environments of their own, which are neither part of this repository nor needed by it:

    EMS    git clone https://github.com/bmlklwx/EMS-superquadric_fitting; EMS_FOLDER is its Python/src; EMS_PYTHON
           needs numpy, scipy and numba.  As published, with the outlier ratio 0.2 that its script has, and told 0.6 for
           clouds with 60 % of outliers; its viewer and ply reader, not called, are replaced by empty modules.
    sage   pip install sage-superquadric, for SAGE_PYTHON: fit_superquadric, with its own start

SuperFlex and SuperDec publish networks; for whoever has their weights --write FOLDER writes the clouds and the true
bodies (a1 a2 a3 e1 e2 t1 t2 t3 qx qy qz qw) of each set.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

import argparse
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from common import report

from sq_perception.fitting import solina_bajcsy
from sq_perception.fitting.decomposition import decompose
from sq_perception.fitting.points import fit_points
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.mesh import triangles
from sq_perception.geometry.metrics import volume_iou
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.simulation.household import KINDS, draw_thing
from sq_perception.simulation.scenes import thesis_bodies
from sq_perception.simulation.thing import Thing

SEED = 20_000
POINTS, OF_THING, TESTED = 1500, 3000, 20_000
SETS = {
    "full": (0.0, 0.0, False),
    "noise 1 %": (0.01, 0.0, False),
    "noise 2 %": (0.02, 0.0, False),
    "noise 5 %": (0.05, 0.0, False),
    "outliers 5 %": (0.0, 0.05, False),
    "outliers 20 %": (0.0, 0.2, False),
    "outliers 60 %": (0.0, 0.6, False),
    "half": (0.0, 0.0, True),
    "half, noise 1 %": (0.01, 0.0, True),
}
"""Noise, share of outliers, and whether only half is seen."""
_EMS = """
import types
for name in ("mayavi", "mayavi.mlab", "plyfile"):
    sys.modules[name] = types.ModuleType(name)
sys.modules["mayavi"].mlab = None
import numpy as np, time
np.int = int
from EMS.EMS_recovery import EMS_recovery
clouds, ratios = (np.load(sys.argv[1])[name] for name in ("clouds", "ratios"))
EMS_recovery(clouds[0])
rows = []
for cloud, ratio in zip(clouds, ratios):
    began = time.process_time()
    try:
        found, _ = EMS_recovery(cloud, OutlierRatio=float(ratio))
        numbers = [*found.scale, *found.shape, *found.translation, *found.RotM.ravel()]
    except Exception:
        numbers = [np.nan] * 17
    rows.append([*numbers, time.process_time() - began])
np.save(sys.argv[2], rows)
"""
_SAGE = """
import sys, numpy as np, time
from scipy.spatial.transform import Rotation
from sage_superquadrics.superquadric import fit_superquadric
clouds, rows = np.load(sys.argv[1])["clouds"], []
for cloud in clouds:
    began = time.process_time()
    try:
        middle = cloud.mean(axis=0)
        found = fit_superquadric(cloud - middle)
        found = found[0] if isinstance(found, tuple) else found
        turn = Rotation.from_euler("zyx", [found["yaw"], found["pitch"], found["roll"]]).as_matrix()
        size = [found[name] for name in ("a1", "a2", "a3")]
        at = middle + [found[name] for name in ("cx", "cy", "cz")]
        numbers = [*size, found["eps1"], found["eps2"], *at, *turn.ravel()]
    except Exception:
        numbers = [np.nan] * 17
    rows.append([*numbers, time.process_time() - began])
np.save(sys.argv[2], rows)
"""

Answer = tuple[Superquadric | None, float]
"""A body, if any, and seconds of the processor."""


def drawn_cloud(body: Superquadric, case: tuple[float, float, bool], rng: np.random.Generator) -> np.ndarray:
    """The points (n, 3) of one body."""
    noise, outliers, is_half = case
    points = body.sample_surface(POINTS, rng)
    if is_half:
        way = rng.standard_normal(3)
        points = body.sample_surface(4 * POINTS, rng)
        points = points[body.normals(points) @ way > 0]
        points = points[rng.permutation(len(points))[:POINTS]]
    points = points + noise * 2 * body.size.max() * rng.standard_normal(points.shape)
    strays = round(outliers * len(points))
    low, high = body.bounding_box()
    points[rng.permutation(len(points))[:strays]] = (low + high) / 2 + 0.75 * (high - low) * rng.uniform(
        -1, 1, (strays, 3)
    )
    return points


def of_thing(thing: Thing, rng: np.random.Generator) -> np.ndarray:
    """Points (n, 3) of the outside of a union, its cavities filled."""
    found = []
    parts = list(thing.parts)
    areas = []
    for part in parts:
        vertices, faces = triangles(part)
        corners = vertices[faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas.append(float(np.linalg.norm(across, axis=1).sum()))
    for k, part in enumerate(parts):
        points = part.sample_surface(max(10, round(4 * OF_THING * areas[k] / sum(areas))), rng)
        buried = [other.gauge(points) <= 1 for j, other in enumerate(parts) if j != k]
        found.append(points[~np.any(buried, axis=0)] if buried else points)
    points = np.concatenate(found)
    return points[rng.permutation(len(points))[:OF_THING]]


def timed(fit: Callable[[np.ndarray], Any]) -> Callable[[np.ndarray], Answer]:
    """A fit of this package as a contestant."""

    def answer(points: np.ndarray) -> Answer:
        began = time.process_time()
        found = fit(points)
        return found.superquadric, time.process_time() - began

    return answer


def of_others(script: str, python: str, folder: str | None, clouds: list[np.ndarray], ratio: float) -> list[Answer]:
    """What another program finds in the clouds, in a process of its own environment."""
    with tempfile.TemporaryDirectory() as name:
        given, got = Path(name, "clouds.npz"), Path(name, "bodies.npy")
        np.savez(given, clouds=np.stack(clouds), ratios=np.full(len(clouds), ratio))
        added = "" if folder is None else f"sys.path.insert(0, {str(Path(folder).resolve())!r})\n"
        subprocess.run(
            [python, "-W", "ignore", "-c", "import sys\n" + added + script, str(given), str(got)], check=True
        )
        rows = np.load(got)
    answers: list[Answer] = []
    for row in rows:
        body = None
        if np.isfinite(row).all() and (row[:3] > 0).all():
            turn = quaternions.from_matrix(row[8:17].reshape(3, 3))
            body = Superquadric(row[:3], np.clip(row[3:5], 0.01, 2.0), row[5:8], turn)
        answers.append((body, float(row[17])))
    return answers


def singles(options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Every set, every contestant: IoU mean, minimum, share above 0.9, median milliseconds."""
    ours = {"this": timed(fit_points), "Solina-Bajcsy": timed(solina_bajcsy.fit)}
    for fit in ours.values():
        fit(drawn_cloud(thesis_bodies(1, np.random.default_rng(0))[0], SETS["full"], np.random.default_rng(0)))
    table: dict[str, dict[str, Any]] = {}
    for number, (name, case) in enumerate(SETS.items()):
        rng = np.random.default_rng(SEED + number)
        bodies = list(thesis_bodies(options.bodies, rng))
        clouds = [drawn_cloud(body, case, rng) for body in bodies]
        if options.write:
            truth = [body.to_flat() for body in bodies]
            np.savez(Path(options.write, f"{name}.npz"), clouds=np.stack(clouds), truth=truth)
        answers = {who: [fit(cloud) for cloud in clouds] for who, fit in ours.items()}
        if "EMS_PYTHON" in os.environ:
            ratio = 0.6 if case[1] > 0.5 else 0.2
            answers["EMS"] = of_others(_EMS, os.environ["EMS_PYTHON"], os.environ["EMS_FOLDER"], clouds, ratio)
        if "SAGE_PYTHON" in os.environ:
            answers["sage"] = of_others(_SAGE, os.environ["SAGE_PYTHON"], None, clouds, 0.0)
        for who, found in answers.items():
            scores = np.array(
                [
                    0.0 if body is None else float(volume_iou(body, truth))
                    for (body, _), truth in zip(found, bodies, strict=True)
                ]
            )
            table.setdefault(name, {})[who] = {
                "mean": 100 * scores.mean(),
                "min": 100 * scores.min(),
                "above 90": 100 * np.mean(scores > 0.9),
                "ms": 1e3 * float(np.median([seconds for _, seconds in found])),
            }
        print(name, {who: f"{row['mean']:.1f} / {row['min']:.1f}" for who, row in table[name].items()}, flush=True)
    return table


def parts_of_things(options: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Every kind: IoU of the solid with one body and with parts, number of parts, milliseconds."""
    rng = np.random.default_rng(SEED)
    table: dict[str, dict[str, float]] = {}
    all_rows = []
    for kind in KINDS:
        rows = []
        for _ in range(options.things):
            thing = draw_thing(rng, [kind])
            cloud = of_thing(thing, rng)
            low, high = thing.box
            tested = rng.uniform(low - (high - low) / 12, high + (high - low) / 12, (TESTED, 3))
            solid = np.any([part.gauge(tested) <= 1 for part in thing.parts], axis=0)
            alone = fit_points(cloud).superquadric.gauge(tested) <= 1
            began = time.process_time()
            parts = decompose(cloud)
            seconds = time.process_time() - began
            inside = parts.contains(tested)
            iou = [np.count_nonzero(solid & each) / np.count_nonzero(solid | each) for each in (alone, inside)]
            rows.append([100 * iou[0], 100 * iou[1], len(parts), len(thing.parts), 1e3 * seconds])
        all_rows += rows
        table[kind] = _means(rows)
        print(kind, table[kind], flush=True)
    return {"all": _means(all_rows), **table}


def _means(rows: list[list[float]]) -> dict[str, float]:
    names = ("one body", "parts", "number", "true number", "ms")
    return dict(zip(names, np.mean(rows, axis=0).tolist(), strict=True))


def as_page(results: dict[str, Any]) -> str:
    """The results in Markdown."""
    people = list(next(iter(results["singles"].values())))
    about = f"IoU mean / minimum, % of {results['bodies']} bodies; ms of a processor, median; compare within the table."
    lines = [about, ""]
    lines += ["| cloud | " + " | ".join(people) + " |", "| --- |" + " --- |" * len(people)]
    for name, row in results["singles"].items():
        cells = [f"{row[who]['mean']:.1f} / {row[who]['min']:.1f}, {row[who]['ms']:.0f} ms" for who in people]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    lines += ["", f"Household things, {results['things']} of a kind: IoU of the filled solid, %.", ""]
    lines += ["| kind | one body | parts | number of parts | of the truth | ms |", "| --- |" + " --- |" * 5]
    for kind, row in results["parts"].items():
        lines.append(
            f"| {kind} | {row['one body']:.1f} | {row['parts']:.1f} | {row['number']:.2f} | {row['true number']:.2f} | "
            f"{row['ms']:.0f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = report.parser(__doc__)
    parser.add_argument("--bodies", type=int, default=100)
    parser.add_argument("--things", type=int, default=6, help="of a kind")
    parser.add_argument("--write", metavar="FOLDER", help="write the clouds there, for other programs")
    options = parser.parse_args()
    results = {
        "seed": SEED,
        "bodies": options.bodies,
        "things": options.things,
        "singles": singles(options),
        "parts": parts_of_things(options),
    }
    report.write("point_clouds", results, as_page(results))


if __name__ == "__main__":
    main()
