"""What the picking benchmark looks like: scenes with grasps, a film of a cleared table, a picture of each failure.

    python benchmarks/picking_pictures.py --scenes docs/grasping.png
    python benchmarks/picking_pictures.py --film docs/picking.gif [--kind packed] [--seed 5001]
    python benchmarks/picking_pictures.py --failures docs/grasp_failures.png --each runs/picking.jsonl
    python benchmarks/picking_pictures.py --handles docs/grasp_handles.png

A failure is shown by the first pick of that cause in the lines of a run, of ours where there is one: what the sensor
saw, the body that was planned on, and the gripper where it was sent.  Scenes are computed again from their seeds.
"""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import parts
import picking
from common import picking_contestants, picking_scenes, report
from common.picking_scenes import EYE, GRIPPER, KINDS, LOOK, TABLE_CAMERA
from common.picking_world import STEP, World
from PIL import Image

from sq_perception.evaluation import plots
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.grasping.plan import GraspPlan
from sq_perception.grasping.planner import grasps_of
from sq_perception.grasping.surroundings import Surroundings
from sq_perception.imaging.camera import Camera
from sq_perception.recovery.recoverer import Recoverer
from sq_perception.simulation.household import KINDS as KINDS_OF_THINGS
from sq_perception.simulation.rendering import render_things

SHOWN = (150.0, 490.0, 65.0, 335.0)
"""Left, right, top, bottom of a picture, pixels."""
TOOLS = (3004, 3010, 3043)
"""Seeds of tools whose best grasp is on the handle."""
CAUSES = {
    "collision": "collision with the table or another thing",
    "wrong size": "the fingers do not pass the thing",
    "missed": "nothing between the fingers",
    "slipped": "slipped",
}
FILM_CAMERA = Camera(320, 240, 370.0, 370.0, 159.5, 129.5)
PERIOD, COLOURS = 0.12, 64
"""Seconds between the pictures of a film, and its palette."""
HAND, TABLE = np.array([0.25, 0.25, 0.28]), np.array([0.93, 0.92, 0.89])
_SHARP = np.full(2, 0.05)
_LIGHT = np.array([0.35, -0.75, -0.55])


def scenes(path: Path, seed: int, recoverer: Recoverer) -> None:
    """A scene of each kind before the first pick, with the best grasp of each body."""
    figure = plots.new_figure(13.0, 5.1)
    for column, kind in enumerate(KINDS):
        scene = picking_scenes.scene(kind, seed)
        world = scene.world()
        depth = picking_scenes.observed(world, scene.sensor, np.random.default_rng([seed, 1]))
        seen = picking_contestants.Seen(depth, recoverer.recover(depth, TABLE_CAMERA), world)
        bodies = [one.superquadric for one in seen.recovery.recovered]
        ax = figure.add_axes((0.5 * column + 0.003, 0.0, 0.494, 1.0))
        plan = seen.plan(bodies, np.array([one.covariance for one in seen.recovery.recovered]))
        _draw(ax, depth, bodies, plan, f"{kind}, {scene.sensor}")
    plots.save(figure, path, dots_per_inch=90)


def handles(path: Path, recoverer: Recoverer) -> None:
    """Tools of benchmarks/parts with their parts, and the best grasp of each, on the part that it holds."""
    figure = plots.new_figure(3.6 * len(TOOLS), 3.6)
    for column, seed in enumerate(TOOLS):
        made = parts.seen_scene(["tool"], 1, [KINDS_OF_THINGS.index("tool"), seed])
        assert made is not None
        truth, depth = made
        found = recoverer.recover(depth, truth.camera, truth.labels, parts.WITH_PARTS)
        around = Surroundings.of_image(depth, truth.camera, found.plane)
        best = grasps_of(found.recovered, GRIPPER, around).grasps[0]
        solids = list(found.recovered[0].solids)
        held = int(np.argmin([solid.gauge(best.position[None])[0] for solid in solids]))
        rows, columns = np.nonzero(truth.labels)
        middle, reach = np.array([columns.mean(), rows.mean()]), 0.8 * max(np.ptp(columns), np.ptp(rows))
        (left, top), (right, bottom) = middle - reach, middle + reach
        ax = figure.add_axes((column / len(TOOLS) + 0.002, 0.0, 1 / len(TOOLS) - 0.004, 1.0))
        plots.draw_outlines(ax, solids, truth.camera, [plots.colour(1)] * len(solids), edges=False, width=1.4)
        plan, window = GraspPlan((replace(best, body=0),)), (left, right, top, bottom)
        plots.draw_grasps(ax, depth, truth.camera, [solids[held]], plan, GRIPPER, window=window)
    plots.save(figure, path, dots_per_inch=80)


def failures(path: Path, lines: list[dict[str, Any]]) -> dict[str, str]:
    """A panel for each cause that occurs; says which scene each is of."""
    order = [name for name in picking_contestants.CONTESTANTS if name not in picking_contestants.PEERS]
    lines = sorted((line for line in lines if line["contestant"] in order), key=lambda x: order.index(x["contestant"]))
    first: dict[str, tuple[dict[str, Any], int]] = {}
    for line in lines:
        for number, pick in enumerate(line["picks"]):
            first.setdefault(picking.failure(pick), (line, number))
    panels = [(cause, *first[cause]) for cause in CAUSES if cause in first]
    figure = plots.new_figure(5.2 * len(panels), 4.6)
    for column, (cause, line, number) in enumerate(panels):
        scene, name = picking_scenes.scene(line["kind"], line["seed"]), line["contestant"]
        recoverer = picking_contestants.recoverer_of(name)
        one = next(islice(picking.rounds(scene, name, recoverer), number, None))
        bodies = [found.superquadric for found in one.seen.recovery.recovered]
        ax = figure.add_axes((column / len(panels) + 0.002, 0.0, 1 / len(panels) - 0.004, 1.0))
        planned = [bodies[one.grasp.body]] if name in picking_contestants.ON_RECOVERED else []
        _draw(ax, one.seen.depth, planned, GraspPlan((replace(one.grasp, body=0),)), f"{CAUSES[cause]}\n{name}")
    plots.save(figure, path, dots_per_inch=80)
    return {cause: f"{line['contestant']}: {line['kind']} {line['seed']}" for cause, line, _ in panels}


def _draw(ax: Any, depth: np.ndarray, bodies: list[Superquadric], plan: GraspPlan, text: str) -> None:
    plots.draw_grasps(ax, depth, TABLE_CAMERA, bodies, plan, GRIPPER, window=SHOWN)
    ax.text(0.02, 0.04, text, transform=ax.transAxes, color=plots.INK, weight="bold")


def film(path: Path, kind: str, seed: int, recoverer: Recoverer) -> None:
    """A table that is cleared, as the physics has it, a picture every :data:`PERIOD` while the gripper is there."""
    scene = picking_scenes.scene(kind, seed)
    world = scene.world()
    pictures: list[np.ndarray] = [_picture(world)]
    steps = 0

    def watch(at: World) -> None:
        nonlocal steps
        steps += 1
        if steps % round(PERIOD / STEP) == 0 and at.gripper_pose()[0][2] < 1.0:
            pictures.append(_picture(at))

    world.watch = watch
    for _ in picking.rounds(scene, "ours", recoverer, world=world):
        pass
    pictures += [_picture(world)] * 8
    palette = Image.fromarray(np.concatenate(pictures[:: max(len(pictures) // 6, 1)])).quantize(COLOURS)
    frames = [Image.fromarray(one).quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=int(1000 * PERIOD), loop=0, optimize=True)


def _picture(world: World) -> np.ndarray:
    """RGB (height, width, 3) of things and gripper, lit by their slopes."""
    place, turn, opening = world.gripper_pose()
    boxes = GRIPPER.boxes(opening, reach=0.0)
    hand = Superquadric(boxes[:, 3:], np.tile(_SHARP, (3, 1)), boxes[:, :3], np.tile([0.0, 0.0, 0.0, 1.0], (3, 1)))
    hand = hand.transformed(turn, place).transformed(LOOK, EYE)
    parts, owner = picking_scenes.seen(world, [thing.parts for thing in world.things])
    cavities, cavity_owner = picking_scenes.seen(world, [thing.cavity for thing in world.things])
    both = Superquadric.from_flat(np.concatenate([parts.to_flat(), hand.to_flat()]))
    owner = np.concatenate([owner, np.full(3, len(world.things))])
    up = quaternions.to_matrix(LOOK)[:, 2]
    depth, thing = render_things(both, owner, cavities, cavity_owner, FILM_CAMERA, np.append(up, -up @ EYE))
    depth = np.where(np.isfinite(depth), depth, 2.0)
    rows, columns = np.indices(depth.shape)
    points = FILM_CAMERA.unproject(columns.ravel(), rows.ravel(), depth.ravel()).reshape(*depth.shape, 3)
    normal = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-12)
    light = 0.6 + 0.4 * np.clip(normal @ (_LIGHT / np.linalg.norm(_LIGHT)), 0, 1)
    colours = [plots.colour(k) for k in range(len(world.things))] + [HAND, TABLE]
    return np.asarray(255 * light[..., None] * np.array(colours)[thing], dtype=np.uint8)


def main() -> None:
    parser = report.parser(__doc__)
    parser.add_argument("--scenes", type=Path, metavar="PNG")
    parser.add_argument("--film", type=Path, metavar="GIF")
    parser.add_argument("--failures", type=Path, metavar="PNG")
    parser.add_argument("--handles", type=Path, metavar="PNG")
    parser.add_argument("--each", type=Path, help="lines of picking.py, for --failures")
    parser.add_argument("--kind", default="packed", choices=KINDS)
    parser.add_argument("--seed", type=int, default=5000)
    arguments = parser.parse_args()
    if arguments.scenes:
        scenes(arguments.scenes, arguments.seed, Recoverer())
    if arguments.film:
        film(arguments.film, arguments.kind, arguments.seed, Recoverer())
    if arguments.handles:
        handles(arguments.handles, Recoverer())
    if arguments.failures:
        if not arguments.each:
            parser.error("--failures needs --each")
        lines = [json.loads(line) for line in arguments.each.read_text().splitlines()]
        print(failures(arguments.failures, lines))


if __name__ == "__main__":
    main()
