"""The network as an ONNX graph: views in, the 12 flat parameters out, nothing else needed to use it.

    sq-perception export --output net.onnx
    parameters = onnxruntime.InferenceSession("net.onnx").run(None, {"views": views})[0]

Input   ``views``       float32 (n, 1, p, p), as :mod:`sq_perception.learning.regressor` describes them, any n
Output  ``parameters``  float32 (n, 12), a1 a2 a3 e1 e2 t1 t2 t3 qx qy qz qw in the frame of the views

The graph is written down from the folded modules, node by node.  That takes milliseconds, where torch's exporter takes
seconds and two more packages.
The file's metadata is the header of the weights (:mod:`sq_perception.learning.checkpoint`), the config among it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from torch import nn

from sq_perception.learning import checkpoint
from sq_perception.learning.backbone import BasicBlock, ResidualBlock, ResNet18
from sq_perception.learning.network_config import RegressorConfig
from sq_perception.learning.regressor import Regressor

INPUT, OUTPUT = "views", "parameters"
PARAMETERS = ("a1", "a2", "a3", "e1", "e2", "t1", "t2", "t3", "qx", "qy", "qz", "qw")
INPUT_WORDS = (
    "views, each of one object: z of its surface in the unit cube (x right, y up, z to the viewer), 0 for background, "
    "-0.5 where it may go on unseen"
)
OUTPUT_WORDS = "bodies in the frames of their views: half sizes, exponents, centre, unit quaternion"
OPSET, IR_VERSION = 18, 8
"""Of ONNX 1.13 (2022): runtimes of any age read it."""


def build(model: Regressor, notes: Mapping[str, str] | None = None) -> Any:
    """The ``onnx.ModelProto`` of a network; ``notes`` go into its metadata beside format, version and config.

    Raises
    ------
    ModuleNotFoundError
        Without onnx, the extra 'export'.
    """
    import onnx

    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    folded = model.for_inference().cpu()
    graph = _Graph(onnx)
    h = graph.module(graph.module(INPUT, folded.features), folded.mixer)
    heads = [folded.size_head, folded.shape_head, folded.translation_head, folded.rotation_head]
    weights = [np.concatenate([_array(getattr(head, part)) for head in heads]) for part in ("weight", "bias")]
    _decode(graph, graph.linear(h, *weights), model.config)
    pixels = model.config.pixels
    proto = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "sq_perception",
            [helper.make_tensor_value_info(INPUT, kind, ["batch", 1, pixels, pixels], INPUT_WORDS)],
            [helper.make_tensor_value_info(OUTPUT, kind, ["batch", len(PARAMETERS)], OUTPUT_WORDS)],
            graph.initializers,
        ),
        producer_name="sq_perception",
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
    )
    header = {"format": checkpoint.FORMAT, "version": checkpoint.VERSION, "config": json.dumps(asdict(model.config))}
    helper.set_model_props(proto, {**(notes or {}), **header, "parameters": " ".join(PARAMETERS)})
    onnx.checker.check_model(proto)
    return proto


class _Graph:
    """Nodes and constants, named by number; every method answers with the name of what it added."""

    def __init__(self, onnx: Any) -> None:
        self._onnx = onnx
        self.nodes: list[Any] = []
        self.initializers: list[Any] = []

    def add(self, operator: str, *inputs: str, output: str | None = None, **attributes: Any) -> str:
        output = output or f"{operator}_{len(self.nodes)}"
        self.nodes.append(self._onnx.helper.make_node(operator, list(inputs), [output], output, **attributes))
        return output

    def split(self, x: str, sizes: list[int]) -> list[str]:
        outputs = [f"Split_{len(self.nodes)}_{k}" for k in range(len(sizes))]
        inputs = [x, self.constant(np.array(sizes))]
        self.nodes.append(self._onnx.helper.make_node("Split", inputs, outputs, f"Split_{len(self.nodes)}", axis=1))
        return outputs

    def constant(self, values: Any) -> str:
        values = np.asarray(values)
        values = values.astype(np.int64 if values.dtype.kind == "i" else np.float32)
        name = f"constant_{len(self.initializers)}"
        self.initializers.append(self._onnx.numpy_helper.from_array(np.ascontiguousarray(values), name))
        return name

    def linear(self, x: str, weight: np.ndarray, bias: np.ndarray) -> str:
        return self.add("Gemm", x, self.constant(weight), self.constant(bias), transB=1)

    def module(self, x: str, module: nn.Module) -> str:
        """What a folded module makes of ``x``."""
        if isinstance(module, nn.Sequential):
            for child in module:
                x = self.module(x, child)
            return x
        if isinstance(module, nn.Identity):
            return x
        if isinstance(module, nn.ReLU):
            return self.add("Relu", x)
        if isinstance(module, nn.Flatten):
            return self.add("Flatten", x, axis=1)
        if isinstance(module, nn.Linear):
            return self.linear(x, _array(module.weight), _array(module.bias))
        if isinstance(module, nn.Conv2d):
            return self._convolution(x, module)
        if isinstance(module, ResidualBlock):
            return self._residual(x, module.first, module.second, module.shortcut)
        if isinstance(module, BasicBlock):
            return self._residual(x, module.conv1, module.conv2, module.downsample)
        if isinstance(module, ResNet18):
            x = self.add("Relu", self._convolution(x, module.conv1))
            x = self.add("MaxPool", x, kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 1, 1])
            for stage in (module.layer1, module.layer2, module.layer3, module.layer4):
                x = self.module(x, stage)
            return self.add("GlobalAveragePool", x)
        raise TypeError(f"no ONNX for {type(module).__name__}")

    def _convolution(self, x: str, module: nn.Conv2d) -> str:
        assert module.bias is not None, "normalisations must be folded"
        assert not isinstance(module.padding, str)
        parts = self.constant(_array(module.weight)), self.constant(_array(module.bias))
        return self.add("Conv", x, *parts, strides=list(module.stride), pads=2 * list(module.padding))

    def _residual(self, x: str, first: nn.Conv2d, second: nn.Conv2d, shortcut: nn.Module) -> str:
        y = self._convolution(self.add("Relu", self._convolution(x, first)), second)
        return self.add("Relu", self.add("Add", y, self.module(x, shortcut)))


def _decode(graph: _Graph, raw: str, config: RegressorConfig) -> None:
    """:meth:`RegressorConfig.decode`, and the flat order."""
    bounded, first, second = graph.split(raw, [8, 3, 3])
    size, shape, translation = graph.split(graph.add("Sigmoid", bounded), [3, 2, 3])
    low, high = config.size_range
    size = graph.add("Mul", graph.constant(low), graph.add("Pow", graph.constant(high / low), size))
    shape = _between(graph, shape, config.shape_range)
    translation = _between(graph, translation, config.translation_range)
    graph.add("Concat", size, shape, translation, _quaternion(graph, first, second), output=OUTPUT, axis=1)


def _between(graph: _Graph, unit: str, bounds: tuple[float, float]) -> str:
    low, high = bounds
    return graph.add("Add", graph.constant(low), graph.add("Mul", graph.constant(high - low), unit))


def _quaternion(graph: _Graph, first: str, second: str) -> str:
    """:func:`sq_perception.geometry.rotation.from_six`.

    The products 4 q_k q_l of all components are linear in the matrix.  The row k with the largest q_k^2, made a unit
    vector, is the quaternion.
    """
    axis = graph.constant([1])

    def unit(vector: str) -> str:
        square = graph.add("Add", graph.add("ReduceSumSquare", vector, axis), graph.constant(1e-12))
        return graph.add("Div", vector, graph.add("Sqrt", square))

    def turned(vector: str, by: int) -> str:
        return graph.add("Gather", vector, graph.constant(np.roll(np.arange(3), by)), axis=1)

    first = unit(first)
    along = graph.add("ReduceSum", graph.add("Mul", first, second), axis)
    second = unit(graph.add("Sub", second, graph.add("Mul", along, first)))
    third = graph.add("Sub", *(graph.add("Mul", turned(first, -by), turned(second, by)) for by in (1, -1)))
    columns = graph.add("Concat", first, second, third, axis=1)

    linear = np.zeros((3, 3, 4, 4))  # column and row of the matrix m, k and l of the product 4 q_k q_l
    diagonal = range(3)
    linear[diagonal, diagonal, 3, 3] = 1  # 4 w^2 = 1 + m_00 + m_11 + m_22
    for i in diagonal:
        j, k = (i + 1) % 3, (i + 2) % 3
        linear[diagonal, diagonal, i, i] = [1 if n == i else -1 for n in diagonal]  # 4 q_i^2 = 1 + m_ii - m_jj - m_kk
        linear[i, j, [i, j], [j, i]] = linear[j, i, [i, j], [j, i]] = 1  # 4 q_i q_j = m_ij + m_ji
        linear[j, k, [i, 3], [3, i]], linear[k, j, [i, 3], [3, i]] = 1, -1  # 4 q_i w = m_kj - m_jk
    coefficients = graph.constant(linear.reshape(9, 16)), graph.constant(np.eye(4).reshape(16))
    products = graph.add("Gemm", columns, *coefficients)
    squares = graph.add("Gather", products, graph.constant(np.arange(0, 16, 5)), axis=1)
    largest = graph.add("ArgMax", squares, axis=1, keepdims=1)
    rows = graph.add("Reshape", products, graph.constant([-1, 4, 4]))
    row = graph.add("GatherND", rows, largest, batch_dims=1)
    return graph.add("Div", row, graph.add("ReduceL2", row, axis))


def _array(tensor: Any) -> np.ndarray:
    return np.asarray(tensor.detach().float().cpu().contiguous().numpy())
