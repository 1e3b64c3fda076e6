"""The run of ``sq-perception grasp``: recover, plan, and write JSON, pictures and meshes."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sq_perception.commands import console
from sq_perception.files import output_file
from sq_perception.fitting.fit import Status
from sq_perception.geometry import kernel_cache, mesh
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.grasping import planner
from sq_perception.grasping.gripper import Gripper, gripper
from sq_perception.grasping.plan import GraspPlan
from sq_perception.grasping.surroundings import Surroundings
from sq_perception.learning.checkpoint import CheckpointError
from sq_perception.recordings.bag_file import InputOptions
from sq_perception.recordings.frame_file import FrameError, Reading, RecordedFrame, Stamp
from sq_perception.recordings.inputs import RecordedInput
from sq_perception.recordings.result_json import plain_name
from sq_perception.recovery.options import RecoveryOptions
from sq_perception.recovery.recoverer import Recoverer, Recovery

_OF_EACH_GRASP = ("position", "rotation", "opening", "width", "score", "weakest")


def run(options: argparse.Namespace) -> int:
    """Run the command with these options; return the exit code."""
    kernel_cache.compile_beside()
    try:
        hand = gripper(options.gripper)
    except ValueError as error:
        return console.complain(str(error), console.USAGE)
    friction = options.friction or planner.FRICTION
    try:
        reading = Reading(
            options.depth_scale, ignore_masks=options.ignore_masks, kind=options.depth_kind, frame=options.frame
        )
        recorded = RecordedInput(
            options.frames, InputOptions(options.camera_info, topic=options.topic, reading=reading)
        )
        pictures = {"pictures": (options.pictures, ".png")}
        if problem := console.replaced_input(recorded.files, {"json": options.json}, pictures):
            return console.complain(problem, console.USAGE)
        entries: list[dict[str, Any]] = []
        code, is_whole = _plan_all(recorded, Recoverer(), hand, friction, options, entries)
        chosen = {"gripper": hand.name, "friction": friction}
        document = {"format": "sq_perception.grasps", "version": 1, "options": chosen, "frames": entries}
        text = json.dumps(document, indent=1, allow_nan=False, default=np.ndarray.tolist) + "\n"
        is_printed = options.json == console.STANDARD_OUTPUT
        is_wanted = is_printed or (options.json and entries)
        if is_wanted and (problem := console.write_document("json", options.json, text, is_whole)):
            console.complain(problem)
        if not is_printed:
            _print_table(entries)
        return code
    except (FrameError, CheckpointError, OSError) as error:
        return console.complain(str(error))


def _plan_all(
    recorded: RecordedInput, recoverer: Recoverer, hand: Gripper, friction: float, options: argparse.Namespace,
    entries: list[dict[str, Any]],
) -> tuple[int, bool]:
    """Append the elements of ``frames`` to ``entries``; return the exit code and whether all frames were tried."""
    code = console.SUCCESS
    stems: set[str] = set()
    try:
        for file, frame in recorded:
            if isinstance(frame, FrameError):
                code = console.complain(str(frame))
                continue
            if frame.is_cube:
                code = console.complain(f"{file}: a view of the unit cube has no metres to grasp in")
                continue
            for text in filter(None, (frame.warning, frame.notes)):
                console.complain(f"{file}: {text}")
            stem = output_file.free_name(frame.name if frame.topic else Path(frame.name).stem, stems)
            try:
                bodies = _bodies(stem, frame, recoverer, hand, friction, options)
            except (ValueError, ArithmeticError) as error:  # such as a camera of no image
                code = console.complain(f"{file}: {frame.name}: {error}")
                continue
            stamp = None if frame.stamp is None else frame.stamp._asdict()
            entries.append({"file": plain_name(file), "stamp": stamp, "bodies": bodies})
    except KeyboardInterrupt:
        return console.complain("interrupted; what is done so far is kept", console.INTERRUPTED), False
    except OSError as error:  # of a picture or mesh: the disk is full, and will be for the next frame
        return console.complain(str(error)), False
    return code, True


def _bodies(
    stem: str, frame: RecordedFrame, recoverer: Recoverer, hand: Gripper, friction: float, options: argparse.Namespace
) -> list[dict[str, Any]]:
    """Return a frame's element ``bodies``, numbered as by ``recover``; write its picture and mesh if requested."""
    settings = RecoveryOptions(free_space=frame.has_free_space, parts=options.parts)
    recovery = recoverer.recover(frame.depth, frame.camera, frame.labels, settings)
    if recovery.message:
        console.complain(f"{frame.name}: {recovery.message}")
    found = recovery.recovered
    numbers = [k for k, body in enumerate(recovery.bodies) if body.status != Status.FAILED]
    around = Surroundings.of_image(frame.depth, frame.camera, recovery.plane)
    plan = planner.grasps_of(found, hand, around, friction=friction)
    if options.pictures:
        _draw(options.pictures / f"{stem}.png", frame, found, numbers, plan, hand)
    if options.meshes and found:
        _write_mesh(options.meshes / f"{stem}.glb", found, numbers, plan, hand)
    planned = dict(zip(numbers, range(len(found)), strict=True))
    return [
        {
            "body": number,
            "label": int(body.label),
            "reason": plan.reasons[planned[number]] if number in planned else f"failed: {body.message}",
            "grasps": [{name: getattr(grasp, name) for name in _OF_EACH_GRASP} for grasp in plan.of(planned[number])]
            if number in planned
            else [],
        }
        for number, body in enumerate(recovery.bodies)
    ]


def _draw(
    path: Path, frame: RecordedFrame, found: Sequence[Recovery], numbers: Sequence[int], plan: GraspPlan, hand: Gripper
) -> None:
    from sq_perception.evaluation import plots

    # Of an image of few columns the picture would have more pixels than fit into memory, of one of few rows none.
    form = min(max(frame.camera.height / frame.camera.width, 0.1), 10.0)
    figure = plots.new_figure(9.6, 9.6 * form)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    bodies = [recovered.superquadric for recovered in found]
    plots.draw_grasps(ax, frame.depth, frame.camera, bodies, plan, hand, numbers)
    plots.save(figure, path)


def _write_mesh(path: Path, found: Sequence[Recovery], numbers: Sequence[int], plan: GraspPlan, hand: Gripper) -> None:
    """Write the bodies and, as sharp superquadrics, the boxes of each body's best gripper."""
    shown = [(k, solid) for k, recovered in zip(numbers, found, strict=True) for solid in recovered.solids]
    owner, solids = [k for k, _ in shown], [solid for _, solid in shown]
    names = [f"body_{k}" for k in owner]
    for place, k in enumerate(numbers):
        for grasp in plan.of(place)[:1]:
            boxes = hand.boxes(grasp.opening, reach=0.0)
            for name, box in zip(("left", "right", "hand"), boxes, strict=True):
                centre = grasp.to_body_frame(box[None, :3])[0]
                solids.append(Superquadric(box[3:], np.full(2, 0.02), centre, grasp.rotation))
                names.append(f"grasp_{k}_{name}")
                owner.append(k)
    with output_file.writing(path) as partial:
        mesh.export(solids, partial, names=names, colours=mesh.COLOURS[np.array(owner) % len(mesh.COLOURS)])


def _print_table(entries: Sequence[dict[str, Any]]) -> None:
    for entry in entries:
        print(f"{entry['file']}  {Stamp(**entry['stamp']) if entry['stamp'] else ''}".rstrip())
        for body in entry["bodies"]:
            text = body["reason"]
            if body["grasps"]:
                best = body["grasps"][0]
                at = " ".join(f"{value:.3f}" for value in best["position"])
                text = f"score {best['score']:.2f} at {at} m, {1e3 * best['opening']:.0f} mm open"
            print(f"  {body['body']} {text}")
