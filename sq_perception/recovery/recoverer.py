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
from sq_perception.imaging import depth_units, hole_filling, ranges, raycast
from sq_perception.imaging.camera import GREATEST_DEPTH, LEAST_DEPTH, Camera
from sq_perception.learning import checkpoint, inference
from sq_perception.learning.forward import CompactMasks
from sq_perception.recovery import methods, parts, seen_object, supports
from sq_perception.recovery.cavities import find_cavity
from sq_perception.recovery.options import NEEDS_NETWORK, Method, RecoveryOptions
from sq_perception.recovery.own_segments import SegmentNetwork
from sq_perception.recovery.recovery import FrameRecovery, Recovery
from sq_perception.recovery.seen_object import Prediction, SeenObject
from sq_perception.segmentation import segments
from sq_perception.segmentation.evidence import FrameEvidence
from sq_perception.segmentation.objectness import LEAST_OF_ITS_OWN, of_its_own

__all__ = [
    "FrameRecovery",
    "Method",
    "Recoverer",
    "Recovery",
    "RecoveryOptions",
    "render_recovery",
]

_DOUBT = 0.1
"""Probability that two objects are one, from which on it counts."""
_Item = TypeVar("_Item")
_Answer = TypeVar("_Answer")
Network: TypeAlias = inference.Predictor | inference.ThingPredictor


@dataclass(frozen=True, eq=False)
class Readings:
    """One image to recover from.

    Attributes
    ----------
    depth : float32 (height, width)
        Metres, NaN where nothing was measured; small holes of it are filled.
    closed : bool (height, width) or None
        The filled pixels: segments and views take them, fits do not.
    labels : integer (height, width) or None
        Masks from outside.
    began
        When work on it began, by :func:`time.perf_counter`.
    """

    depth: np.ndarray
    closed: np.ndarray | None
    camera: Camera
    labels: np.ndarray | None
    options: RecoveryOptions
    began: float


@dataclass(frozen=True, eq=False)
class Found:
    """The objects of one image.

    Attributes
    ----------
    segmentation
        What they were found by.
    depth : float32 (height, width)
        The image without readings of objects that are out of range.
    objects
        The one with most pixels first.
    """

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
        self._masks: CompactMasks | None = None
        self._begin()
        if method in NEEDS_NETWORK:
            self._load_network(method == "auto")
        if method == "auto":
            self._load_masks()

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
        _doubt(np.ones_like(image), camera)  # of a wall, which spans enough of the image
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
        """Check an image, parameters as in :meth:`recover`, and fill its small holes."""
        began = time.perf_counter()
        measured = _measure(camera.readings(depth), camera)
        labels = None if labels is None else _masks(labels, measured)
        measured, labels, closed = hole_filling.fill(measured, labels)
        return Readings(measured, closed, camera, labels, options or self._options, began)

    def find_objects(self, readings: Readings, segmentation: FrameEvidence | None = None) -> Found:
        """Segment an image; or take the segmentation of one that shows the same objects at the same pixels."""
        with self._at_work():
            found = self._segment(readings) if segmentation is None else segmentation
            depth = _in_range(readings.depth, found.labels, readings.options.depth_range)
            return Found(found, depth, seen_object.objects(depth, found, readings.camera))

    def recover_objects(
        self, readings: Readings, found: Found, known: Mapping[int, Recovery] | None = None
    ) -> FrameRecovery:
        """Recover the objects of an image but those whose bodies are known, by label."""
        known = known or {}
        segmented = time.perf_counter()
        camera, options, depth = readings.camera, readings.options, found.depth
        with self._at_work():
            network = self._network_for(readings)
            config = None if network is None else network.config
            objects = found.objects
            if found.segmentation.membership is not None:
                outliers = found.segmentation.outliers
                objects = [obj.without(outliers) for obj in objects]

            def prepare(obj: SeenObject) -> SeenObject:
                plane = supports.support(obj, objects, depth, camera, found.segmentation, options)
                obj = replace(obj, plane=plane)
                if readings.labels is not None:
                    obj = seen_object.completed(obj, depth, camera, found.segmentation.labels)
                return seen_object.viewed(obj, depth, camera, config)

            fresh = self._mapped(prepare, [obj for obj in objects if obj.label not in known])
            if network is not None:
                fresh = self._predict(fresh, network, options)
            predicted = time.perf_counter()

            if readings.closed is not None:  # what stands in for readings is none to a fit
                depth = np.where(readings.closed, np.float32(np.nan), depth)
                fresh = [obj.of_readings(depth, readings.closed, found.segmentation.labels) for obj in fresh]
            deadline = readings.began + options.time_budget
            fits = self._mapped(lambda obj: methods.fit_view(obj, depth, camera, options, deadline), fresh)
            fits = _doubted(fits, fresh, objects, found.segmentation)
            made_of = self._find_parts(fresh, fits, depth, readings, network, deadline)
            fitted = time.perf_counter()

            cavities = [
                find_cavity(obj, (fit,) if some is None else some.fits) if options.parts else None
                for obj, fit, some in zip(fresh, fits, made_of, strict=True)
            ]
            scores = self._mapped(lambda k: methods.score(fresh[k], fits[k], options), range(len(fresh)))
        segmentation = found.segmentation
        likely, same = segmentation.likely(), segmentation.same_as_larger()
        recovered = dict(known)
        fragments = []
        for obj, fit, score, some, cavity in zip(fresh, fits, scores, made_of, cavities, strict=True):
            is_judged = obj.label in same and fit.status != Status.FAILED
            own = of_its_own(same[obj.label], score) if is_judged else 1.0
            if own < LEAST_OF_ITS_OWN:
                fragments.append(obj.label)
            else:
                thing = min(own, likely[obj.label])
                recovered[obj.label] = Recovery(fit, score, obj.label, obj.pixels, thing, parts=some, cavity=cavity)
        bodies = tuple(recovered[obj.label] for obj in found.objects if obj.label in recovered)
        labels = segmentation.labels
        if fragments:
            labels = np.where(np.isin(labels, fragments), np.int32(0), labels)
        scored = time.perf_counter()
        milliseconds = {
            "segmentation": 1e3 * (segmented - readings.began),
            "network": 1e3 * (predicted - segmented),
            "fit": 1e3 * (fitted - predicted),
            "score": 1e3 * (scored - fitted),
            "total": 1e3 * (scored - readings.began),
        }
        doubt = _doubt(readings.depth, camera)
        said = (
            _without_support(segmentation, readings) if bodies else _why_empty(depth, segmentation, readings.labels),
            _left_out(segmentation, options),
            doubt,
        )
        message = "; ".join(filter(None, said))
        return FrameRecovery(bodies, milliseconds, labels, segmentation.plane, message, doubt)

    @contextmanager
    def _at_work(self) -> Iterator[None]:
        """Threads of this process, and a BLAS that starts none of its own."""
        if self._process != os.getpid():  # forked: threads stay behind, and who waits for them waits for ever
            self._begin()
        with one_blas_thread():
            yield

    def _segment(self, readings: Readings) -> FrameEvidence:
        """The objects of an image: the given masks, or its own segments, which the network of masks improves where
        the network predicts hulls."""
        depth, camera, options = readings.depth, readings.camera, readings.options
        if readings.labels is not None:
            return segments.from_labels(readings.labels, depth, camera, options)
        proposed = segments.proposed(depth, camera, options.depth_range)
        if options.repair and isinstance(self._network_for(readings), inference.ThingPredictor):
            network = SegmentNetwork(self._load_masks(), depth, camera, proposed.plane, self._shared, options.max_size)
            return segments.limited(network.improved(proposed), depth, camera, options)
        return segments.limited(segments.judged(proposed), depth, camera, options)

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
        network: Network | None, deadline: float,
    ) -> list[Parts | None]:
        """Find the parts of each object; None where one body explains it, or parts are not asked for."""
        camera, options = readings.camera, readings.options
        if not options.parts or options.method not in ("auto", "symmetry"):
            return [None] * len(objects)
        config = None if network is None else network.config
        searches = self._mapped(lambda k: parts.Search(objects[k], fits[k], depth, camera), range(len(objects)))
        divided = self._mapped(parts.Search.next_pieces, searches)
        while any(divided) and time.perf_counter() < deadline:
            pieces = [piece for some in divided for piece in some]
            pieces = self._mapped(lambda each: seen_object.viewed(each, depth, camera, config), pieces)
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
        """The function's answers to all items; each thread calls it once, with a share of them, as a network computes
        on one thread."""
        share = -(-len(items) // self._threads)
        parts = [items[first : first + share] for first in range(0, len(items), share)] if items else []
        return [answer for part in self._mapped(function, parts) for answer in part]

    def _load_network(self, of_things: bool) -> Network:
        """The network that predicts hulls, or the one that predicts bodies; if a file was named, its network."""
        with self._lock:
            if of_things not in self._loaded:
                kinds = (of_things,) if self._path is None else (True, False)
                self._loaded.update(dict.fromkeys(kinds, self._read_network(of_things)))
            return self._loaded[of_things]

    def _load_masks(self) -> CompactMasks:
        with self._lock:
            if self._masks is None:
                self._masks = inference.load_masks()
            return self._masks

    def _read_network(self, of_things: bool) -> Network:
        if (self._path is None and of_things) or checkpoint.predicts_hulls(self._path):
            return inference.load_things(self._path, self._device)
        return inference.load(self._path, self._device)


def render_recovery(frame: FrameRecovery, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """What the recovered bodies, or their parts, would look like to the camera.

    Returns
    -------
    depth : float64 (height, width)
        +inf where there is no body.
    index : int32 (height, width)
        Position in ``frame.bodies``, -1 where there is none; failed bodies are not drawn.
    """
    shown = [(k, solid) for k, body in enumerate(frame.bodies) if body.status != Status.FAILED for solid in body.solids]
    depth, index = raycast.render(Superquadric.stack([solid for _, solid in shown]), camera)
    return depth, np.append(np.array([k for k, _ in shown], dtype=np.int32), np.int32(-1))[index]


def _measure(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """float32, NaN for all that is no measurement; row by row, as kernels are compiled for arrays of a kind."""
    farthest = min(GREATEST_DEPTH, float(np.finfo(depth.dtype).max))  # which half precision does not reach
    within = (depth >= (LEAST_DEPTH if camera.is_pinhole else 0)) & (depth <= farthest)
    return np.ascontiguousarray(np.where(within, depth, np.nan), dtype=np.float32)


def _masks(labels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Given masks, row by row, 0 where they are masked; ValueError if they are not of the shape of the depth."""
    labels = np.asarray(np.ma.filled(labels, 0), order="C")
    if labels.shape != depth.shape:
        raise ValueError(f"labels: expected the shape of the depth, {depth.shape}, got {labels.shape}")
    return labels


def _in_range(depth: np.ndarray, labels: np.ndarray, depth_range: tuple[float, float]) -> np.ndarray:
    """The image without an object's own readings out of range: left in, they would pass for free space beside it."""
    near, far = depth_range
    if near <= 0 and np.isinf(far):
        return depth
    out = (labels > 0) & ((depth < near) | (depth > far))
    return np.where(out, np.float32(np.nan), depth)


def _doubt(depth: np.ndarray, camera: Camera) -> str:
    """What makes all of an image's bodies doubtful; empty otherwise."""
    if not camera.is_pinhole:
        return ""
    return depth_units.wrong_unit(depth) or (ranges.RANGES if ranges.seem_ranges(depth, camera) else "")


def _doubted(
    fits: Sequence[Fit], fresh: Sequence[SeenObject], objects: Sequence[SeenObject], found: FrameEvidence
) -> list[Fit]:
    """The fits of objects, less sure where another object of the frame may be a part of theirs."""
    if found.same is None:
        return list(fits)
    same = dict(zip(found.ids, found.same.tolist(), strict=True))
    number = {label: k for k, label in enumerate(found.ids)}
    return [
        methods.widened(fit, [(q, other) for other in objects if (q := same[obj.label][number[other.label]]) > _DOUBT])
        for fit, obj in zip(fits, fresh, strict=True)
    ]


def _left_out(found: FrameEvidence, options: RecoveryOptions) -> str:
    """What was seen and is not among the objects, in words."""
    said = []
    if found.larger:
        objects = "1 object is" if found.larger == 1 else f"{found.larger} objects are"
        said.append(f"{objects} larger than max_size = {options.max_size:g} m and left out")
    if found.outside:
        said.append(f"{found.outside} outside of the workspace left out")
    if found.is_cut:
        said.append(f"there are more objects than max_objects = {options.max_objects}: smaller ones are left out")
    return "; ".join(said)


def _why_empty(depth: np.ndarray, found: FrameEvidence, labels: np.ndarray | None) -> str:
    if not np.isfinite(depth).any():
        return "the image holds no depth"
    if labels is not None and labels.max() <= 0:
        return "the masks hold no object"
    if found.larger or found.outside:
        return "no object of the wanted size and place"
    if found.plane is not None:
        return "nothing stands on the plane"
    return "no support plane and no object found"


def _without_support(found: FrameEvidence, readings: Readings) -> str:
    is_own = readings.labels is None and readings.camera.is_pinhole
    return "no support plane found" if is_own and found.plane is None else ""
