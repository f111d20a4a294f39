"""The network in ONNX Runtime: float32, and int8, static and dynamic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from protomark_bench.speed.peers.network import FloatLayer

Model = Any  # onnx.ModelProto, which has no types


def float_model(layers: list[FloatLayer]) -> Model:
    """Gemm and Selu, from bits (n, bits) float32 to codes (n, dim) float32."""
    graph = _OnnxGraph()
    x = "input"
    for i, layer in enumerate(layers):
        weights = graph.constant(layer.weights)
        x = graph.node("Gemm", [x, weights, graph.constant(layer.bias)], transB=1)
        if i + 1 < len(layers):
            x = graph.node("Selu", [x])
    return graph.model(x, layers, TensorProto.FLOAT, TensorProto.FLOAT)


def static_model(layers: list[FloatLayer]) -> Model:
    """A statically quantised network in QDQ form, which ONNX Runtime fuses to QGemm.

    It maps bits (n, bits) uint8 to codes (n, dim) int8 with the scales of our integer encoder: int8
    weights with a scale per output, and uint8 activations.
    """
    graph = _OnnxGraph()
    scale, zero = 1.0, 0
    x = graph.node("DequantizeLinear", ["input", *graph.scale(scale, zero, np.uint8)])
    for i, layer in enumerate(layers):
        last = i + 1 == len(layers)
        steps = np.maximum(np.abs(layer.weights).max(axis=1), 1e-12) / 127
        whole = np.rint(layer.weights / steps[:, None]).astype(np.int8)
        weights = graph.node(
            "DequantizeLinear",
            [
                graph.constant(whole),
                graph.constant(steps.astype(np.float32)),
                graph.constant(np.zeros(len(steps), np.int8)),
            ],
            axis=0,
        )
        unit = (scale * steps).astype(np.float32)
        bias = graph.node(
            "DequantizeLinear",
            [
                graph.constant(np.rint(layer.bias / unit).astype(np.int32)),
                graph.constant(unit),
                graph.constant(np.zeros(len(steps), np.int32)),
            ],
            axis=0,
        )
        x = graph.node("Gemm", [x, weights, bias], transB=1)
        if last:
            return graph.model(
                graph.node("QuantizeLinear", [x, *graph.scale(1.0, 0, np.int8)]),
                layers,
                TensorProto.UINT8,
                TensorProto.INT8,
            )
        # Between layers values are quantised to 8 bits before and after SELU in float.
        offset = 128 - round(layer.middle / layer.step)
        between = graph.scale(layer.step, min(max(offset, 0), 255), np.uint8)
        x = graph.node("QuantizeLinear", [x, *between])
        x = graph.node("DequantizeLinear", [x, *between])
        x = graph.node("Selu", [x])
        scale, zero = layer.unit, layer.zero
        after = graph.scale(scale, zero, np.uint8)
        x = graph.node("QuantizeLinear", [x, *after])
        x = graph.node("DequantizeLinear", [x, *after])
    raise ValueError("a network has at least one layer")


def dynamic_model(layers: list[FloatLayer]) -> Model:
    """A dynamically quantised network, from bits uint8 to codes float32."""
    graph = _OnnxGraph()
    x, scale, zero = "input", "", ""
    for i, layer in enumerate(layers):
        steps = np.maximum(np.abs(layer.weights).max(axis=1), 1e-12) / 127
        whole = np.ascontiguousarray(np.rint(layer.weights / steps[:, None]).astype(np.int8).T)
        inputs = [x, graph.constant(whole)] + ([zero] if zero else [])
        x = graph.node("Cast", [graph.node("MatMulInteger", inputs)], to=TensorProto.FLOAT)
        unit = graph.constant(steps.astype(np.float32))
        x = graph.node("Mul", [x, graph.node("Mul", [scale, unit]) if scale else unit])
        x = graph.node("Add", [x, graph.constant(layer.bias)])
        if i + 1 < len(layers):
            x, scale, zero = graph.nodes("DynamicQuantizeLinear", [graph.node("Selu", [x])], 3)
    return graph.model(x, layers, TensorProto.UINT8, TensorProto.FLOAT)


def runner(model: Model, inputs: NDArray[Any], threads: int) -> Callable[[int], NDArray[Any]]:
    """A function that computes the codes of the first n rows of `inputs`."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), options, providers=["CPUExecutionProvider"]
    )

    def run(n: int) -> NDArray[Any]:
        result: NDArray[Any] = session.run(None, {"input": inputs[:n]})[0]
        return result

    return run


class _OnnxGraph:
    """Nodes and constants, named by number."""

    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def constant(self, array: NDArray[Any]) -> str:
        name = f"c{len(self._constants)}"
        self._constants.append(numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def scale(self, scale: float, zero: int, dtype: type) -> list[str]:
        """The two constants of a quantisation."""
        return [self.constant(np.array(scale, np.float32)), self.constant(np.array(zero, dtype))]

    def nodes(self, kind: str, inputs: list[str], count: int, **attributes: Any) -> list[str]:
        names = [f"n{len(self._nodes)}_{i}" for i in range(count)]
        self._nodes.append(helper.make_node(kind, inputs, names, **attributes))
        return names

    def node(self, kind: str, inputs: list[str], **attributes: Any) -> str:
        return self.nodes(kind, inputs, 1, **attributes)[0]

    def model(self, output: str, layers: list[FloatLayer], input_type: int, type_: int) -> Model:
        bits, dim = layers[0].weights.shape[1], len(layers[-1].bias)
        graph = helper.make_graph(
            self._nodes,
            "encoder",
            [helper.make_tensor_value_info("input", input_type, ["n", bits])],
            [helper.make_tensor_value_info(output, type_, ["n", dim])],
            self._constants,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
        model.ir_version = 8
        onnx.checker.check_model(model)
        return model
