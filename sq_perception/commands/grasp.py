"""``sq-perception grasp``: recorded frames in; grasps out, as JSON, pictures and meshes."""

from __future__ import annotations

from collections.abc import Sequence

from sq_perception.commands.console import (
    add_depth,
    add_ignore_masks,
    folder,
    parser,
    positive,
    text_target,
    with_negatives,
)

HELP = """\
Plan grasps of a parallel gripper on the objects of recorded depth images.

A FRAME is what 'sq-perception recover' reads: an .npz with depth and K, a PNG with a camera beside it, a folder, a bag.
"""
EPILOG = """\
output:
  {"format": "sq_perception.grasps", "version": 1, "options": {...},
   "frames": [{"file": ..., "stamp": {"sec": ..., "nanosec": ...}, "bodies": [{"body": ..., "label": ..., "reason": ...,
   "grasps": [{"position": [x, y, z], "rotation": [x, y, z, w], "opening": ..., "width": ..., "score": ...,
   "weakest": ...}, ...]}, ...]}, ...]}
  Position and rotation are those of the gripper's tool centre point, metres in the optical frame: z is the approach, y
  the closing direction.  "score" is the probability that the grasp holds, best first; "weakest" its smallest factor.
  Bodies are numbered as in `recover`; one without a grasp has a reason.  The stamp is null if the frame has none.

examples:
  sq-perception grasp table.npz --json grasps.json --pictures pictures/
  sq-perception grasp depth_1.png --camera-info camera.yaml --gripper robotiq_2f_85 --meshes meshes/
"""


def main(arguments: Sequence[str]) -> int:
    """Run ``sq-perception grasp``; return the exit code."""
    command = parser("grasp", HELP, EPILOG)
    add = command.add_argument
    add("frames", nargs="+", metavar="FRAME", help="recorded depth images, folders or bags of them")
    add("--gripper", default="panda", help="panda, robotiq_2f_85 or robotiq_2f_140 (default panda)")
    add("--parts", action="store_true", help="grasp objects of several bodies by their parts: handles, necks, stems")
    add("--friction", type=positive, help="smallest friction coefficient between pads and objects (default 0.5)")
    add("--camera-info", metavar="FILE", help="the intrinsics of images, as for recover")
    add("--topic", metavar="TOPIC", help="depth topic of a bag, if it has several")
    add_depth(command)
    add_ignore_masks(command)
    add("--json", type=text_target, metavar="OUT", help="write the grasps there; - is the standard output")
    add("--pictures", type=folder, metavar="DIR", help="draw a picture per frame into this folder")
    add("--meshes", type=folder, metavar="DIR", help="write bodies and best grasps of each frame as a GLB there")
    options = command.parse_args(with_negatives(arguments))

    from sq_perception.commands import grasp_run

    return grasp_run.run(options)
