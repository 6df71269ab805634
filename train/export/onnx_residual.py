"""A residual as a graph of ONNX: mirror, normalisation, network, bounds; and its test vector.

Features are doubles, because sensors such as foot forces have means far above their standard
deviations. The network computes in single precision, as in NumPy.
"""

import io
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
import onnx.checker
import onnx.helper
import onnx.numpy_helper

from train.export.residual_layout import ResidualLayout

_OPSET = 17
_IR_VERSION = 8
"""Version of 2022, which older runtimes read too."""
_TEST_ROWS = 64
_LAYER_TENSORS = ("weight", "bias")
_ACTIVATIONS = {"tanh": "Tanh", "relu": "Relu"}


def onnx_model(layout: ResidualLayout) -> bytes:
    """The graph of a residual, with the facts about its use as metadata."""
    graph = _Graph()
    features = graph.add_input("features", len(layout.features), "features before the mirror")
    network_input = features
    on_right = ""
    if layout.mirrors is not None:
        on_right = graph.add_input("on_right", 1, "the step is on the right foot", np.bool_)
        network_input = graph.mirror_on_right(features, on_right, layout.mirrors[0])
    residual = _add_network(graph, network_input, layout)
    if layout.mirrors is not None:
        residual = graph.mirror_on_right(residual, on_right, layout.mirrors[1])
    graph.add_output("residual", residual, len(layout.residual), "what is decided, within [-1, 1]")
    sources = graph.add_node("Gather", residual, graph.add_constant(layout.source), axis=1)
    correction = graph.add_node("Mul", sources, graph.add_constant(layout.bounds))
    graph.add_output("correction", correction, len(layout.columns), "values of the base's inputs")
    facts = {
        key: value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
        for key, value in layout.facts().items()
    }
    return graph.serialise(layout.name, facts)


def played_vector(layout: ResidualLayout) -> bytes:
    """Inputs of the graph and the outputs of Python, as a file of NumPy (.npz)."""
    samples = layout.draw(_TEST_ROWS)
    residual, correction = layout.decide(**samples)
    if layout.mirrors is None:
        del samples["on_right"]
    content = io.BytesIO()
    np.savez(content, **samples, residual=residual, correction=correction)
    return content.getvalue()


def _add_network(graph: "_Graph", features: str, layout: ResidualLayout) -> str:
    """Add normalisation and layers; return their result in double precision."""
    description = layout.description
    tensors = layout.tensors
    mean = graph.add_constant(tensors["mean"].astype(np.float64))
    std = graph.add_constant(tensors["std"].astype(np.float64))
    scaled = graph.add_node("Div", graph.add_node("Sub", features, mean), std)
    clip = graph.add_constant(-description.clip), graph.add_constant(description.clip)
    x = graph.cast(graph.add_node("Clip", scaled, *clip), np.float32)
    for i in range(layout.num_layers):
        layer = [tensors[f"{name}{i}"].astype(np.float32) for name in _LAYER_TENSORS]
        x = graph.add_node("Gemm", x, *map(graph.add_constant, layer), transB=1)
        if i < layout.num_layers - 1:
            x = graph.add_node(_ACTIVATIONS[description.activation], x)
    if description.output == "tanh":
        x = graph.add_node("Tanh", x)
    else:
        bounds = (graph.add_constant(np.float32(bound)) for bound in (-1.0, 1.0))
        x = graph.add_node("Clip", x, *bounds)
    return graph.cast(x, np.float64)


class _Graph:
    """A graph that grows node by node; numbers name its values."""

    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._constants: list[Any] = []
        self._inputs: list[Any] = []
        self._outputs: list[Any] = []

    def add_input(self, name: str, width: int, meaning: str, kind: Any = np.float64) -> str:
        """Add an input, (batch, width), and return its name."""
        self._inputs.append(self._value_info(name, width, meaning, kind))
        return name

    def add_output(self, name: str, value: str, width: int, meaning: str) -> None:
        """Add a value as a named output, (batch, width)."""
        self._nodes.append(onnx.helper.make_node("Identity", [value], [name]))
        self._outputs.append(self._value_info(name, width, meaning, np.float64))

    def add_constant(self, array: Any) -> str:
        """Add a constant and return its name."""
        name = f"constant_{len(self._constants)}"
        self._constants.append(onnx.numpy_helper.from_array(np.array(array), name))
        return name

    def add_node(self, operator: str, *values: str, **attributes: Any) -> str:
        """Add an operation on values and return the name of its result."""
        name = f"value_{len(self._nodes)}"
        node = onnx.helper.make_node(operator, list(values), [name], **attributes)
        self._nodes.append(node)
        return name

    def cast(self, value: str, kind: Any) -> str:
        """Add the cast of a value to another type, and return the name of the result."""
        return self.add_node("Cast", value, to=self._type(kind))

    def mirror_on_right(self, value: str, on_right: str, mirror: Any) -> str:
        """Add the mirror image of a value in steps on the right foot; otherwise the value."""
        other = self.add_node("Gather", value, self.add_constant(mirror.source), axis=1)
        image = self.add_node("Mul", other, self.add_constant(mirror.sign))
        image = self.add_node("Add", image, self.add_constant(mirror.offset))
        return self.add_node("Where", on_right, image, value)

    def serialise(self, name: str, facts: dict[str, str]) -> bytes:
        """Content of the model's file."""
        parts: Sequence[Any] = (self._nodes, name, self._inputs, self._outputs)
        graph = onnx.helper.make_graph(*parts, initializer=self._constants)
        opsets = [onnx.helper.make_opsetid("", _OPSET)]
        options = {"ir_version": _IR_VERSION, "opset_imports": opsets}
        options |= {"producer_name": "elastic-env", "producer_version": facts["elastic_env"]}
        model = onnx.helper.make_model(graph, **options)
        onnx.helper.set_model_props(model, facts)
        onnx.checker.check_model(model, full_check=True)
        return model.SerializeToString(deterministic=True)

    def _value_info(self, name: str, width: int, meaning: str, kind: Any) -> Any:
        info = onnx.helper.make_tensor_value_info(name, self._type(kind), ["batch", width])
        info.doc_string = meaning
        return info

    def _type(self, kind: Any) -> int:
        return onnx.helper.np_dtype_to_tensor_dtype(np.dtype(kind))
