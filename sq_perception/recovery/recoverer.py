"""Depth image and camera in, superquadrics out: the one place that chains the stages.

    depth -> segmentation -> canonical view of each object -> network -> inverse of the view -> fit -> repair -> score

Own segments are joined and split by the bodies that were fitted to them (:mod:`sq_perception.recovery.segment_repair`).

| method | body | refine |
| --- | --- | --- |
| auto | fit from the starts of central symmetry and, where needed, the network; open sizes predicted | all |
| symmetry | fit from the starts of central symmetry, no network | surface, soft_render |
| network | the network alone | ignored |
| classic | Solina and Bajcsy's fit to the points | ignored |

``refine="surface"`` is the exact surface fit.  ``"soft_render"`` descends on the soft-rendered depth (L_DR) instead,
from the network's prediction for ``auto`` and after the fit for ``symmetry``.  ``"none"`` leaves the network's
prediction as it is; ``symmetry`` has no body without its fit and ignores it.

With ``auto`` and ``surface`` the network computes beside the fit's first, cheapest starts.  A body that these explain
down to the noise needs no prediction and does not wait for it.

Everything is metres in the optical frame.  A hard image is no error: an object without a body is listed with
``Status.FAILED``, score 0 and, in place of a body, an ellipsoid around its visible points.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeVar, get_args

import numpy as np
import torch
from threadpoolctl import ThreadpoolController

from sq_perception.fitting import soft_render_fit, solina_bajcsy, surface_fit
from sq_perception.fitting.fit import Fit, Status
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import canonical_view, raycast, soft_render
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.canonical_view import CanonicalView
from sq_perception.learning import checkpoint, inference
from sq_perception.learning.consensus import Consensus
from sq_perception.recovery import seen_object, segment_repair
from sq_perception.recovery.seen_object import SeenObject
from sq_perception.segmentation import convex_parts, segments

_Item = TypeVar("_Item")
_Answer = TypeVar("_Answer")
Method = Literal["auto", "network", "symmetry", "classic"]
Refine = Literal["surface", "soft_render", "none"]

_VIEW_PIXELS = 64
_SCORE_STRIDE = 3
"""22 x 22 lines of sight of 64 voxels: few enough for torch not to spread them over threads, which would cost more."""
_FEWEST_PIXELS = 12
_NEAREST, _FARTHEST = 1e-4, 1e5
"""Metres; no sensor measures beyond, and numbers beyond make squares and products that are none."""
_LEAST_BUDGET = 1e-6
"""Seconds; an object whose turn comes too late is still fitted, from one start."""
_UNKNOWN = np.full((11, 11), np.nan)
_UNSEEN = np.full(3, np.nan)
_NEEDS_NETWORK = ("auto", "network")
_FITTED = ("auto", "symmetry")
_HARD_IMAGE = (ValueError, ArithmeticError, np.linalg.LinAlgError)
"""What numerical code may raise on degenerate data: reported with the object, never raised."""


@dataclass(frozen=True)
class RecoveryOptions:
    """What may change from one frame to the next.

    Attributes
    ----------
    method, refine
        See the module.
    sharpness, tau
        s and tau of the soft renderer: of the score, and of the ``soft_render`` refinement.
    depth_range
        Nearest and farthest depth of an object, metres.
    max_objects
        The largest ones are recovered.
    min_pixels
        Smaller objects are ignored; None: 0.05 % of the image for own masks, any size for masks from outside.
    max_size
        Largest full edge of an object, metres: walls, furniture and tables are larger.  Masks from outside may be, too.
    workspace
        The middle of what is seen of an object lies in this box of the optical frame, metres: least x, y, z and
        greatest x, y, z; None: anywhere.
    use_plane
        Let the fit know the support plane.
    time_budget
        Seconds per frame after which the surface fit tries no further start for any object, and the repair of segments
        begins no further fit.  The objects with most pixels, large or near, come first.
    repair
        Join and split own segments where that describes the image in fewer words; masks from outside stay as they are.

    Raises
    ------
    ValueError
        For a value outside its range.
    """

    method: Method = "auto"
    refine: Refine = "surface"
    sharpness: float = soft_render.THESIS_SHARPNESS
    tau: float = soft_render.THESIS_TAU
    depth_range: tuple[float, float] = (0.0, np.inf)
    max_objects: int = 20
    min_pixels: int | None = None
    max_size: float = 0.6
    workspace: tuple[float, float, float, float, float, float] | None = None
    use_plane: bool = True
    time_budget: float = np.inf
    repair: bool = True

    def __post_init__(self) -> None:
        for name, value, known in (("method", self.method, Method), ("refine", self.refine, Refine)):
            if value not in get_args(known):
                raise ValueError(f"{name}: expected one of {', '.join(get_args(known))}, got {value!r}")
        for name, number in (("sharpness", self.sharpness), ("tau", self.tau)):
            if not (np.isfinite(number) and number > 0):
                raise ValueError(f"{name}: expected a positive number, got {number}")
        if not self.time_budget > 0:
            raise ValueError(f"time_budget: expected a positive number of seconds, got {self.time_budget}")
        if self.min_pixels is not None and self.min_pixels < 1:
            raise ValueError(f"min_pixels: expected at least 1, got {self.min_pixels}")
        self.segmentation_options()

    def segmentation_options(self) -> segments.SegmentationOptions:
        return segments.SegmentationOptions(
            depth_range=self.depth_range,
            max_objects=self.max_objects,
            min_pixels=self.min_pixels,
            max_size=self.max_size,
            workspace=self.workspace,
        )


@dataclass(frozen=True, eq=False)
class Recovery:
    """One recovered object.

    Attributes
    ----------
    superquadric : Superquadric
        A single body in the optical frame, in its canonical form.
    score : float
        Agreement of the soft-rendered body with the canonical view, 0 to 1 (:func:`soft_render.agreement`).
    residual : float
        Root mean square distance of the object's points to the surface, metres; NaN where there is no body.
    sigma_size : (3,)
        Standard deviations of the half sizes, metres; NaN for methods that do not compute them.
    status, message
        The verdict and the reason for it.
    label : int
        The object's value in the label image.
    pixels : int
        Measured pixels of the object.
    covariance : (11, 11)
        Of a1 a2 a3 e1 e2 t1 t2 t3 and the rotation vector in the object frame, metres and radians, as in
        :class:`~sq_perception.fitting.fit.Fit`; NaN for methods that do not compute it.
    seen : (3,)
        Share of each size that was seen, as in :class:`~sq_perception.fitting.fit.Fit`; the rest is inferred.
    """

    superquadric: Superquadric
    score: float
    residual: float
    sigma_size: np.ndarray
    status: Status
    message: str
    label: int
    pixels: int
    covariance: np.ndarray = field(default_factory=_UNKNOWN.copy)
    seen: np.ndarray = field(default_factory=_UNSEEN.copy)


@dataclass(frozen=True, eq=False)
class FrameRecovery:
    """All objects of one frame.

    Attributes
    ----------
    bodies
        One entry per object, the one with most pixels first, failed ones among them.
    milliseconds
        By stage: segmentation, network, fit, repair, score, total.
    labels : int32 (height, width)
        The masks that were used.
    plane : (4,) or None
        Support plane, height above it = n.p + d.
    message
        Why there are no objects; empty otherwise.
    """

    bodies: tuple[Recovery, ...]
    milliseconds: dict[str, float]
    labels: np.ndarray
    plane: np.ndarray | None
    message: str

    @property
    def recovered(self) -> tuple[Recovery, ...]:
        """The bodies that did not fail."""
        return tuple(body for body in self.bodies if body.status != Status.FAILED)


class Recoverer:
    """Holds the network; one frame at a time.

    Parameters
    ----------
    model
        Weights file; None: the ones that ship with the package.
    device
        Of the network: "cpu", "cuda" ...
    consensus
        Ask the network about each view in 8 positions and average its answers: 1 % better alone, and as slow as 8 views
        (:mod:`sq_perception.learning.consensus`).
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
    """

    def __init__(
        self,
        model: Path | str | None = None,
        device: str = "cpu",
        method: Method = "auto",
        consensus: bool = False,
        threads: int | None = None,
    ) -> None:
        if threads is not None and threads < 1:
            raise ValueError(f"threads: expected at least 1, got {threads}")
        self._threads = threads or len(os.sched_getaffinity(0))
        self._options = RecoveryOptions(method=method)
        self._path = model
        self._device = checked_device(device)
        self._consensus = consensus
        self._network: inference.Predictor | None = None
        self._lock = threading.Lock()
        self._blas = ThreadpoolController()
        self._beside = ThreadPoolExecutor(1, thread_name_prefix="network")
        self._pool = ThreadPoolExecutor(self._threads, thread_name_prefix="fit")
        if method in _NEEDS_NETWORK:
            self._load_network()

    def warm_up(self, camera: Camera) -> None:
        """Compile or load every kernel and run the whole chain once on an image of the camera's size."""
        surface_fit.warm_up()
        convex_parts.warm_up()
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

    def recover(
        self,
        depth: np.ndarray,
        camera: Camera,
        labels: np.ndarray | None = None,
        options: RecoveryOptions | None = None,
    ) -> FrameRecovery:
        """Recover every object of a depth image.

        Parameters
        ----------
        depth : float (height, width)
            Metres in the optical frame; NaN, inf, and for a pinhole camera 0 and less: nothing measured.
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
        # Threads of a BLAS spin after products as small as these, on the cores that fits of other objects want.
        with self._blas.limit(limits=1, user_api="blas"):
            return self._recover(depth, camera, labels, options or self._options)

    def _recover(
        self, depth: np.ndarray, camera: Camera, labels: np.ndarray | None, options: RecoveryOptions
    ) -> FrameRecovery:
        started = time.perf_counter()
        milliseconds = dict.fromkeys(("segmentation", "network", "fit", "repair", "score", "total"), 0.0)
        network = self._load_network() if options.method in _NEEDS_NETWORK else None

        with _timed(milliseconds, "segmentation"):
            depth = _plausible(np.asarray(depth), camera)
            if labels is None:
                found = segments.segment(depth, camera, options.segmentation_options())
            else:
                found = segments.from_labels(labels, depth, camera, options.segmentation_options())
            depth = _cleaned(depth, camera)
            objects = seen_object.objects(depth, found, camera, options.depth_range)

        with _timed(milliseconds, "network"):
            self._mapped(lambda one: _view(one, depth, camera, found, options, network), objects)
            if network is not None and objects:
                views = np.stack([one.shown.marked for one in objects if one.shown is not None])
                predictions: Future[Superquadric] = Future()
                if options.method == "auto" and options.refine == "surface":
                    predictions = self._beside.submit(network.predict, views)
                else:
                    predictions.set_result(network.predict(views))
                for k, one in enumerate(objects):
                    one.predictions, one.number = predictions, k

        with _timed(milliseconds, "fit"):
            deadline = started + options.time_budget
            fits = self._mapped(lambda one: _fitted(one, depth, camera, options, deadline), objects)
        with _timed(milliseconds, "repair"):
            if labels is None and options.repair and options.method in _FITTED and options.refine == "surface":
                found, objects, fits = _repaired(found, objects, fits, depth, camera, options, deadline)
        with _timed(milliseconds, "score"):
            pairs = list(zip(objects, fits, strict=True))
            scores = self._mapped(lambda pair: _score(pair[0].view, pair[1].superquadric, options), pairs)
        bodies = tuple(_recovery(one, fit, score) for one, fit, score in zip(objects, fits, scores, strict=True))
        milliseconds["total"] = 1e3 * (time.perf_counter() - started)
        message = "" if bodies else _why_empty(depth, found)
        return FrameRecovery(bodies, milliseconds, found.labels, found.plane, message)

    def _mapped(self, function: Callable[[_Item], _Answer], items: Sequence[_Item]) -> list[_Answer]:
        """The function of each item; several at a time in threads that stay, as new ones cost memory and time."""
        if len(items) < 2 or self._threads < 2:
            return [function(one) for one in items]
        return list(self._pool.map(function, items))

    def _load_network(self) -> inference.Predictor:
        with self._lock:
            if self._network is None:
                network = inference.prepare(checkpoint.load(self._path, self._device))
                self._network = Consensus(network) if self._consensus else network
            return self._network


def render_recovery(frame: FrameRecovery, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """What the recovered bodies would look like to the camera.

    Returns
    -------
    depth : float64 (height, width)
        +inf where there is no body.
    index : int32 (height, width)
        Position in ``frame.bodies``, -1 where there is none; failed bodies are not drawn.
    """
    shown = [k for k, body in enumerate(frame.bodies) if body.status != Status.FAILED]
    depth, index = raycast.render(Superquadric.stack([frame.bodies[k].superquadric for k in shown]), camera)
    return depth, np.append(np.array(shown, dtype=np.int32), np.int32(-1))[index]


def checked_device(device: str) -> str:
    """The name of a torch device that is there.

    Raises
    ------
    ValueError
        If torch does not know the name or sees no such device.
    """
    try:
        kind = torch.device(device).type
    except RuntimeError as error:
        raise ValueError(f"device: {error}") from error
    if kind not in ("cpu", "cuda"):
        raise ValueError(f"device: expected cpu, cuda or cuda:N, got {device!r}")
    if kind == "cuda" and (torch.device(device).index or 0) >= torch.cuda.device_count():
        count = torch.cuda.device_count()
        raise ValueError(f"device: {device!r} was asked for, but torch sees {count} CUDA devices here")
    return device


def _plausible(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """The image without readings that are none; what is no depth image at all is for the segmentation to refuse."""
    if depth.dtype.kind != "f":
        return depth
    wild = np.abs(depth) > _FARTHEST
    if camera.is_pinhole:
        wild |= (depth > 0) & (depth < _NEAREST)
    return np.where(wild, depth.dtype.type(np.nan), depth) if wild.any() else depth


def _cleaned(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """float32 with NaN for everything that is no measurement."""
    depth = depth.astype(np.float32, copy=False)
    bad = ~np.isfinite(depth)
    if camera.is_pinhole:
        bad |= depth <= 0
    return np.where(bad, np.float32(np.nan), depth)


def _view(
    one: SeenObject,
    depth: np.ndarray,
    camera: Camera,
    found: segments.Segmentation,
    options: RecoveryOptions,
    network: inference.Predictor | None,
) -> None:
    """What the object stands on, what a network is shown of it, and what its score is measured on."""
    one.plane = seen_object.support(one, depth, camera, found, options.segmentation_options())
    core = seen_object.core(one, depth, camera)
    if network is not None:
        one.shown = network.config.view_of(depth, core, camera, one.plane)
    one.view = one.shown
    if network is None or network.config.framing == "full":
        one.view = canonical_view.from_mask(one.depth_crop, core[one.window], one.camera_crop, _VIEW_PIXELS)


def _repaired(
    found: segments.Segmentation,
    objects: list[SeenObject],
    fits: list[Fit],
    depth: np.ndarray,
    camera: Camera,
    options: RecoveryOptions,
    deadline: float,
) -> tuple[segments.Segmentation, list[SeenObject], list[Fit]]:
    """Segments, objects and bodies after joining and splitting; new segments are fitted without the network."""

    def prepared(mask: np.ndarray) -> SeenObject:
        label = int(found.labels.max()) + 1
        alone = replace(found, labels=np.where(mask, np.int32(label), found.labels), ids=(label,))
        one = seen_object.objects(depth, alone, camera, options.depth_range)[0]
        _view(one, depth, camera, alone, options, None)
        return one

    known = dict(zip((one.label for one in objects), fits, strict=True))
    repair = segment_repair.repaired(
        depth,
        camera,
        found.labels,
        found.plane,
        known,
        lambda mask: _fitted(prepared(mask), depth, camera, options, deadline),
        found.sigma,
        deadline - time.perf_counter(),
    )
    if not repair.changed:
        return found, objects, fits
    same = {one.label: one for one in objects if repair.fits.get(one.label) is known[one.label]}
    for label in repair.fits.keys() - same.keys():
        same[label] = prepared(repair.labels == label)
        same[label].label = label
    ordered = sorted(same.values(), key=lambda one: (-one.pixels, one.label))
    ids = tuple(one.label for one in ordered)
    return replace(found, labels=repair.labels, ids=ids), ordered, [repair.fits[label] for label in ids]


def _fitted(one: SeenObject, depth: np.ndarray, camera: Camera, options: RecoveryOptions, deadline: float) -> Fit:
    """The body of one object by the chosen method; FAILED with a reason instead of any exception on hard data."""
    if one.pixels < _FEWEST_PIXELS:
        return _failed(one, f"{one.pixels} pixels with a depth are too few for a body")
    try:
        fit = _body(one, depth, camera, options, deadline)
    except _HARD_IMAGE as error:
        return _failed(one, f"{options.method}: {error}")
    if not np.isfinite(fit.superquadric.to_flat()).all():
        return _failed(one, f"{options.method}: the result is not finite")
    return fit


def _body(one: SeenObject, depth: np.ndarray, camera: Camera, options: RecoveryOptions, deadline: float) -> Fit:
    if options.method == "classic":
        return solina_bajcsy.fit(one.points)
    if options.method == "network" or (options.method == "auto" and options.refine == "none"):
        return _unfitted(one.predicted(), one, "prediction of the network, not refined")
    if options.method == "auto" and options.refine == "soft_render":
        return _soft_rendered(one.predicted(), one, options)
    plane = one.plane if options.use_plane else None
    fit = _surface_fit(one, depth, camera, plane, max(deadline - time.perf_counter(), _LEAST_BUDGET))
    if options.refine == "soft_render" and fit.status != Status.FAILED:
        return _soft_rendered(fit.superquadric, one, options)
    return fit


def _surface_fit(
    one: SeenObject, depth: np.ndarray, camera: Camera, plane: np.ndarray | None, time_budget: float
) -> Fit:
    """From the cheapest starts of central symmetry; where those leave something, from the network's prediction too.

    The network computes beside the fit.  What the image leaves open after all, such as the depth of a box seen
    face-on, its prediction tells again.
    """
    if one.predictions is None:
        return surface_fit.fit(
            depth, one.mask, camera, options=surface_fit.Options(plane=plane, time_budget=time_budget)
        )
    settings = surface_fit.Options(plane=plane, time_budget=time_budget, expected=one.predicted)
    return surface_fit.fit(depth, one.mask, camera, start=one.predicted, options=settings)


def _soft_rendered(start: Superquadric, one: SeenObject, options: RecoveryOptions) -> Fit:
    assert one.view is not None
    body, before, after = soft_render_fit.refine(
        one.view.image, one.view.to_canonical(start), options.sharpness, options.tau
    )
    refined = one.view.from_canonical(body).canonical_form()
    return _unfitted(refined, one, f"soft-rendered residual {before:.4f} before, {after:.4f} after the refinement")


def _unfitted(body: Superquadric, one: SeenObject, message: str) -> Fit:
    """The answer of a method that is no least squares fit: distances measured, nothing known about uncertainty."""
    distance = body.sampson_distance(one.points)
    residual = float(np.sqrt(np.mean(distance**2)))
    return Fit(
        body,
        residual,
        np.nan,
        np.nan,
        np.nan,
        _UNSEEN,
        _UNKNOWN,
        Status.CONVERGED,
        message,
        iterations=0,
        milliseconds=0.0,
    )


def _failed(one: SeenObject, reason: str) -> Fit:
    points = one.points
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum(0.5 * (high - low), 1e-3 * max(float((high - low).max()), 1e-3))
    body = Superquadric(size, np.ones(2), 0.5 * (low + high), np.array([0.0, 0.0, 0.0, 1.0]))
    return Fit(
        body, np.nan, np.nan, 0.0, np.nan, _UNSEEN, _UNKNOWN, Status.FAILED, reason, iterations=0, milliseconds=0.0
    )


def _score(view: CanonicalView | None, body: Superquadric, options: RecoveryOptions) -> float:
    assert view is not None
    flat = np.array(view.to_canonical(body).to_flat())[None]
    with torch.inference_mode():
        image = torch.as_tensor(view.image)
        axis = soft_render.cell_centres(image.shape[0], image)
        single = Superquadric.from_flat(torch.as_tensor(flat, dtype=torch.float32))
        rendered = soft_render.render_depth(single, axis, options.sharpness, options.tau, _SCORE_STRIDE)[0]
        return float(soft_render.agreement(image[::_SCORE_STRIDE, ::_SCORE_STRIDE], rendered).clip(0, 1))


def _recovery(one: SeenObject, fit: Fit, score: float) -> Recovery:
    failed = fit.status == Status.FAILED
    return Recovery(
        fit.superquadric,
        score if np.isfinite(score) and not failed else 0.0,
        fit.residual,
        fit.sigma_size,
        fit.status,
        fit.message,
        one.label,
        one.pixels,
        fit.covariance,
        fit.seen,
    )


def _why_empty(depth: np.ndarray, found: segments.Segmentation) -> str:
    if not np.isfinite(depth).any():
        return "the image holds no depth"
    if found.plane is not None:
        return "nothing stands on the plane"
    return "no object of the wanted size and distance"


@contextmanager
def _timed(milliseconds: dict[str, float], stage: str) -> Iterator[None]:
    started = time.perf_counter()
    try:
        yield
    finally:
        milliseconds[stage] = 1e3 * (time.perf_counter() - started)
