"""``sq-perception recover``: recorded frames in; JSON, meshes, pictures, a bag and a table out.

Whether everything can be written is known before the first frame is read, and what was there before is kept until there
is something better (:mod:`sq_perception.commands.recover_outputs`).  Heavy imports happen inside, so that ``--help``
answers at once.
"""

from __future__ import annotations

import argparse
import logging
import math
import statistics
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sq_perception.commands import recover_outputs
from sq_perception.commands.console import FAILURE, INTERRUPTED, SUCCESS, complain, failed, misused, parser, progress

if TYPE_CHECKING:
    from sq_perception.recordings.frame_file import RecordedFrame
    from sq_perception.recordings.inputs import RecordedInput
    from sq_perception.recordings.result_bag import ResultBag
    from sq_perception.recordings.result_json import ResultLines
    from sq_perception.recordings.still_page import StillPage
    from sq_perception.recovery.recoverer import FrameRecovery, Recoverer, Recovery, RecoveryOptions
    from sq_perception.recovery.workers import Cluster, Processes


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
  --track follows bodies over the frames of each bag and folder, for a camera that stands still: the same body keeps its
  id and the names of its axes, and "track" has the numbers of all frames so far.  What reads the same as in the frame
  before, but for noise, is not recovered again; with --jobs or --cluster each frame is recovered for itself.

bags:
  --mcap writes what recover_node would have published, and what it would have read, with stamps, frame ids and times of
  the input: for Foxglove, ros2 bag play, RViz (docs/bags.md).  It is named when it is whole, also after Ctrl-C and on a
  full disk, with the frames until then.

meshes:
  One file a frame with all its bodies, in metres, coloured as in the pictures; a frame without a body gets none.  PLY
  has the coordinates of the JSON.  GLB turns the optical frame half about x, as its y axis points up, and names each
  body by its place in "superquadrics": body_0, body_1, ...
"""


def main(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception recover``; the exit code."""
    command = parser("recover", HELP, EPILOG)
    add_arguments(command)
    return run(command.parse_args(arguments))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's own."""
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
    parser.add_argument("--masks", metavar="DIR", help="label images, one a frame: its name and .png, 0 is background")
    parser.add_argument(
        "--distortion",
        choices=("auto", "apply", "ignore"),
        default="auto",
        help="of PNGs and bags: undo it (apply), take images for rectified (ignore), or go by their names, see below",
    )
    parser.add_argument("--topic", metavar="NAME", help="depth images of a bag, where it has several such topics")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only every Nth frame of a bag or folder")
    parser.add_argument("--limit", type=int, metavar="N", help="at most N frames of each bag or folder")
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
        type=float,
        default=math.inf,
        metavar="S",
        help="seconds per frame after which no further start is tried; the largest and nearest objects come first",
    )
    parser.add_argument(
        "--jobs",
        type=int,
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
    parser.add_argument("--max-objects", type=int, default=20, metavar="N", help="largest ones first (default 20)")
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


def run(options: argparse.Namespace) -> int:
    """Run the command; returns the exit code."""
    for name in ("max_objects", "every", "limit", "jobs"):
        value = getattr(options, name)
        if value is not None and value < 1:
            return misused(f"--{name.replace('_', '-')}: expected at least 1, got {value}")
    if options.cluster and options.jobs > 1:
        return misused("--jobs, --cluster: one of them; a cluster has as many processes as it has")
    if not options.time_budget > 0:
        return misused(f"--time-budget: expected a positive number of seconds, got {options.time_budget:g}")
    if options.masks and not Path(options.masks).is_dir():
        return misused(f"--masks: {options.masks}: expected a folder")
    if problem := recover_outputs.misuse(options):
        return misused(problem)
    if options.verbose:
        logging.basicConfig(level=logging.INFO, format="sq-perception: %(message)s")

    import torch

    from sq_perception.commands.recover_lines import lines as lines_of
    from sq_perception.learning import checkpoint
    from sq_perception.learning.checkpoint import CheckpointError
    from sq_perception.recordings.frame_file import FrameError, Reading
    from sq_perception.recordings.inputs import RecordedInput
    from sq_perception.recordings.result_json import Recovered, ResultLines
    from sq_perception.recovery import workers
    from sq_perception.recovery.options import NEEDS_NETWORK
    from sq_perception.recovery.recoverer import Recoverer, RecoveryOptions

    torch.set_num_threads(1)  # the network's layers are so small that threads cost more than they save
    done = Recovered()
    lines, bag, page = None, None, None
    try:
        settings = RecoveryOptions(
            method=options.method,
            refine=options.refine,
            max_objects=options.max_objects,
            time_budget=options.time_budget,
            max_size=options.max_size,
            workspace=None if options.workspace is None else tuple(options.workspace),
        )
        masks = Path(options.masks) if options.masks else None
        reading = Reading(options.depth_scale, options.depth_min, options.depth_max, options.roi, masks)
        recorded = RecordedInput(
            options.frames,
            options.camera_info,
            options.projection,
            options.topic,
            options.every,
            options.limit,
            options.distortion,
            reading,
            done,
        )
        if problem := recover_outputs.replaced_input(options, recorded.files):
            return misused(problem)
        crew: Recoverer | workers.Processes | workers.Cluster
        setup = workers.Setup(options.model, settings, options.consensus)
        if options.method in NEEDS_NETWORK:
            checkpoint.check(options.model)
        if options.jsonl:
            lines = ResultLines(recover_outputs.place(options.jsonl), recover_outputs.decisive(options))
            if lines.done and (options.track or options.mcap or options.html):
                name = "--track" if options.track else "--mcap" if options.mcap else "--html"
                lines.close()
                return misused(f"--jsonl: {options.jsonl} has {len(lines.done)} frames already, and {name} needs all")
            done.add(lines.done)
        bag = recover_outputs.bag(options)
        page = recover_outputs.page(options)
        if options.cluster:
            crew = workers.Cluster(setup, options.cluster)
        elif options.jobs > 1:
            crew = workers.Processes(setup, options.jobs)
        else:
            crew = Recoverer(options.model, method=options.method, consensus=options.consensus)
    except (FrameError, CheckpointError, OSError, ImportError) as error:
        return failed(str(error))
    except ValueError as error:
        return misused(str(error))

    run = _Run(options, crew, settings, lines, bag, page)
    try:
        code = run.over(recorded)
    finally:
        if lines is not None:
            lines.close()
    entries = [*(lines.done if lines else []), *run.results]
    for problem in recover_outputs.finish(options, entries, {"mcap": bag, "html": page}, run.is_whole):
        complain(problem)
        code = code or FAILURE
    if "-" not in (options.json, options.jsonl, options.csv) and not options.quiet:
        for line in lines_of(run.results, options.verbose):
            print(line)
    if not options.quiet:
        complain(run.summary())
    return code


class _Run:
    """One pass over the frames, and what it has come to so far."""

    def __init__(
        self,
        options: argparse.Namespace,
        crew: Recoverer | Processes | Cluster,
        settings: RecoveryOptions,
        lines: ResultLines | None,
        bag: ResultBag | None,
        page: StillPage | None,
    ) -> None:
        from sq_perception.recordings.tracks import RecordedTracks

        self.results: list[dict[str, Any]] = []
        self.unreadable = 0
        self.is_whole = False
        """Whether all frames were tried."""
        self._options, self._crew, self._settings = options, crew, settings
        self._lines, self._bag, self._page = lines, bag, page
        self._tracks = RecordedTracks(lambda text: complain(f"warning: {text}")) if options.track else None
        self._warm: set[Any] = set()
        self._stems = {Path(one["file"]).stem for one in lines.done if not one.get("topic")} if lines else set()
        self._warnings: set[str] = set()

    def over(self, recorded: RecordedInput) -> int:
        """All frames; the exit code."""
        from sq_perception.recordings.frame_file import FrameError

        try:
            for (file, frame), answer in self._answered(_progress(recorded)):
                try:
                    if isinstance(frame, FrameError):
                        raise frame
                    self._frame(file, frame, answer)
                except FrameError as error:
                    complain(str(error))
                    self.unreadable += 1
                except OSError as error:  # of a file that is written: the disk is full, and will be for the next frame
                    complain(str(error))
                    return FAILURE
        except KeyboardInterrupt:
            complain("interrupted; what is done so far is kept")
            return INTERRUPTED
        self.is_whole = True
        return FAILURE if self.unreadable else SUCCESS

    def summary(self) -> str:
        """The run in one line."""
        bodies = [body for entry in self.results for body in entry["superquadrics"]]
        failed = sum(body["status"] == "failed" for body in bodies)
        parts = [_count(len(self.results), "frame"), f"{_count(len(bodies), 'object')} ({failed} failed)"]
        if self.unreadable:
            parts.append(f"{_count(self.unreadable, 'frame or source', 'frames or sources')} unreadable")
        if self.results:
            parts.append(f"median {statistics.median(entry['ms'] for entry in self.results):.0f} ms")
        return ", ".join(parts)

    def _is_wanted(self, body: Recovery) -> bool:
        from sq_perception.fitting.fit import Status

        return body.status == Status.FAILED or body.score >= self._options.min_score

    def _answered(self, pairs: Iterable[tuple[str, Any]]) -> Iterator[tuple[tuple[str, Any], Any]]:
        """The frames with what was recovered of each, or the error that it raised; None for what is no frame."""
        from sq_perception.recordings.frame_file import RecordedFrame
        from sq_perception.recovery import workers

        def work(frame: RecordedFrame) -> workers.Work:
            labels = None if self._options.ignore_masks else frame.labels
            settings = replace(self._settings, free_space=frame.has_free_space)
            return workers.Work(frame.depth, frame.camera, labels, settings)

        crew = self._crew
        if isinstance(crew, workers.Processes | workers.Cluster):
            asked = ((pair, work(pair[1]) if isinstance(pair[1], RecordedFrame) else None) for pair in pairs)
            yield from workers.recovered(asked, crew)
            return
        previous: FrameRecovery | None = None
        for pair in pairs:
            answer: Any = None
            if isinstance(frame := pair[1], RecordedFrame):
                try:
                    if frame.camera not in self._warm:
                        crew.warm_up(frame.camera)
                        self._warm.add(frame.camera)
                    one = work(frame)
                    answer = crew.recover(one.depth, one.camera, one.labels, one.options, previous)
                    previous = answer if self._tracks else None
                except (ValueError, ArithmeticError) as error:
                    answer = error
            yield pair, answer

    def _frame(self, file: str, frame: RecordedFrame, answer: FrameRecovery | Exception) -> None:
        from sq_perception.recordings.frame_entry import frame_entry
        from sq_perception.recordings.frame_file import FrameError
        from sq_perception.recovery.workers import WorkerLostError

        if frame.warning and frame.warning not in self._warnings:
            complain(f"warning: {frame.warning}")
            self._warnings.add(frame.warning)
        if isinstance(answer, (ValueError, ArithmeticError, WorkerLostError)):  # such as a camera of no image
            raise FrameError(f"{file}: {frame.name}: {answer}") from answer
        if isinstance(answer, Exception):
            raise answer
        recovery = replace(answer, bodies=tuple(body for body in answer.bodies if self._is_wanted(body)))
        tracks = self._tracks.follow(file, frame, recovery) if self._tracks else [None] * len(recovery.bodies)
        entry = frame_entry(
            file, frame, recovery, tracks, has_masks=not self._options.ignore_masks and frame.labels is not None
        )
        self.results.append(entry)
        stem = _free_stem(frame.name if frame.topic else Path(frame.name).stem, self._stems)
        if self._options.pictures:
            recover_outputs.draw(Path(self._options.pictures) / f"{stem}.png", frame, recovery)
        if self._options.meshes:
            path = Path(self._options.meshes) / f"{stem}.{self._options.mesh_format}"
            recover_outputs.write_mesh(path, frame, recovery)
        if self._bag is not None:
            self._bag.add(frame, recovery, tracks if self._tracks else None)
        if self._page is not None:
            self._page.add(frame, recovery)
        if self._lines is not None:  # last: what has a line has all its files
            self._lines.add(entry)


def _count(number: int, one: str, many: str | None = None) -> str:
    return f"{number} {one if number == 1 else many or one + 's'}"


def _free_stem(stem: str, taken: set[str]) -> str:
    """A name for a frame's files that no other frame of this call has."""
    name, k = stem, 2
    while name in taken:
        name, k = f"{stem}_{k}", k + 1
    taken.add(name)
    return name


def _progress(recorded: RecordedInput) -> Iterator[tuple[str, Any]]:
    """The frames, with a bar on a terminal where there are several."""
    with progress() as bar:
        task = bar.add_task("recovering", total=recorded.total, visible=recorded.total > 1)
        for pair in recorded:
            bar.update(task, total=recorded.total, visible=recorded.total > 1)
            yield pair
            bar.advance(task)
