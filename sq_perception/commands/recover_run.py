"""The run of ``sq-perception recover`` over its frames, and its summary.

It prints a line per body, each reason once, and details on request:

    0 converged 480 x 196 x 214 mm (+-5 +-11 +-7) at 0.12 0.03 0.84 m

The number is the body's index in ``superquadrics``, as in meshes and pictures.
"""

from __future__ import annotations

import argparse
import logging
import math
import re
import statistics
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from sq_perception.commands import console
from sq_perception.commands.recover_outputs import Outputs, replaced_input
from sq_perception.fitting.fit import CUT_SHORT, Status
from sq_perception.geometry import kernel_cache
from sq_perception.learning import checkpoint
from sq_perception.recordings import result_json
from sq_perception.recordings.bag_file import InputOptions
from sq_perception.recordings.frame_file import FrameError, Reading, RecordedFrame
from sq_perception.recordings.inputs import CameraPoses, RecordedInput, RecordedTracks, sequence_of
from sq_perception.recovery import workers
from sq_perception.recovery.options import NEEDS_NETWORK
from sq_perception.recovery.recoverer import FrameRecovery, Recoverer, RecoveryOptions
from sq_perception.recovery.recovery import edges_as_text, place_as_text
from sq_perception.recovery.still_scene import StillScene


def lines(
    entries: Sequence[Mapping[str, Any]], verbose: bool, scene: Sequence[Mapping[str, Any]] = ()
) -> Iterator[str]:
    """Return the lines of all frames, the reasons with their number of bodies, and the lines of the whole scene."""
    reasons: Counter[tuple[str, str]] = Counter()
    for entry in entries:
        stamp = entry["stamp"]
        taken = "" if stamp is None else f"  {stamp['sec']}.{stamp['nanosec']:09d}"
        yield f"{entry['file']}{taken}  {entry['ms']:.0f} ms  {entry['message']}".rstrip()
        if verbose:
            yield "  " + ", ".join(f"{stage} {value:.0f} ms" for stage, value in entry["ms_by_stage"].items())
        for number, body in enumerate(entry["superquadrics"]):
            yield "  " + _line(number, body, entry["coordinates"] == "cube")
            for part in body.get("parts", ()):
                edges = edges_as_text(part["size"], _sigmas(part), False)
                place = place_as_text(part["translation"], False)
                yield f"    part {part['share']:.0%} {part['status']} {edges} at {place}"
            if verbose:
                exponents = " ".join(f"{value:.2f}" for value in body["shape"])
                seen = " ".join("?" if share is None else f"{share:.0%}" for share in body["seen"])
                facts = f"exponents {exponents}, score {body['score']:.3f}, seen {seen}, pixels {body['pixels']}"
                yield f"    {facts}: {body['message']}"
            elif body["status"] != "converged":
                reason = re.sub(" along [xyz]( and [xyz])*", "", body["message"].partition(";")[0])
                reasons[body["status"], reason] += 1
    for (status, reason), count in reasons.most_common():
        yield f"{count} {status}: {reason}"
    if reasons:
        yield "what to do with them: docs/how_sure.md; -v shows more of each body"
    for body in scene:
        edges, place = edges_as_text(body["size"], body["sigma_size"], False), place_as_text(body["translation"], False)
        yield f"  {body['status']} {edges} at {place} id {body['id']}, in {body['seen']} frames"


def _line(number: int, body: Mapping[str, Any], is_cube: bool) -> str:
    parts = [str(number), body["status"]]
    if CUT_SHORT in body["message"]:
        parts.append(f"({CUT_SHORT})")
    if body["status"] != "failed":
        parts.append(edges_as_text(body["size"], _sigmas(body), is_cube))
    parts.append(f"at {place_as_text(body['translation'], is_cube)}")
    if body["label"] is not None:
        parts.append(f" mask {body['label']}")
    if body["track"] is not None:
        parts.append(f" id {body['track']['id']}")
    return " ".join(parts)


def _sigmas(body: Mapping[str, Any]) -> list[float]:
    return [math.nan if value is None else value for value in body["sigma_size"]]


def run(options: argparse.Namespace) -> int:
    """Run ``sq-perception recover`` with these options; return the exit code."""
    if [options.json, options.jsonl, options.csv].count(console.STANDARD_OUTPUT) > 1:
        return console.complain("--json, --jsonl, --csv: only one of them can be the standard output", console.USAGE)
    if options.poses and (options.method not in ("auto", "symmetry") or options.projection == "orthographic"):
        return console.complain("--poses: expected a pinhole camera, and the method auto or symmetry", console.USAGE)
    if options.verbose:
        logging.getLogger("sq_perception").setLevel(logging.INFO)
    kernel_cache.compile_beside()
    try:
        this = RecoverRun(options)
    except (FrameError, checkpoint.CheckpointError, OSError, ImportError) as error:
        return console.complain(str(error))
    except ValueError as error:
        return console.complain(str(error), console.USAGE)
    code = this.over_all_frames()
    for problem in this.outputs.finish(this.is_whole):
        code = console.complain(problem, code or console.FAILURE)
    if console.STANDARD_OUTPUT not in (options.json, options.jsonl, options.csv) and not options.quiet:
        for line in lines(this.outputs.results, options.verbose, this.outputs.scene):
            print(line)
    if not options.quiet:
        console.complain(this.summary())
    return code


class RecoverRun:
    """One run with these options of the command.

    ``outputs``: the outputs of the run.  ``is_whole``: whether all frames were tried.  Raises FrameError,
    CheckpointError, OSError, ImportError if something cannot be read or written, or is missing; ValueError if the
    options cannot be meant so.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self.is_whole = False
        self._options = options
        self._settings = RecoveryOptions(
            method=options.method, max_objects=options.max_objects, time_budget=options.time_budget,
            max_size=options.max_size, workspace=None if options.workspace is None else tuple(options.workspace),
            parts=options.parts,
        )
        done, o = result_json.Recovered(), options
        limits = o.depth_scale, o.depth_min, o.depth_max, o.roi, o.masks, o.ignore_masks, o.depth_kind, o.frame
        source = o.camera_info, o.projection, o.topic, o.every, o.limit, o.distortion
        wanted = InputOptions(*source, Reading(*limits), o.camera_info_topic)
        self._recorded = RecordedInput(options.frames, wanted, done)
        if problem := replaced_input(options, self._recorded.files):
            raise ValueError(problem)
        if options.method in NEEDS_NETWORK:
            checkpoint.check(options.model)
        # First: nothing is begun with damaged weights, or before a Ctrl-C meanwhile.
        self._executor: Recoverer | workers.Processes = (
            workers.Processes(options.model, self._settings.method, options.jobs)
            if options.jobs > 1
            else Recoverer(options.model, method=options.method)
        )
        self.outputs = Outputs(options)
        done.add(self.outputs.done)
        poses = CameraPoses(options.poses) if options.poses else None
        is_tracked = options.track or poses is not None
        self._tracks = RecordedTracks(lambda text: console.complain(f"warning: {text}"), poses) if is_tracked else None
        self._unreadable = 0
        self._said: dict[str, set[str]] = {}

    def over_all_frames(self) -> int:
        """Recover all frames; return the exit code."""
        try:
            for (file, frame), answer in self._answer(_progress(self._recorded)):
                try:
                    if isinstance(frame, FrameError):
                        raise frame
                    self._frame(file, frame, answer)
                except FrameError as error:
                    console.complain(str(error))
                    self._unreadable += 1
                except OSError as error:  # of a file that is written: the disk is full, and will be for the next frame
                    return console.complain(str(error))
        except KeyboardInterrupt:
            return console.complain("interrupted; what is done so far is kept", console.INTERRUPTED)
        finally:
            for text, files in self._said.items():
                if len(files) > 1:
                    console.complain(f"{_count(len(files) - 1, 'more file')}: {text}")
            if self._tracks:
                self.outputs.scene = [result_json.scene_entry(track) for track in self._tracks.scene]
        self.is_whole = True
        return console.FAILURE if self._unreadable else console.SUCCESS

    def summary(self) -> str:
        """Summarise the run in one line."""
        entries = self.outputs.results
        bodies = [body for entry in entries for body in entry["superquadrics"]]
        failed = sum(body["status"] == "failed" for body in bodies)
        parts = [_count(len(entries), "frame"), f"{_count(len(bodies), 'object')} ({failed} failed)"]
        if self._unreadable:
            parts.append(f"{_count(self._unreadable, 'frame or source', 'frames or sources')} unreadable")
        if self.outputs.done:
            parts.append(f"{_count(len(self.outputs.done), 'frame')} in {self._options.jsonl} before")
        if entries:
            parts.append(f"median {statistics.median(entry['ms'] for entry in entries):.0f} ms")
        return ", ".join(parts)

    def _work(self, frame: RecordedFrame) -> workers.Work:
        settings = replace(self._settings, free_space=frame.has_free_space)
        return workers.Work(frame.depth, frame.camera, frame.labels, settings)

    def _answer(self, pairs: Iterable[tuple[str, Any]]) -> Iterator[tuple[tuple[str, Any], Any]]:
        """Yield each frame with its recovery or the error it raised; None for what is no frame."""
        executor = self._executor
        if isinstance(executor, workers.Processes):
            works = ((pair, self._work(pair[1]) if isinstance(pair[1], RecordedFrame) else None) for pair in pairs)
            yield from workers.recover_all(works, executor)
            return
        scene = StillScene(executor)
        sequence, is_warm = ("", ""), False
        for pair in pairs:
            answer: Any = None
            if isinstance(frame := pair[1], RecordedFrame):
                try:
                    if not is_warm:  # once, and not for each camera: it costs three frames, and each cloud has its own
                        executor.warm_up(frame.camera)
                        is_warm = True
                    if sequence != (of_frame := sequence_of(pair[0], frame)):
                        sequence, scene = of_frame, StillScene(executor)
                    work = self._work(frame)
                    following = scene if self._tracks else executor
                    answer = following.recover(work.depth, work.camera, work.labels, work.options)
                except (ValueError, ArithmeticError) as error:
                    answer = error
            yield pair, answer

    def _frame(self, file: str, frame: RecordedFrame, answer: FrameRecovery | Exception) -> None:
        for text in (f"warning: {frame.warning}" if frame.warning else "", frame.notes):
            if text and text not in self._said:
                console.complain(f"{file}: {text}")
            if text:
                self._said.setdefault(text, set()).add(file)
        if isinstance(answer, (ValueError, ArithmeticError, workers.WorkerLostError)):  # such as a camera of no image
            raise FrameError(f"{file}: {frame.name}: {answer}") from answer
        if isinstance(answer, Exception):
            raise answer
        least = self._options.min_score
        wanted = tuple(body for body in answer.bodies if body.status == Status.FAILED or body.score >= least)
        message = answer.message
        if len(wanted) < len(answer.bodies) and not message:
            message = f"{_count(len(answer.bodies) - len(wanted), 'body', 'bodies')} with a lower score left out"
        recovery = replace(answer, bodies=wanted, message=message)
        tracks = self._tracks.follow(file, frame, recovery) if self._tracks else None
        entry = result_json.frame_entry(file, frame, recovery, tracks)
        self.outputs.add(frame, recovery, tracks, entry)


def _count(number: int, singular: str, many: str | None = None) -> str:
    return f"{number} {singular if number == 1 else many or singular + 's'}"


def _progress(recorded: RecordedInput) -> Iterator[tuple[str, Any]]:
    """Yield the frames, with a bar on a terminal if there are several."""
    with console.progress() as bar:
        task = bar.add_task("recovering", total=recorded.total, visible=recorded.total > 1)
        for pair in recorded:
            bar.update(task, total=recorded.total, visible=recorded.total > 1)
            yield pair
            bar.advance(task)
