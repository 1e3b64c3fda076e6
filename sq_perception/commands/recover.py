"""``sq-perception recover``: recorded frames in; JSON, meshes, pictures, a bag and a table out.

Whether everything can be written is known before the first frame is read, and what was there before is kept until there
is something better (:mod:`sq_perception.commands.recover_outputs`).  Heavy imports happen inside, so that ``--help``
answers at once.
"""

from __future__ import annotations

import argparse
import logging
import math
from collections.abc import Sequence
from pathlib import Path

from sq_perception.commands import recover_outputs
from sq_perception.commands.console import FAILURE, at_least, complain, failed, misused, parser, positive

HELP = """\
Recover superquadrics from recorded depth images.

A FRAME is
  .npz           depth (float, metres, NaN = no reading) and K (3 x 3); optional labels = instance masks, which are
                 then used instead of an own segmentation
  an image       PNG or TIFF of 16 bit (millimetres), TIFF, NPY or EXR (extra 'exr') of floats (metres), or see
                 --depth-scale; 0 = no reading; with --camera-info or a camera file beside it
  .pcd, .ply     a point cloud in the optical frame; a PCD that is an image of a pinhole camera is taken as one
  .png, .bmp     with --projection orthographic: grey images of the unit cube, larger is nearer, 0 = background
  a folder       all frames in it, in natural order, or those of its subfolders where it has none; camera_info.yaml,
                 camera.yaml, intrinsics.json or camera_intrinsic.json in it is the camera of its images
  a rosbag2      a folder with metadata.yaml, or a .mcap or .db3 file: 16UC1 and 32FC1 images, raw or compressedDepth,
                 with the camera_info beside their topic, and masks on mask/image; needs no ROS, but the extra 'bags'

What cannot be read is reported and skipped; the exit code is then 1.
"""
EPILOG = """\
methods:
  auto       the network and central symmetry start an exact surface fit (best)
  symmetry   the same fit, without the network
  network    the network alone, unrefined (fastest)
  classic    Solina and Bajcsy's fit to the points

examples:
  sq-perception recover table.npz --json out.json --pictures pictures/
  sq-perception recover depth_*.png --camera-info 525,525,319.5,239.5 --csv out.csv --html out.html
  sq-perception recover recording/ --topic /camera/depth/image_rect_raw --every 10 --meshes meshes/
  sq-perception recover thousand_frames/ --jobs 8 --jsonl out.jsonl    # again after Ctrl-C: goes on
  sq-perception recover thousand_frames/ --cluster tcp://10.0.0.1:8786 --jsonl out.jsonl
  sq-perception recover recording/ --track --mcap results.mcap
  sq-perception recover views/*.bmp --projection orthographic --method network --json -

a line a body:
  0 converged 480 x 196 x 214 mm (+-5 +-11 +-7) at 0.12 0.03 0.84 m
  Its place in "superquadrics" and in the meshes, its status, FULL edges with their standard deviations, its centre.
  What weak and failed mean, and what to do with them: docs/how_sure.md.

files:
  What is there stays until something better can take its place: a result that was interrupted, or of no frame at all,
  does not replace a file but is put beside it as NAME.partial.SUFFIX.  Devices, FIFOs and links are written through.
  --jsonl FILE grows by a line a frame; the same command with the same file skips the frames that are in it.
  JSON has HALF sizes in metres; sq_perception/recordings/result.schema.json describes every field of it.  CSV has a row
  a body, with the same numbers.  Positions are in the optical frame (x right, y down, z forward); those of orthographic
  frames in the unit cube (x right, y up, z to the viewer).  A file whose name is a time (1305031102.160407.png) has
  that stamp.

distortion:
  Where a camera_info has distortion coefficients that are not zero, --distortion auto takes images for rectified if the
  last two parts of their topic or path have the word rect or rectified in them (image_rect, image_rect_raw,
  rect/image.png), and for raw otherwise.  Raw images are rectified: their camera is then that of K, in a window that
  shows what the raw image shows.  models: plumb_bob, rational_polynomial, equidistant.

tracking:
  --track follows bodies over the frames of each bag and folder, for a camera that stands still (docs/tracking.md);
  "track" has the numbers of all frames so far.  With --jobs or --cluster each frame is recovered for itself.

bags:
  --mcap writes what recover_node would have published, and what it would have read (docs/bags.md).

meshes:
  One file a frame with all its bodies, in metres, coloured as in the pictures; a frame without a body gets none.  PLY
  has the coordinates of the JSON.  GLB turns the optical frame half about x, as its y axis points up, and names each
  body by its place in "superquadrics": body_0, body_1, ...
"""


def main(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception recover``; the exit code."""
    command = parser("recover", HELP, EPILOG)
    _add_arguments(command)
    return _run(command.parse_args(arguments))


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("frames", nargs="+", metavar="FRAME", help="recorded depth images, folders or bags of them")
    parser.add_argument("--json", metavar="OUT", help="write the results there; - is the standard output")
    parser.add_argument(
        "--jsonl",
        metavar="OUT",
        help="add a line there for each frame when it is done, and skip those it has; see below",
    )
    parser.add_argument("--csv", metavar="OUT", help="write the bodies there as a table; - is the standard output")
    parser.add_argument("--html", metavar="OUT", help="write one page with points, bodies and numbers, for any browser")
    parser.add_argument("--projection", choices=("pinhole", "orthographic"), default="pinhole")
    methods = ("auto", "network", "symmetry", "classic")
    parser.add_argument("--method", choices=methods, default="auto", help="see below")
    parser.add_argument(
        "--refine",
        choices=("surface", "soft_render", "none"),
        default="surface",
        help="what follows the start: the exact fit, descent on the soft-rendered depth, or nothing",
    )
    parser.add_argument(
        "--camera-info",
        metavar="FILE",
        help="the intrinsics of images and bags: YAML, JSON of librealsense or Open3D, or fx,fy,cx,cy; goes before "
        "what a folder or bag has",
    )
    parser.add_argument(
        "--depth-scale",
        type=float,
        metavar="N",
        help="units a metre (default 1000 of whole numbers, TUM RGB-D has 5000; 1 of floats)",
    )
    parser.add_argument("--depth-min", type=float, default=0.0, metavar="M", help="metres; nearer readings are none")
    parser.add_argument("--depth-max", type=float, default=math.inf, metavar="M", help="metres; farther ones likewise")
    parser.add_argument("--roi", type=_region, metavar="X,Y,W,H", help="only this part of each image, in pixels")
    parser.add_argument(
        "--masks", type=_folder, metavar="DIR", help="label images, one a frame: its name and .png, 0 is background"
    )
    parser.add_argument(
        "--distortion",
        choices=("auto", "apply", "ignore"),
        default="auto",
        help="of PNGs and bags: undo it (apply), take images for rectified (ignore), or go by their names, see below",
    )
    parser.add_argument("--topic", metavar="NAME", help="depth images of a bag, where it has several such topics")
    parser.add_argument(
        "--every", type=at_least(1), default=1, metavar="N", help="only every Nth frame of a bag or folder"
    )
    parser.add_argument("--limit", type=at_least(1), metavar="N", help="at most N frames of each bag or folder")
    parser.add_argument("--pictures", metavar="DIR", help="draw a picture per frame into this folder")
    parser.add_argument("--meshes", metavar="DIR", help="write the bodies of each frame as a mesh into this folder")
    parser.add_argument("--mesh-format", choices=("glb", "ply"), default="glb", help="of --meshes (default glb)")
    parser.add_argument("--mcap", metavar="OUT", help="write results and depth as a bag (extra 'bags'), see below")
    parser.add_argument(
        "--mcap-images",
        metavar="LIST",
        default="depth",
        help="which images it has: depth, rendered, labels, with commas, or none (default depth)",
    )
    parser.add_argument("--model", metavar="FILE", help="weights: a .safetensors file, or the name of shipped ones")
    parser.add_argument(
        "--consensus", action="store_true", help="average the network's answers to 8 positions of each view"
    )
    parser.add_argument("--ignore-masks", action="store_true", help="segment, even where a frame brings labels")
    parser.add_argument(
        "--track",
        action="store_true",
        help="follow bodies over the frames of each bag or folder, see below; not for folders of unrelated frames",
    )
    parser.add_argument(
        "--time-budget",
        type=positive,
        default=math.inf,
        metavar="S",
        help="seconds per frame after which no further start is tried; the largest and nearest objects come first",
    )
    parser.add_argument(
        "--jobs",
        type=at_least(1),
        default=1,
        metavar="N",
        help="recover N frames at a time, in processes of one thread each: for many frames (default 1: one frame at a "
        "time, its objects in threads)",
    )
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="recover frames on a running Dask cluster, as tcp://10.0.0.1:8786; its workers have this package, too "
        "(extra 'cluster')",
    )
    parser.add_argument("--min-score", type=float, default=0.0, metavar="S", help="leave out bodies with a lower score")
    parser.add_argument("-q", "--quiet", action="store_true", help="no table and no summary; what went wrong is said")
    parser.add_argument(
        "-v", "--verbose", action="store_true", help="also say the time of each stage, and what is logged"
    )
    parser.add_argument(
        "--max-objects", type=at_least(1), default=20, metavar="N", help="largest ones first (default 20)"
    )
    parser.add_argument(
        "--max-size", type=float, default=0.6, metavar="M", help="largest edge of an object in metres (default 0.6)"
    )
    parser.add_argument(
        "--workspace",
        type=float,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="box of the optical frame, in metres, that the middle of what is seen of an object lies in",
    )


def _region(text: str) -> tuple[int, int, int, int]:
    try:
        left, top, width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected left,top,width,height in pixels, got {text!r}") from None
    return left, top, width, height


def _folder(text: str) -> Path:
    if not Path(text).is_dir():
        raise argparse.ArgumentTypeError(f"{text}: expected a folder")
    return Path(text)


def _run(options: argparse.Namespace) -> int:
    if options.cluster and options.jobs > 1:
        return misused("--jobs, --cluster: one of them; a cluster has as many processes as it has")
    if problem := recover_outputs.misuse(options):
        return misused(problem)
    if options.verbose:
        logging.basicConfig(level=logging.INFO, format="sq-perception: %(message)s")

    from sq_perception.commands.recover_lines import lines
    from sq_perception.commands.recover_run import RecoverRun
    from sq_perception.learning import checkpoint
    from sq_perception.recordings.frame_file import FrameError, Reading
    from sq_perception.recordings.inputs import RecordedInput
    from sq_perception.recordings.result_json import Recovered
    from sq_perception.recovery import workers
    from sq_perception.recovery.options import NEEDS_NETWORK
    from sq_perception.recovery.recoverer import Recoverer, RecoveryOptions

    done = Recovered()
    try:
        settings = RecoveryOptions(
            method=options.method,
            refine=options.refine,
            max_objects=options.max_objects,
            time_budget=options.time_budget,
            max_size=options.max_size,
            workspace=None if options.workspace is None else tuple(options.workspace),
        )
        recorded = RecordedInput(
            options.frames,
            options.camera_info,
            options.projection,
            options.topic,
            options.every,
            options.limit,
            options.distortion,
            Reading(options.depth_scale, options.depth_min, options.depth_max, options.roi, options.masks),
            done,
        )
        if problem := recover_outputs.replaced_input(options, recorded.files):
            return misused(problem)
        if options.method in NEEDS_NETWORK:
            checkpoint.check(options.model)
        outputs = recover_outputs.Outputs(options)
        done.add(outputs.done)
        setup = workers.Setup(options.model, settings, options.consensus)
        crew: Recoverer | workers.Processes | workers.Cluster
        if options.cluster:
            crew = workers.Cluster(setup, options.cluster)
        elif options.jobs > 1:
            crew = workers.Processes(setup, options.jobs)
        else:
            crew = Recoverer(options.model, method=options.method, consensus=options.consensus)
    except (FrameError, checkpoint.CheckpointError, OSError, ImportError) as error:
        return failed(str(error))
    except ValueError as error:
        return misused(str(error))

    run = RecoverRun(options, settings, crew, outputs)
    code = run.over(recorded)
    for problem in outputs.finish(run.is_whole):
        complain(problem)
        code = code or FAILURE
    if "-" not in (options.json, options.jsonl, options.csv) and not options.quiet:
        for line in lines(outputs.results, options.verbose):
            print(line)
    if not options.quiet:
        complain(run.summary())
    return code
