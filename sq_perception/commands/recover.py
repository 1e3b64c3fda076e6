"""``sq-perception recover`` and ``grasp``: recorded frames in; JSON, meshes, pictures, a bag and a table out.

Outputs are checked before the first frame is read, and existing files are kept until a complete result replaces them
(:mod:`sq_perception.commands.recover_outputs`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from sq_perception.commands.console import (
    add_depth,
    argument,
    at_least,
    folder,
    mark_negatives,
    number,
    parser,
    positive,
    target,
    text_target,
)

HELP = """\
Recover superquadrics from recorded depth images.

A FRAME is
  .npz           depth (float, metres, NaN = no reading) and K (3 x 3); optional labels = instance masks, used instead
                 of segmentation
  an image       PNG, TIFF or NPY of 16 bit (millimetres), TIFF, NPY or EXR (extra 'exr') of floats (metres), or see
                 --depth-scale; 0 = no reading, as is the type's largest number, and what many pixels share beyond all
                 others; with --camera-info, a camera file beside it, or a YAML of its name
  .pcd, .ply     a point cloud in the optical frame, or see --frame; a PCD that is an image of a pinhole camera is taken
                 as one; a field instance or label of the points, 0 for none, holds masks; also .npz with points
                 (n, 3) or (height, width, 3) and optional labels
  .png, .bmp     with --projection orthographic: grey images of the unit cube, larger is nearer, 0 = background
  a folder       all its frames in natural order, or else those of its subfolders (four levels); their camera is
                 camera_info.yaml, camera.json, scene_camera.json, intrinsics.json ... in it
  a rosbag2      a folder with metadata.yaml, or a .mcap or .db3 file: 16UC1 and 32FC1 images, raw or compressedDepth,
                 with the camera_info beside their topic, and masks on mask/image; needs no ROS, but the extra 'bags'

Unreadable frames are reported and skipped; the exit code is then 1.
"""
EPILOG = """\
methods:
  auto       network and surface fit (best)
  symmetry   surface fit only
  network    network only
  classic    Solina and Bajcsy's fit to the points

examples:
  sq-perception recover table.npz --json out.json --pictures pictures/
  sq-perception recover depth_*.png --camera-info 525,525,319.5,239.5 --csv out.csv --html out.html
  sq-perception recover recording/ --topic /camera/depth/image_rect_raw --every 10 --meshes meshes/
  sq-perception recover thousand_frames/ --jobs 8 --jsonl out.jsonl    # continues after Ctrl-C
  sq-perception recover recording/ --track --mcap results.mcap
  sq-perception recover left.npz right.npz --poses poses.txt --json scene.json
  sq-perception recover views/*.bmp --projection orthographic --method network --json -

one line per body:
  0 converged 480 x 196 x 214 mm (+-5 +-11 +-7) at 0.12 0.03 0.84 m
  Index in "superquadrics" and in the meshes, status, FULL edges with standard deviations, centre.
  What weak and failed mean, and what to do with them: docs/how_sure.md.

files:
  Existing files are replaced only by complete results: an interrupted run writes NAME.partial.SUFFIX, and a run without
  any frame writes nothing.  Devices, FIFOs and links are written through.
  --jsonl FILE grows by one line per frame; the same command with the same file skips the frames in it.
  JSON has HALF sizes in metres; sq_perception/recordings/result.schema.json describes every field.  CSV has one row per
  body with the same numbers.  Positions are in the optical frame (x right, y down, z forward), of orthographic frames
  in the unit cube (x right, y up, z to the viewer).  A file named by a time (1305031102.160407.png) has that stamp.

camera files:
  K as written by camera_info, OpenCV, librealsense, Open3D, BOP, Kalibr, NeRF, COLMAP, ORB-SLAM, ScanNet and others, or
  a text or NPZ of K or fx fy cx cy.  If the file has no size, the image's is used.  A depth_scale in it is applied.

distortion:
  If a camera_info has nonzero distortion coefficients (plumb_bob, rational_polynomial, equidistant), --distortion auto
  treats images as rectified if the last two parts of their topic or path contain the word rect or rectified
  (image_rect, image_rect_raw, rect/image.png), and otherwise rectifies them.

several frames:
  --track follows bodies over the frames of each bag and folder, for a static camera (docs/tracking.md).
  --poses FILE fuses all frames as views of one static scene and prints the result at the end, in the world of the poses
  ("scene" in --json).  FILE has one line per frame as in TUM RGB-D: NAME tx ty tz qx qy qz qw, camera to world in
  metres; NAME is the frame's file, its topic or its stamp in seconds.

bags, meshes, obstacles:
  --mcap writes what recover_node would have published and read (docs/bags.md).
  --meshes and --export write a file per frame with bodies, in metres; PLY and obstacles have the coordinates of the
  JSON, GLB (y up) turns them by 180 degrees about x.  Each obstacle is the smallest enclosing box, cylinder, sphere or
  capsule (not in URDF); --inflate enlarges it by its uncertainty.  Meshes of URDF and SDF are STL files beside it.
"""


def recover(arguments: Sequence[str]) -> int:
    """Run ``sq-perception recover``; return the exit code."""
    command = parser("recover", HELP, EPILOG)
    add = command.add_argument
    add("frames", nargs="+", metavar="FRAME", help="recorded depth images, folders or bags of them")
    add("--projection", choices=("pinhole", "orthographic"), default="pinhole")
    add("--camera-info", metavar="FILE", help="intrinsics of images and bags, before their own: a file, or fx,fy,cx,cy")
    add("--topic", metavar="NAME", help="depth topic of a bag, if it has several")
    add("--camera-info-topic", metavar="NAME", help="camera_info topic, if it is not beside the depth topic")
    add_depth(command)
    add("--every", type=at_least(1), default=1, metavar="N", help="only every Nth frame of a bag or folder")
    add("--method", choices=("auto", "network", "symmetry", "classic"), default="auto", help="see below")
    add("--json", type=text_target, metavar="OUT", help="write the results there; - is the standard output")
    add("--jsonl", type=text_target, metavar="OUT", help="append a line per frame, skip those already there, see below")
    add("--csv", type=text_target, metavar="OUT", help="write the bodies there as a table; - is the standard output")
    add("--html", type=target, metavar="OUT", help="write one page with points, bodies and numbers, for any browser")
    add("--depth-min", type=float, default=0.0, metavar="M", help="metres; ignore nearer readings")
    add("--depth-max", type=float, default=math.inf, metavar="M", help="metres; ignore farther readings")
    add(
        "--roi", type=_region, metavar="X,Y,W,H",
        help="use only this part of each image, in pixels, after rectification",
    )
    masks = "label images NAME.png, 0 is background, or binary ones, NAME_000000.png ... (BOP)"
    add("--masks", type=_existing, metavar="DIR", help=masks)
    add(
        "--distortion", choices=("auto", "apply", "ignore"), default="auto",
        help="rectify images, assume they are rectified, or decide by their names; see below",
    )
    add("--limit", type=at_least(1), metavar="N", help="at most N frames of each bag or folder")
    add("--pictures", type=folder, metavar="DIR", help="draw a picture per frame into this folder")
    add("--meshes", type=folder, metavar="DIR", help="write the bodies of each frame as a mesh into this folder")
    add("--mesh-format", choices=("glb", "ply", "stl", "obj"), default="glb", help="of --meshes (default glb)")
    add(
        "--export", choices=("urdf", "sdf", "mjcf", "curobo"), help="write the bodies of each frame as obstacles, below"
    )
    add("--export-folder", type=folder, metavar="DIR", default=Path(), help="folder of the scenes (default: here)")
    add("--export-meshes", action="store_true", help="as close meshes instead of enclosing solids")
    add(
        "--inflate", type=number("a number from 0", lambda value: value >= 0), default=0.0, metavar="K",
        help="enlarge them by K standard deviations",
    )
    add("--mcap", type=target, metavar="OUT", help="write results and depth as a bag (extra 'bags'), see below")
    add(
        "--mcap-images", metavar="LIST", default="depth",
        help="images of the bag, comma separated: depth (default), rendered, labels, or none",
    )
    add("--model", metavar="FILE", help="weights: a .safetensors file, or the name of shipped ones")
    add("--track", action="store_true", help="track bodies over the frames of each bag or folder, see below")
    add("--poses", type=Path, metavar="FILE", help="camera poses of frames that show one scene, see below")
    add("--parts", action="store_true", help="also recover the parts of objects that one body does not explain")
    add(
        "--time-budget", type=positive, default=math.inf, metavar="S",
        help="seconds per frame after which fits try no further start",
    )
    add(
        "--jobs", type=at_least(1), default=1, metavar="N",
        help="number of frames processed in parallel (1: the objects of one frame in parallel)",
    )
    score = number("a score from 0 to 1", lambda value: 0 <= value <= 1)
    add("--min-score", type=score, default=0.0, metavar="S", help="leave out bodies with a lower score, 0 to 1")
    add("-q", "--quiet", action="store_true", help="print errors only")
    add("-v", "--verbose", action="store_true", help="also print stage times and the log")
    add("--max-objects", type=at_least(1), default=20, metavar="N", help="most objects, the largest first (default 20)")
    add("--max-size", type=float, default=0.6, metavar="M", help="largest edge of an object in metres (default 0.6)")
    add(
        "--workspace", type=float, nargs=6, metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="box in the optical frame, metres, for the centres of objects",
    )
    options = command.parse_args(mark_negatives(arguments))

    from sq_perception.commands import recover_run

    return recover_run.run(options)


GRASP_HELP = """\
Plan grasps of a parallel gripper on the objects of recorded depth images.

A FRAME is what 'sq-perception recover' reads: an .npz with depth and K, a PNG with a camera beside it, a folder, a bag.
"""
GRASP_EPILOG = """\
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


def grasp(arguments: Sequence[str]) -> int:
    """Run ``sq-perception grasp``; return the exit code."""
    command = parser("grasp", GRASP_HELP, GRASP_EPILOG)
    add = command.add_argument
    add("frames", nargs="+", metavar="FRAME", help="recorded depth images, folders or bags of them")
    add("--gripper", default="panda", help="panda, robotiq_2f_85 or robotiq_2f_140 (default panda)")
    add("--parts", action="store_true", help="grasp objects of several bodies by their parts: handles, necks, stems")
    add("--friction", type=positive, help="smallest friction coefficient between pads and objects (default 0.5)")
    add("--camera-info", metavar="FILE", help="the intrinsics of images, as for recover")
    add("--topic", metavar="TOPIC", help="depth topic of a bag, if it has several")
    add_depth(command)
    add("--json", type=text_target, metavar="OUT", help="write the grasps there; - is the standard output")
    add("--pictures", type=folder, metavar="DIR", help="draw a picture per frame into this folder")
    add("--meshes", type=folder, metavar="DIR", help="write bodies and best grasps of each frame as a GLB there")
    options = command.parse_args(mark_negatives(arguments))

    from sq_perception.commands import grasp_run

    return grasp_run.run(options)


@argument
def _region(text: str) -> tuple[int, int, int, int]:
    try:
        left, top, width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"expected left,top,width,height in pixels, got {text!r}") from None
    return left, top, width, height


@argument
def _existing(text: str) -> Path:
    if not Path(text).is_dir():
        raise ValueError(f"{text}: expected a folder")
    return Path(text)
