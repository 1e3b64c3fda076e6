"""One body, one mask: the surface fit and the classic fit on clean, noisy, damaged and occluded depth.

    python benchmarks/single_body.py [--bodies 2000] [--rows "clean; noise 2"] [--update]

Every row draws its bodies and its damage from a seed of its own (``SEED`` + the row's number).  Orthographic rows have
the thesis' protocol (a in [25, 75], e in [0.1, 1], centre 128 +- 40, uniform rotations, 256 x 256, 8 bit); pinhole rows
see bodies of 3 to 12 cm half size at 3 to 10 times their length, 640 x 480 pixels, 60 degrees wide, 16 bit millimetres.
No start is given, all rows share one set of options (but for the row that names a pixel budget).  The classic fit gets
the object's measured points, of which it takes 1000, evenly in the order of the image.

IoU is the volume IoU on 64^3 points around both bodies.  Times are of one pinned thread.  ``2 sigma`` is the share of
true half sizes within two reported standard deviations, each estimated axis compared with the true axis nearest to it.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from common import report
from scipy.optimize import linear_sum_assignment

from sq_perception.fitting import solina_bajcsy, surface_fit
from sq_perception.fitting.fit import Fit, Status
from sq_perception.geometry import Superquadric, metrics, rotation
from sq_perception.imaging import raycast, unit_cube
from sq_perception.imaging.camera import Camera
from sq_perception.simulation.scenes import thesis_bodies

SEED = 7000
GREY = 1 / 255
PINHOLE = Camera(640, 480, 320 / np.tan(np.deg2rad(30)), 320 / np.tan(np.deg2rad(30)), 319.5, 239.5)


@dataclass(frozen=True)
class Image:
    """What a fit is given."""

    depth: np.ndarray
    mask: np.ndarray
    camera: Camera


Damage = Callable[[Image, np.random.Generator], Image]


def orthographic(body: Superquadric) -> Image:
    """The thesis' 8 bit image."""
    camera = unit_cube.camera()
    depth, _ = raycast.render(body, camera)
    seen = unit_cube.depth_from_grey(unit_cube.grey_from_depth(depth))
    return Image(seen, np.isfinite(seen), camera)


def pinhole(body: Superquadric) -> Image:
    """A 16 bit millimetre image of one floating body, nothing behind it."""
    depth, index = raycast.render(body, PINHOLE)
    return Image(np.where(index >= 0, np.round(depth * 1000) / 1000, np.nan), index >= 0, PINHOLE)


def sensor(body: Superquadric, rng: np.random.Generator) -> Image:
    """The same through a sensor: sigma = 1.5 mm at 1 m, growing with z^2, then millimetres."""
    depth, index = raycast.render(body, PINHOLE)
    depth = np.where(index >= 0, depth, np.nan)
    noisy = depth + rng.standard_normal(depth.shape) * 0.0015 * depth**2
    return Image(np.round(noisy * 1000) / 1000, index >= 0, PINHOLE)


def noise(sigma: float) -> Damage:
    """Gaussian noise of ``sigma`` grey levels, rounded to grey levels again."""

    def damage(image: Image, rng: np.random.Generator) -> Image:
        grey = (1 - image.depth) / GREY - 0.5 + rng.normal(0, sigma, image.depth.shape)
        return Image(1 - (np.clip(np.round(grey), 1, 255) + 0.5) * GREY, image.mask, image.camera)

    return damage


def dropout(image: Image, rng: np.random.Generator) -> Image:
    """Every tenth pixel of the object without a reading, and not in the mask."""
    kept = rng.random(image.mask.shape) > 0.1
    return Image(np.where(kept, image.depth, np.nan), image.mask & kept, image.camera)


def eroded(image: Image, _: np.random.Generator) -> Image:
    """The mask two pixels too small; the depth beside it is still there."""
    mask = cv2.erode(image.mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))) > 0
    return Image(image.depth, mask, image.camera)


def grown(image: Image, _: np.random.Generator) -> Image:
    """The mask two pixels too large, over a background at the back of the cube."""
    mask = cv2.dilate(image.mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))) > 0
    return Image(np.where(np.isfinite(image.depth), image.depth, 1 - 0.5 * GREY), mask, image.camera)


def outliers(image: Image, rng: np.random.Generator) -> Image:
    """Two per cent of the object's readings anywhere in the cube."""
    gross = (rng.random(image.mask.shape) < 0.02) & image.mask
    return Image(np.where(gross, rng.random(image.mask.shape), image.depth), image.mask, image.camera)


def occluded(image: Image, rng: np.random.Generator, share: float = 0.3) -> Image:
    """A share of the silhouette behind a nearer half plane or disc."""
    rows, columns = np.nonzero(image.mask)
    v, u = np.indices(image.mask.shape)
    if rng.random() < 0.5:
        angle = rng.uniform(0, 2 * np.pi)
        order = np.cos(angle) * u + np.sin(angle) * v
    else:
        middle = rng.integers(len(rows))
        order = np.hypot(u - columns[middle], v - rows[middle])
    hidden = order <= np.quantile(order[rows, columns], share)
    nearer = np.nanmin(image.depth) - 0.05
    return Image(np.where(hidden, nearer, image.depth), image.mask & ~hidden, image.camera)


def cube_bodies(count: int, rng: np.random.Generator) -> Superquadric:
    return unit_cube.optical_from_cube(thesis_bodies(count, rng))


def pinhole_bodies(count: int, rng: np.random.Generator) -> Superquadric:
    """Bodies of 3 to 12 cm half size, at 3 to 10 times their length, somewhere around the image's middle."""
    size = rng.uniform(0.03, 0.12, (count, 3))
    distance = rng.uniform(3, 10, count) * 2 * size.max(axis=1)
    lateral = rng.uniform(-0.25, 0.25, (count, 2)) * distance[:, None]
    return Superquadric(
        size, rng.uniform(0.1, 1, (count, 2)), np.column_stack([lateral, distance]), rotation.random(count, rng)
    )


def tilted_bodies(degrees: float) -> Callable[[int, np.random.Generator], Superquadric]:
    """Sharp bodies, one face towards the viewer but for a tilt about a random axis in the image plane."""

    def draw(count: int, rng: np.random.Generator) -> Superquadric:
        bodies = cube_bodies(count, rng)
        angle = rng.uniform(0, 2 * np.pi, count)
        about = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)]) * np.deg2rad(degrees)
        spin = np.column_stack([np.zeros((count, 2)), rng.uniform(0, 2 * np.pi, count)])
        cyclic = rotation.from_rotation_vector(np.full((count, 3), 2 * np.pi / 3 / np.sqrt(3)))
        turn = np.where(rng.random((count, 1)) < 2 / 3, cyclic, np.array([0, 0, 0, 1.0]))
        q = rotation.multiply(rotation.from_rotation_vector(about), rotation.from_rotation_vector(spin))
        shape = rng.uniform(0.1, 0.2, (count, 2))
        return Superquadric(bodies.size, shape, bodies.translation, rotation.multiply(q, turn))

    return draw


@dataclass(frozen=True)
class Row:
    """One line of the table: bodies, image, damage, and the figures asked for."""

    bodies: Callable[[int, np.random.Generator], Superquadric]
    image: Callable[[Superquadric], Image] | None = orthographic
    damage: Damage | None = None
    pixels: int | None = None
    goal: str = "-"


ROWS = {
    "clean": Row(cube_bodies, goal="99.9 / 97 / 3 ms"),
    "clean, 500 pixels": Row(cube_bodies, pixels=500, goal="99.8 / 96 / 1.5 ms"),
    "noise 1": Row(cube_bodies, damage=noise(1), goal="99.6 / - / 10 ms"),
    "noise 2": Row(cube_bodies, damage=noise(2), goal="99.2 / 97 / 10 ms"),
    "noise 4": Row(cube_bodies, damage=noise(4), goal="98 / - / 10 ms"),
    "noise 8": Row(cube_bodies, damage=noise(8), goal="94 / - / 10 ms"),
    "dropout 10 %": Row(cube_bodies, damage=dropout, goal="99.5 / 95 / 10 ms"),
    "mask eroded 2 px": Row(cube_bodies, damage=eroded, goal="99.5 / 95 / 10 ms"),
    "mask grown 2 px": Row(cube_bodies, damage=grown, goal="99.5 / 95 / 10 ms"),
    "outliers 2 %": Row(cube_bodies, damage=outliers, goal="99 / 95 / 10 ms"),
    "occluded 30 %": Row(cube_bodies, damage=occluded, goal="97 / 70 / 10 ms"),
    "pinhole, 16 bit": Row(pinhole_bodies, pinhole, goal="99.8 / 97 / 5 ms"),
    "pinhole, sensor": Row(pinhole_bodies, None, goal="98 / 85 / 10 ms"),
    "tilt 0": Row(tilted_bodies(0.0), goal="curve"),
    "tilt 0.5": Row(tilted_bodies(0.5), goal="curve"),
    "tilt 1": Row(tilted_bodies(1.0), goal="curve"),
    "tilt 2": Row(tilted_bodies(2.0), goal="curve"),
    "tilt 5": Row(tilted_bodies(5.0), goal="curve"),
}


def size_errors(found: Superquadric, truth: Superquadric) -> np.ndarray:
    """Estimated minus true half size of each estimated axis (3,), the true axes assigned by alignment."""
    alignment = np.abs(found.rotation_matrix.T @ truth.rotation_matrix)
    _, partner = linear_sum_assignment(-alignment)
    return found.size - truth.size[partner]


def run(name: str, row: Row, count: int) -> dict[str, Any]:
    """Fit every image of a row with both methods."""
    rng = np.random.default_rng(SEED + list(ROWS).index(name))
    truth = row.bodies(count, rng)
    options = surface_fit.FitOptions(pixels=row.pixels)
    fits: list[Fit] = []
    classic: list[Superquadric] = []
    times: list[tuple[float, float]] = []
    for body in truth:
        image = row.image(body) if row.image else sensor(body, rng)
        if row.damage:
            image = row.damage(image, rng)
        began = time.perf_counter()
        fits.append(surface_fit.fit(image.depth, image.mask, image.camera, options=options))
        between = time.perf_counter()
        points = image.camera.points(image.depth)[image.mask & np.isfinite(image.depth)]
        after = time.perf_counter()
        classic.append(solina_bajcsy.fit(points).superquadric)
        times.append((1e3 * (between - began), 1e3 * (time.perf_counter() - after)))
    milliseconds, classic_milliseconds = np.array(times).T
    found = Superquadric.stack([fit.superquadric for fit in fits])
    iou = 100 * metrics.volume_iou(found, truth)
    iou_classic = 100 * metrics.volume_iou(Superquadric.stack(classic), truth)
    errors = np.array([size_errors(f, t) for f, t in zip(found, truth, strict=True)])
    sigma = np.array([fit.sigma_size for fit in fits])
    covered = np.abs(errors) <= 2 * sigma
    poor = iou < 95
    return {
        "iou": report.spread(iou),
        "milliseconds": report.spread(milliseconds),
        "classic_iou": report.spread(iou_classic),
        "classic_milliseconds": report.spread(classic_milliseconds),
        "within_2_sigma": float(covered.mean() * 100),
        "within_2_sigma_where_iou_below_95": float(covered[poor].all(axis=1).mean() * 100) if poor.any() else None,
        "below_95": float(poor.mean() * 100),
        "status": {s.name.lower(): int(sum(fit.status == s for fit in fits)) for s in Status},
        "worst": [[int(k), float(iou[k]), fits[k].message] for k in np.argsort(iou)[:5]],
        "goal": row.goal,
    }


def main() -> None:
    parser = report.parser(__doc__, "single_body")
    parser.add_argument("--bodies", type=int, default=2000)
    parser.add_argument("--rows", default="", help="names of rows, separated by semicolons; all by default")
    parser.add_argument("--update", action="store_true", help="keep the other rows of the files, with their commits")
    options = parser.parse_args()
    report.pin()
    surface_fit.warm_up()
    names = [name.strip() for name in options.rows.split(";")] if options.rows else list(ROWS)
    result = report.previous(options.name, "rows") if options.update else {}
    for name in names:
        result[name] = {**run(name, ROWS[name], options.bodies), "commit": report.commit()}
        print(" | ".join(cells(name, result[name]).values()), flush=True)
    ordered = {name: result[name] for name in ROWS if name in result}
    rows = [cells(name, line) for name, line in ordered.items()]
    report.write(options.name, {"options": vars(options), "rows": ordered}, report.table_of(rows))


def cells(name: str, line: dict[str, Any]) -> dict[str, str]:
    """A row of the table."""
    ms, classic, old = line["milliseconds"], line["classic_milliseconds"], line["classic_iou"]
    covering = line["within_2_sigma_where_iou_below_95"]
    return {
        "data": name,
        "IoU %": f"{line['iou']['mean']:.2f} +- {line['iou']['std']:.2f}",
        "min": f"{line['iou']['min']:.1f}",
        "ms median / p95": f"{ms['median']:.1f} / {ms['p95']:.1f}",
        "x classic": f"{ms['median'] / classic['median']:.1f}",
        "goal: mean / min / ms": line["goal"],
        "2 sigma %": f"{line['within_2_sigma']:.1f}",
        "IoU < 95 % (of these, covered)": f"{line['below_95']:.1f}"
        + ("" if covering is None else f" ({covering:.0f})"),
        "classic: mean / min / ms": f"{old['mean']:.1f} / {old['min']:.0f} / {classic['median']:.1f} ms",
    }


if __name__ == "__main__":
    main()
