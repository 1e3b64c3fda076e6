"""A loaded network made ready to predict, by the fastest engine that is there.

| engine | device | type | needs |
| --- | --- | --- | --- |
| onnxruntime | cpu | float32 | the packages onnx and onnxruntime |
| torch | any | float32, bfloat16, float16 | |

``auto`` takes onnxruntime for single precision on a CPU where it is installed: one view at a time, it needs less than
half of torch's time (``benchmarks/network_speed.py``), and the bodies are the same to 1e-6.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Literal, Protocol, get_args

import numpy as np
import torch

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.learning import onnx_export
from sq_perception.learning.regressor import Regressor, RegressorConfig, checked_views

Engine = Literal["auto", "torch", "onnxruntime"]


class Predictor(Protocol):
    """What a recovery needs of a network."""

    config: RegressorConfig

    def predict(self, views: np.ndarray) -> Superquadric:
        """NumPy superquadrics (n,) of NumPy views (n, p, p); see :meth:`Regressor.predict`."""


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
