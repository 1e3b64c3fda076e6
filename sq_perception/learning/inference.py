"""A loaded network made ready to predict, by the fastest engine that is there.

| engine | device | type | needs |
| --- | --- | --- | --- |
| onnxruntime | cpu | float32 | the packages onnx and onnxruntime |
| torch | any | float32, bfloat16, float16 | |

``auto`` takes onnxruntime for single precision on a CPU where it is installed: one view at a time, it needs less than
half of torch's time (``benchmarks/network_speed.py``), and the bodies are the same to 1e-6.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Literal, Protocol, get_args

import numpy as np
import torch

from sq_perception.fitting.hull_prior import HullPrior
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.support_directions import DIRECTIONS, mirrored
from sq_perception.imaging.canonical_view import CanonicalView
from sq_perception.learning import onnx_export, thing_network
from sq_perception.learning.backbone import fold
from sq_perception.learning.regressor import Regressor, RegressorConfig, checked_views
from sq_perception.learning.thing_network import ThingNetwork

Engine = Literal["auto", "torch", "onnxruntime"]


class Predictor(Protocol):
    """What a recovery needs of a network."""

    config: RegressorConfig

    def predict(self, views: np.ndarray) -> Superquadric:
        """NumPy superquadrics (n,) of NumPy views (n, p, p); see :meth:`Regressor.predict`."""


@dataclass(frozen=True, eq=False)
class HullAnswers:
    """What the network of things says of a batch of views, each in the frame of its view; NumPy.

    Attributes
    ----------
    bodies : Superquadric
        Batch (n,).
    support : (n, J)
        Support functions in sides of the view, from its middle (:data:`thing_network.MIDDLE`).
    covariance : (n, J, J)
    """

    bodies: Superquadric
    support: np.ndarray
    covariance: np.ndarray

    def hull(self, number: int, view: CanonicalView) -> HullPrior:
        """The prediction of one view in the optical frame."""
        directions = DIRECTIONS @ quaternions.to_matrix(view.rotation)
        support = directions @ view.anchor + view.extent * self.support[number]
        covariance = view.extent**2 * self.covariance[number]
        return HullPrior(directions, support, covariance, view.extent)


class ThingPredictor:
    """The network of things, made ready to predict.

    It is asked about each view and its mirror image, whose answer is mirrored back: the mean of two support functions
    errs less than one (by 3 to 6 % on recorded things); the mean of their covariances does not promise more.  The
    body is that of the view itself.
    """

    def __init__(self, model: ThingNetwork) -> None:
        self.config = model.config
        self._model = copy.deepcopy(model).eval()
        fold(self._model.features)
        self._device = next(self._model.parameters()).device

    def predict(self, views: np.ndarray, planes: np.ndarray, extents: np.ndarray) -> HullAnswers:
        """Answers to views (n, p, p) of sides ``extents`` (n,), metres, 0 where unknown.

        What the things stand on are planes (n, 4) in the frames of the views, zeros where there is none.

        Raises
        ------
        ValueError
            For views, planes or extents of another form, or not finite.
        """
        views = checked_views(views, self.config.regressor())
        if planes.shape != (len(views), 4) or not np.isfinite(planes).all():
            raise ValueError(f"expected finite planes of shape ({len(views)}, 4), got {planes.shape}")
        if extents.shape != (len(views),) or not np.isfinite(extents).all():
            raise ValueError(f"expected finite extents of shape ({len(views)},), got {extents.shape}")
        both = np.concatenate([views, views[:, :, ::-1]])
        sides = np.concatenate([extents, extents]).astype(np.float32)
        supports = np.concatenate([planes, thing_network.mirrored_planes(planes)]).astype(np.float32)
        with torch.inference_mode():
            said = self._model(*(torch.from_numpy(each).to(self._device) for each in (both, supports, sides)))
            flat = said.body.to_flat()[: len(views)].double().cpu().numpy()
            straight, turned = np.split(said.support.double().cpu().numpy(), 2)
            covariance, turned_covariance = np.split(said.covariance().double().cpu().numpy(), 2)
        back = mirrored(0)
        return HullAnswers(
            Superquadric.from_flat(flat),
            (straight + turned[:, back]) / 2,
            (covariance + turned_covariance[:, back][:, :, back]) / 2,
        )


class OnnxPredictor:
    """A network computed by onnxruntime on the CPU, on as many threads as torch has at its construction."""

    def __init__(self, model: Regressor) -> None:
        runtime = onnx_export.require("onnxruntime")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()
        options.inter_op_num_threads = 1
        options.add_session_config_entry(
            "session.intra_op.allow_spinning", "0"
        )  # idle threads leave the cores to others
        graph = onnx_export.build(model).SerializeToString()
        self.config = model.config
        self._session = runtime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])

    def predict(self, views: np.ndarray) -> Superquadric:
        """As :meth:`Regressor.predict`, errors included."""
        batch = checked_views(views, self.config)[:, None]
        (parameters,) = self._session.run([onnx_export.OUTPUT], {onnx_export.INPUT: batch})
        return Superquadric.from_flat(parameters.astype(float))


def prepare(model: Regressor, engine: Engine = "auto", dtype: torch.dtype = torch.float32) -> Predictor:
    """A predictor of the same bodies as ``model``, which stays as it is.

    Raises
    ------
    ValueError
        For an unknown engine, or onnxruntime with a type or on a device that it does not compute here.
    MissingPackageError
        If onnxruntime is asked for by name and it or onnx is missing.
    """
    if engine not in get_args(Engine):
        raise ValueError(f"engine: expected one of {', '.join(get_args(Engine))}, got {engine!r}")
    device = next(model.parameters()).device
    able = device.type == "cpu" and dtype == torch.float32
    if engine == "onnxruntime" and not able:
        raise ValueError(f"engine: onnxruntime computes float32 on the CPU here, got {dtype} on {device}")
    if engine == "onnxruntime" or (engine == "auto" and able and _installed()):
        return OnnxPredictor(model)
    return model.for_inference(dtype)


def _installed() -> bool:
    return all(find_spec(name) is not None for name in ("onnx", "onnxruntime"))
