"""``sq-perception grasp``: recorded frames in; grasps of what is on the table out, as JSON, pictures and meshes.

Heavy imports happen inside, so that ``--help`` answers at once.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sq_perception.commands.console import (
    FAILURE,
    STANDARD_OUTPUT,
    SUCCESS,
    complain,
    failed,
    folder,
    misused,
    parser,
    positive,
    replaced_input,
    text_target,
)
from sq_perception.files import output_file

if TYPE_CHECKING:
    from sq_perception.grasping.gripper import Gripper
    from sq_perception.grasping.plan import GraspPlan
    from sq_perception.recordings.frame_file import RecordedFrame
    from sq_perception.recordings.inputs import RecordedInput
    from sq_perception.recovery.recoverer import Recoverer, Recovery

HELP = """\
Plan grasps of a parallel gripper on the objects of recorded depth images.

A FRAME is what 'sq-perception recover' reads: an .npz with depth and K, a PNG with a camera beside it, a folder, a bag.
"""
EPILOG = """\
output:
  {"format": "sq_perception.grasps", "version": 1, "options": {...},
   "frames": [{"file": ..., "bodies": [{"label": ..., "reason": ..., "grasps": [{"position": [x, y, z],
   "rotation": [x, y, z, w], "opening": ..., "width": ..., "score": ..., "weakest": ...}, ...]}, ...]}, ...]}
  Position and rotation are those of the gripper's tool centre point, metres in the optical frame: z the approach, y the
  way of the fingers.  "score" is the probability that the grasp holds, the best first; "weakest" what takes most from
  it.  A body without a grasp has the reason.

examples:
  sq-perception grasp table.npz --json grasps.json --pictures pictures/
  sq-perception grasp depth_1.png --camera-info camera.yaml --gripper robotiq_2f_85 --meshes meshes/
"""
FORMAT, VERSION = "sq_perception.grasps", 1
_SHARP = 0.02
"""Exponents of a gripper's boxes in a mesh."""


def main(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception grasp``; the exit code."""
    command = parser("grasp", HELP, EPILOG)
    add = command.add_argument
    add("frames", nargs="+", metavar="FRAME", help="recorded depth images, folders or bags of them")
    add("--gripper", default="panda", help="panda, robotiq_2f_85 or robotiq_2f_140 (default panda)")
    add("--friction", type=positive, help="between pads and things at the least (default 0.5)")
    add("--camera-info", metavar="FILE", help="the intrinsics of images, as for recover")
    add("--json", type=text_target, metavar="OUT", help="write the grasps there; - is the standard output")
    add("--pictures", type=folder, metavar="DIR", help="draw a picture per frame into this folder")
    add("--meshes", type=folder, metavar="DIR", help="write bodies and best grasps of each frame as a GLB there")
    return _run(command.parse_args(arguments))


def _run(options: argparse.Namespace) -> int:
    from sq_perception.grasping import planner
    from sq_perception.grasping.gripper import gripper

    try:
        hand = gripper(options.gripper)
    except ValueError as error:
        return misused(str(error))
    friction = options.friction or planner.FRICTION

    from sq_perception.learning.checkpoint import CheckpointError
    from sq_perception.recordings.bag_file import InputOptions
    from sq_perception.recordings.frame_file import FrameError
    from sq_perception.recordings.inputs import RecordedInput
    from sq_perception.recovery.recoverer import Recoverer

    try:
        recorded = RecordedInput(options.frames, InputOptions(options.camera_info))
        if problem := replaced_input(recorded.files, {"json": options.json}, {"pictures": (options.pictures, ".png")}):
            return misused(problem)
        return _planned(recorded, Recoverer(), hand, friction, options)
    except (FrameError, CheckpointError, OSError) as error:
        return failed(str(error))


def _planned(
    recorded: RecordedInput, recoverer: Recoverer, hand: Gripper, friction: float, options: argparse.Namespace
) -> int:
    from sq_perception.recordings.frame_file import FrameError

    entries: list[dict[str, Any]] = []
    stems: set[str] = set()
    code = SUCCESS
    for file, frame in recorded:
        if isinstance(frame, FrameError):
            complain(str(frame))
            code = FAILURE
        elif frame.is_cube:
            complain(f"{file}: a view of the unit cube has no metres to grasp in")
            code = FAILURE
        else:
            if frame.warning:
                complain(f"warning: {frame.name}: {frame.warning}")
            stem = output_file.free_name(frame.name if frame.topic else Path(frame.name).stem, stems)
            entries.append(_frame(file, stem, frame, recoverer, hand, friction, options))
    chosen = {"gripper": hand.name, "friction": friction}
    document = {"format": FORMAT, "version": VERSION, "options": chosen, "frames": entries}
    text = json.dumps(document, indent=1, allow_nan=False)
    if options.json == STANDARD_OUTPUT:
        sys.stdout.write(f"{text}\n")
    elif options.json and entries:
        output_file.write(options.json, f"{text}\n".encode())
    if options.json != STANDARD_OUTPUT:
        _print_table(entries)
    return code


def _frame(
    file: str,
    stem: str,
    frame: RecordedFrame,
    recoverer: Recoverer,
    hand: Gripper,
    friction: float,
    options: argparse.Namespace,
) -> dict[str, Any]:
    import numpy as np

    from sq_perception.geometry.superquadric import Superquadric
    from sq_perception.grasping.planner import grasps
    from sq_perception.grasping.surroundings import Surroundings
    from sq_perception.recovery.options import RecoveryOptions

    settings = RecoveryOptions(free_space=frame.has_free_space)
    recovery = recoverer.recover(frame.depth, frame.camera, frame.labels, settings)
    found = recovery.recovered
    bodies = Superquadric.stack([recovered.superquadric for recovered in found])
    covariance = np.array([recovered.covariance for recovered in found]).reshape(-1, 11, 11)
    around = Surroundings.of_image(frame.depth, frame.camera, recovery.plane)
    plan = grasps(bodies, hand, covariance, around, friction)
    if options.pictures:
        _draw(options.pictures / f"{stem}.png", frame, found, plan, hand)
    if options.meshes and found:
        _write_mesh(options.meshes / f"{stem}.glb", found, plan, hand)
    return {
        "file": file,
        "bodies": [
            {
                "label": int(recovered.label),
                "reason": plan.reasons[k],
                "grasps": [
                    {
                        "position": grasp.position.tolist(),
                        "rotation": grasp.rotation.tolist(),
                        "opening": grasp.opening,
                        "width": grasp.width,
                        "score": grasp.score,
                        "weakest": grasp.weakest,
                    }
                    for grasp in plan.of(k)
                ],
            }
            for k, recovered in enumerate(found)
        ],
    }


def _draw(path: Path, frame: RecordedFrame, found: Sequence[Recovery], plan: GraspPlan, hand: Gripper) -> None:
    from sq_perception.evaluation import plots

    figure = plots.new_figure(9.6, 9.6 * frame.camera.height / frame.camera.width)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    plots.draw_grasps(ax, frame.depth, frame.camera, [recovered.superquadric for recovered in found], plan, hand)
    with output_file.writing(path) as partial:
        plots.save(figure, partial)


def _write_mesh(path: Path, found: Sequence[Recovery], plan: GraspPlan, hand: Gripper) -> None:
    """Bodies and, as sharp superquadrics, the boxes of each body's best gripper."""
    import numpy as np

    from sq_perception.geometry import mesh
    from sq_perception.geometry.superquadric import Superquadric

    solids = [recovered.superquadric for recovered in found]
    names = [f"body_{k}" for k in range(len(found))]
    owner = list(range(len(found)))
    for k in range(len(found)):
        for grasp in plan.of(k)[:1]:
            boxes = hand.boxes(grasp.opening, reach=0.0)
            for name, box in zip(("left", "right", "hand"), boxes, strict=True):
                solids.append(Superquadric(box[3:], np.full(2, _SHARP), grasp.placed(box[None, :3])[0], grasp.rotation))
                names.append(f"grasp_{k}_{name}")
                owner.append(k)
    with output_file.writing(path) as partial:
        mesh.export(solids, partial, names=names, colours=mesh.COLOURS[np.array(owner) % len(mesh.COLOURS)])


def _print_table(entries: Sequence[dict[str, Any]]) -> None:
    for entry in entries:
        print(entry["file"])
        for body in entry["bodies"]:
            text = body["reason"]
            if body["grasps"]:
                best = body["grasps"][0]
                at = " ".join(f"{value:.3f}" for value in best["position"])
                text = f"{best['score']:.2f}  at {at} m, {1e3 * best['opening']:.0f} mm open"
            print(f"  {body['label']:4d}  {text}")
