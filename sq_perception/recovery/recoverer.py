"""Depth image and camera in, superquadrics out: the one place that chains the stages.

    depth -> segmentation -> canonical view of each object -> network -> inverse of the view -> fit -> score

:class:`~sq_perception.recovery.still_scene.StillScene` puts the reuse of a frame's answers for the next one around it.

With ``auto``, own segments are parted, joined, dropped where they show no object, and rid of outliers by a network
(:mod:`sq_perception.recovery.own_segments`).

| method | body |
| --- | --- |
| auto | fit with a network's help: of things to the predicted hull, else from the starts of central symmetry too |
| symmetry | fit from the starts of central symmetry, no network |
| network | the network alone |
| classic | Solina and Bajcsy's fit to the points |

Hulls are predicted before the fits; bodies are predicted only where the first, cheapest starts leave more than noise.

Everything is metres in the optical frame.  A hard image is no error: an object without a body is listed with
``Status.FAILED``, score 0 and, in place of a body, an ellipsoid around its visible points.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias, TypeVar

import numpy as np

from sq_perception.fitting import surface_fit
from sq_perception.fitting.fit import Fit, Parts, Status
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.threads import one_blas_thread, short_turns
from sq_perception.imaging import hole_filling, raycast
from sq_perception.imaging.camera import Camera
from sq_perception.learning import checkpoint, inference
from sq_perception.recovery import methods, parts, seen_object, supports
from sq_perception.recovery.cavities import find_cavity
from sq_perception.recovery.options import NEEDS_NETWORK, Method, RecoveryOptions
from sq_perception.recovery.own_segments import SegmentNetwork
from sq_perception.recovery.readings import Readings, read
from sq_perception.recovery.recovery import FrameRecovery, Recovery, render_recovery, timed, what_is_left_out
from sq_perception.recovery.seen_object import Prediction, SeenObject
from sq_perception.segmentation import objectness, segments
from sq_perception.segmentation.evidence import FrameEvidence

__all__ = [
    "FrameRecovery",
    "Method",
    "Recoverer",
    "Recovery",
    "RecoveryOptions",
    "render_recovery",
]

_Item = TypeVar("_Item")
_Answer = TypeVar("_Answer")
Network: TypeAlias = inference.Predictor | inference.ThingPredictor


@dataclass(frozen=True, eq=False)
class Found:
    """The objects of one image, the one with most pixels first; ``depth`` lacks readings of those out of range."""

    segmentation: FrameEvidence
    depth: np.ndarray
    objects: list[SeenObject]


class Recoverer:
    """Holds the network; one frame at a time.

    Parameters
    ----------
    model
        Weights file; None: the ones that ship with the package, ``things`` for what ``auto`` fits to images of pinhole
        cameras, as it predicts hulls with their uncertainty, and ``robust``, which predicts bodies, for all else.
    device
        Where the network computes: "cpu", "cuda" ...
    method
        What :meth:`recover` does unless its options say otherwise.  "symmetry" and "classic" load no network; if a
        later call asks for one, it is loaded then.
    threads
        How many objects of a frame are worked on at the same time; None: as many as this process has cores.

    Raises
    ------
    CheckpointError
        If the method needs the network and the file is missing or wrong.
    ValueError
        For an unknown method, a device that this machine does not have, or less than one thread.
    TypeError
        For a model that is neither a path nor a name, such as options, which :meth:`recover` takes.
    """

    def __init__(
        self, model: Path | str | None = None, device: str = "cpu", method: Method = "auto", threads: int | None = None,
    ) -> None:
        if not isinstance(model, str | Path | None):
            given = type(model).__name__
            raise TypeError(f"model: expected a file of weights or its name, got {given}; recover takes options")
        if threads is not None and threads < 1:
            raise ValueError(f"threads: expected at least 1, got {threads}")
        self._threads = threads or len(os.sched_getaffinity(0))
        self._options = RecoveryOptions(method=method)
        self._path = model
        self._device = inference.check_device(device)
        self._loaded: dict[bool, Network] = {}
        self._masks = inference.load_masks()
        self._begin()
        if method in NEEDS_NETWORK:
            self._load_network(method == "auto")

    def _begin(self) -> None:
        """Make the threads and the lock of this process."""
        self._process = os.getpid()
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(self._threads, thread_name_prefix="fit")

    def warm_up(self, camera: Camera) -> None:
        """Compile or load every kernel and run the whole chain once on an image of the camera's size."""
        surface_fit.warm_up()
        segments.warm_up()
        depth = 1.0 if camera.is_pinhole else 0.5
        reach = 0.15 * min(camera.width / camera.fx, camera.height / camera.fy)
        centre = camera.unproject(np.array(camera.width / 2), np.array(camera.height / 2), np.array(depth))
        body = Superquadric(
            reach * np.array([1.0, 0.8, 0.6]), np.array([0.5, 0.7]), centre, np.array([0.3, 0.2, 0.1, 1.0])
        )
        rendered, index = raycast.render(body, camera)
        image = np.where(np.isfinite(rendered), rendered, np.nan).astype(np.float32)
        self.recover(image, camera, (index >= 0).astype(np.int32))
        self.recover(image, camera)
        self.read(np.ones_like(image), camera).doubt()  # of a wall, which spans enough of the image
        image[::2] = np.nan
        hole_filling.fill(image)

    def recover(
        self, depth: np.ndarray, camera: Camera, labels: np.ndarray | None = None,
        options: RecoveryOptions | None = None,
    ) -> FrameRecovery:
        """Recover every object of a depth image.

        Parameters
        ----------
        depth : float (height, width)
            Metres in the optical frame; NaN, inf, masked, less than 0, of a pinhole camera 0 too: nothing measured.
        camera : Camera
        labels : integer (height, width), optional
            Instance masks, 0 for background; without them the image is segmented.
        options
            Defaults with the method given to the constructor.

        Raises
        ------
        ValueError
            For images that do not fit the camera or have the wrong type.  No depth *value* raises.
        CheckpointError
            If the method needs the network and it cannot be loaded.
        """
        readings = self.read(depth, camera, labels, options)
        return self.recover_objects(readings, self.find_objects(readings))

    def read(
        self, depth: np.ndarray, camera: Camera, labels: np.ndarray | None = None,
        options: RecoveryOptions | None = None,
    ) -> Readings:
        """Check an image and fill its small holes; parameters as in :meth:`recover`."""
        return read(depth, camera, labels, options or self._options)

    def find_objects(self, readings: Readings, segmentation: FrameEvidence | None = None) -> Found:
        """Segment an image; or take the segmentation of one that shows the same objects at the same pixels."""
        with self._at_work():
            found = self._segment(readings) if segmentation is None else segmentation
            depth = readings.within_range(found.labels)
            return Found(found, depth, seen_object.objects(depth, found, readings.camera))

    def recover_objects(
        self, readings: Readings, found: Found, known: Mapping[int, Recovery] | None = None
    ) -> FrameRecovery:
        """Recover the objects of an image but those whose bodies are known, by label."""
        bodies = dict(known or {})
        milliseconds = {"segmentation": 1e3 * (time.perf_counter() - readings.began)}
        with self._at_work():
            with timed(milliseconds, "network"):
                fresh = self._prepare([obj for obj in found.objects if obj.label not in bodies], readings, found)
            with timed(milliseconds, "fit"):
                fresh, fits, made_of = self._fit(fresh, readings, found)
            with timed(milliseconds, "score"):
                scores = self._mapped(lambda k: methods.score(fresh[k], fits[k], readings.options), range(len(fresh)))
        evidence = found.segmentation
        likely, fragments, fewest = evidence.objectness_by_label(), [], segments.least_pixels(evidence.labels.size)
        shown = {label: body.fit for label, body in bodies.items()}
        shown |= {obj.label: fit for obj, fit in zip(fresh, fits, strict=True)}
        for obj, fit, score, some in zip(fresh, fits, scores, made_of, strict=True):
            thing = likely[obj.label]
            if evidence.membership is not None and fit.status != Status.FAILED:
                same, before = evidence.affinities(obj.label), [o for o in found.objects if o.pixels > obj.pixels]
                larger = [(same.get(other.label, 0.0), shown[other.label]) for other in before]
                thing = methods.judge(thing, fit, obj.pixels / fewest, larger)
                if thing < objectness.LEAST_POSTERIOR:
                    fragments.append(obj.label)
                    continue
            cavity = find_cavity(obj, (fit,) if some is None else some.fits) if readings.options.parts else None
            bodies[obj.label] = Recovery(fit, score, obj.label, obj.pixels, thing, parts=some, cavity=cavity)
        recovered = tuple(bodies[obj.label] for obj in found.objects if obj.label in bodies)
        labels = evidence.labels
        if fragments:
            labels = np.where(np.isin(labels, fragments), np.int32(0), labels)
        doubt = readings.doubt()
        said = what_is_left_out(readings, evidence, len(recovered), len(fragments))
        message = "; ".join(filter(None, (*said, doubt)))
        milliseconds["total"] = 1e3 * (time.perf_counter() - readings.began)
        return FrameRecovery(recovered, milliseconds, labels, evidence.plane, message, doubt)

    def _prepare(self, objects: Sequence[SeenObject], readings: Readings, found: Found) -> list[SeenObject]:
        """Find out what some objects stand on, and what the network predicts of them."""
        depth, camera, evidence = found.depth, readings.camera, found.segmentation
        network = self._network_for(readings)
        config = None if network is None else network.config

        def prepare(obj: SeenObject) -> SeenObject:
            plane = supports.support(obj, found.objects, depth, camera, evidence, readings.options)
            obj = replace(obj, plane=plane)
            if readings.labels is not None:
                obj = seen_object.complete(obj, depth, camera, evidence.labels)
            return seen_object.add_views(obj, depth, camera, config)

        prepared = self._mapped(prepare, objects)
        return prepared if network is None else self._predict(prepared, network, readings.options)

    def _fit(
        self, objects: list[SeenObject], readings: Readings, found: Found
    ) -> tuple[list[SeenObject], list[Fit], list[Parts | None]]:
        """Fit the bodies of some objects, and their parts; the objects are returned without filled readings."""
        depth, camera, options = found.depth, readings.camera, readings.options
        if readings.filled is not None:  # what stands in for readings is none to a fit
            depth = np.where(readings.filled, np.float32(np.nan), depth)
            objects = [obj.of_readings(depth, readings.filled, found.segmentation.labels) for obj in objects]
        deadline = readings.began + options.time_budget
        fits = self._mapped(lambda obj: methods.fit_view(obj, depth, camera, options, deadline), objects)
        for k, obj in enumerate(objects):
            same = found.segmentation.affinities(obj.label)
            others = [(q, other) for other in found.objects if (q := same.get(other.label, 0.0)) > 0.1]
            fits[k] = methods.widen(fits[k], others)
        return objects, fits, self._find_parts(objects, fits, depth, readings, deadline)

    @contextmanager
    def _at_work(self) -> Iterator[None]:
        """Threads of this process, and a BLAS that starts none of its own."""
        if self._process != os.getpid():  # forked: threads stay behind, and who waits for them waits for ever
            self._begin()
        with one_blas_thread():
            yield

    def _segment(self, readings: Readings) -> FrameEvidence:
        """The given masks, or own segments, which the network of masks improves."""
        depth, camera, options = readings.depth, readings.camera, readings.options
        if readings.labels is not None:
            return segments.from_labels(readings.labels, depth, camera, options)
        proposed = segments.propose(depth, camera, options.depth_range)
        if options.repair and camera.is_pinhole:
            network = SegmentNetwork(self._masks, depth, camera, proposed.plane, self._shared, options.max_size)
            return segments.limit(network.improve(proposed), depth, camera, options)
        return segments.limit(segments.judge(proposed), depth, camera, options)

    def _network_for(self, readings: Readings) -> Network | None:
        if readings.options.method not in NEEDS_NETWORK:
            return None
        return self._load_network(readings.camera.is_pinhole and readings.options.method == "auto")

    def _predict(
        self, objects: Sequence[SeenObject], network: Network, options: RecoveryOptions, mirror: bool = True
    ) -> list[SeenObject]:
        """The objects with their predictions; with ``auto``, bodies are predicted only once a fit asks for one."""
        views = [obj.shown for obj in objects if obj.shown is not None]
        if not views:
            return list(objects)
        if isinstance(network, inference.ThingPredictor):

            def of_some(some: Sequence[int]) -> list[Prediction]:
                planes = [objects[k].plane for k in some]
                return seen_object.predict_hulls([views[k] for k in some], planes, network, mirror)

            found = self._shared(of_some, range(len(views)))
        else:
            found = seen_object.predict_bodies(views, network, when_asked=options.method == "auto")
        return [replace(obj, prediction=predicted) for obj, predicted in zip(objects, found, strict=True)]

    def _find_parts(
        self, objects: Sequence[SeenObject], fits: Sequence[Fit], depth: np.ndarray, readings: Readings,
        deadline: float,
    ) -> list[Parts | None]:
        """Find the parts of each object; None where one body explains it, or parts are not asked for."""
        camera, options = readings.camera, readings.options
        if not options.parts or options.method not in ("auto", "symmetry"):
            return [None] * len(objects)
        network = self._network_for(readings)
        config = None if network is None else network.config
        searches = self._mapped(lambda k: parts.Search(objects[k], fits[k], depth, camera), range(len(objects)))
        divided = self._mapped(parts.Search.next_pieces, searches)
        while any(divided) and time.perf_counter() < deadline:
            pieces = [piece for some in divided for piece in some]
            pieces = self._mapped(lambda each: seen_object.add_views(each, depth, camera, config), pieces)
            if network is not None:
                pieces = self._predict(pieces, network, options, mirror=False)
            found = iter(self._mapped(lambda each: methods.fit_view(each, depth, camera, options, deadline), pieces))
            for search, some in zip(searches, divided, strict=True):
                if some:
                    search.judge([next(found) for _ in some])
            divided = self._mapped(parts.Search.next_pieces, searches)
        return [search.parts for search in searches]

    def _mapped(self, function: Callable[[_Item], _Answer], items: Sequence[_Item]) -> list[_Answer]:
        """The function of each item; several at a time in threads that stay, as new ones cost memory and time."""
        if len(items) < 2 or self._threads < 2:
            return [function(item) for item in items]
        with short_turns():
            return list(self._pool.map(function, items))

    def _shared(self, function: Callable[[Sequence[int]], list[_Answer]], items: Sequence[int]) -> list[_Answer]:
        """The function's answers to all items; each thread calls it once, with a share of them."""
        share = -(-len(items) // self._threads)
        parts = [items[first : first + share] for first in range(0, len(items), share)] if items else []
        return [answer for part in self._mapped(function, parts) for answer in part]

    def _load_network(self, of_things: bool) -> Network:
        """The network that predicts hulls, or the one that predicts bodies; if a file was named, its network."""
        with self._lock:
            if of_things not in self._loaded:
                kinds = (of_things,) if self._path is None else (True, False)
                is_hull = (self._path is None and of_things) or checkpoint.predicts_hulls(self._path)
                network = (inference.load_things if is_hull else inference.load)(self._path, self._device)
                self._loaded.update(dict.fromkeys(kinds, network))
            return self._loaded[of_things]
