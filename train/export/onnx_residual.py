"""A residual as a graph of ONNX: mirror, normalisation, network, bounds; and its test vector.

Features are doubles, because sensors such as foot forces have means far above their spread. The
network computes in single precision, as in NumPy.
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
"""Of 2022, which also older runtimes read."""
_TEST_ROWS = 64


def onnx_model(layout: ResidualLayout) -> bytes:
    """The graph of a residual, with what one must know to use it as metadata."""
    graph = _Graph()
    features = graph.take("features", len(layout.features), "features before the mirror")
    seen = features
    on_right = ""
    if layout.mirrors is not None:
        on_right = graph.take("on_right", 1, "the step is on the right foot", np.bool_)
        seen = graph.mirror_on_right(features, on_right, layout.mirrors[0])
    residual = _network(graph, seen, layout)
    if layout.mirrors is not None:
        residual = graph.mirror_on_right(residual, on_right, layout.mirrors[1])
    graph.give("residual", residual, len(layout.residual), "what is decided, within [-1, 1]")
    of_columns = graph.add("Gather", residual, graph.keep(layout.source), axis=1)
    correction = graph.add("Mul", of_columns, graph.keep(layout.bounds))
    graph.give("correction", correction, len(layout.columns), "values of the base's inputs")
    facts = {
        key: value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
        for key, value in layout.facts().items()
    }
    return graph.serialise(layout.name, facts)


def played_vector(layout: ResidualLayout) -> bytes:
    """Inputs of the graph and what Python makes of them, as a file of NumPy (.npz)."""
    drawn = layout.draw(_TEST_ROWS)
    residual, correction = layout.decide(**drawn)
    if layout.mirrors is None:
        del drawn["on_right"]
    content = io.BytesIO()
    np.savez(content, **drawn, residual=residual, correction=correction)
    return content.getvalue()


def _network(graph: "_Graph", features: str, layout: ResidualLayout) -> str:
    """Normalisation and layers; their result is double again."""
    description = layout.description
    tensors = layout.tensors
    centred = graph.add("Sub", features, graph.keep(tensors["mean"].astype(np.float64)))
    scaled = graph.add("Div", centred, graph.keep(tensors["std"].astype(np.float64)))
    clip = graph.keep(-description.clip), graph.keep(description.clip)
    x = graph.cast(graph.add("Clip", scaled, *clip), np.float32)
    for i in range(layout.num_layers):
        weights = [graph.keep(tensors[f"{kind}{i}"].astype(np.float32)) for kind in _OF_LAYER]
        x = graph.add("Gemm", x, *weights, transB=1)
        if i < layout.num_layers - 1:
            x = graph.add(_ACTIVATIONS[description.activation], x)
    if description.output == "tanh":
        x = graph.add("Tanh", x)
    else:
        x = graph.add("Clip", x, graph.keep(np.float32(-1.0)), graph.keep(np.float32(1.0)))
    return graph.cast(x, np.float64)


_OF_LAYER = ("weight", "bias")
_ACTIVATIONS = {"tanh": "Tanh", "relu": "Relu"}


class _Graph:
    """A graph that grows node by node; values are named by their numbers."""

    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._constants: list[Any] = []
        self._inputs: list[Any] = []
        self._outputs: list[Any] = []

    def take(self, name: str, width: int, meaning: str, kind: Any = np.float64) -> str:
        """An input, (batch, width)."""
        self._inputs.append(self._value(name, width, meaning, kind))
        return name

    def give(self, name: str, value: str, width: int, meaning: str) -> None:
        """Name a value as an output, (batch, width)."""
        self._nodes.append(onnx.helper.make_node("Identity", [value], [name]))
        self._outputs.append(self._value(name, width, meaning, np.float64))

    def keep(self, array: Any) -> str:
        """A constant."""
        name = f"constant_{len(self._constants)}"
        self._constants.append(onnx.numpy_helper.from_array(np.array(array), name))
        return name

    def add(self, operator: str, *values: str, **attributes: Any) -> str:
        """An operation on values."""
        name = f"value_{len(self._nodes)}"
        node = onnx.helper.make_node(operator, list(values), [name], **attributes)
        self._nodes.append(node)
        return name

    def cast(self, value: str, kind: Any) -> str:
        """A value in another precision."""
        return self.add("Cast", value, to=self._type(kind))

    def mirror_on_right(self, value: str, on_right: str, mirror: Any) -> str:
        """A value, or its image in the mirror in steps on the right foot."""
        other = self.add("Gather", value, self.keep(mirror.source), axis=1)
        image = self.add("Mul", other, self.keep(mirror.sign))
        image = self.add("Add", image, self.keep(mirror.offset))
        return self.add("Where", on_right, image, value)

    def serialise(self, name: str, facts: dict[str, str]) -> bytes:
        """The model's file."""
        parts: Sequence[Any] = (self._nodes, name, self._inputs, self._outputs)
        graph = onnx.helper.make_graph(*parts, initializer=self._constants)
        opsets = [onnx.helper.make_opsetid("", _OPSET)]
        made = {"ir_version": _IR_VERSION, "opset_imports": opsets}
        made |= {"producer_name": "elastic-env", "producer_version": facts["elastic_env"]}
        model = onnx.helper.make_model(graph, **made)
        onnx.helper.set_model_props(model, facts)
        onnx.checker.check_model(model, full_check=True)
        return model.SerializeToString(deterministic=True)

    def _value(self, name: str, width: int, meaning: str, kind: Any) -> Any:
        made = onnx.helper.make_tensor_value_info(name, self._type(kind), ["batch", width])
        made.doc_string = meaning
        return made

    def _type(self, kind: Any) -> int:
        return onnx.helper.np_dtype_to_tensor_dtype(np.dtype(kind))
