"""The network of a residual as a header in C99, with mirror, bounds, low-pass and a test vector."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from baselines.residual.mirror import Mirror
from elastic_env.core.signals import Array
from train.export import c_text
from train.export.residual_layout import ResidualLayout

_TEST_ROWS = 16
_ACTIVATIONS = {"tanh": "tanhf(x)", "relu": "x > 0.0f ? x : 0.0f"}
_OUTPUTS = {"tanh": "tanhf({})", "clip": "residual_clamped_({}, 1.0)"}


def c_residual(layout: ResidualLayout, prefix: str) -> str:
    """The header of a residual, with a test vector behind the macro <PREFIX>_TEST.

    Args:
        layout: Layout of the residual.
        prefix: Prefix of all names in the header.

    Raises:
        ConfigurationError: The prefix is invalid.
    """
    facts = layout.facts()
    settings = layout.description.settings
    widths = [len(layout.tensors[f"bias{i}"]) for i in range(layout.num_layers)]
    feature_mirror, residual_mirror = layout.mirrors or (None, None)
    samples = layout.draw(_TEST_ROWS)
    decided, _ = layout.decide(**samples)
    return c_text.fill_template(
        "residual.h.in",
        prefix,
        weights_sha256=layout.weights_sha256,
        origin=c_text.comment(_origin_lines(facts)),
        features=c_text.comment(_column_lines(facts["features"])),
        columns=c_text.comment(_column_lines(facts["correction"])),
        control_period_s=c_text.number(layout.control_period_s),
        num_features=len(layout.features),
        num_residuals=len(layout.residual),
        num_columns=len(layout.columns),
        widest=max(len(layout.features), *widths),
        decision_period=settings.decision_period,
        has_mirror=int(layout.mirrors is not None),
        column_names=c_text.enum_lines(
            c_text.unique_names(f"{prefix.upper()}_", [s.name for s in layout.columns])
        ),
        mean=c_text.numbers(layout.tensors["mean"].astype(np.float64)),
        std=c_text.numbers(layout.tensors["std"].astype(np.float64)),
        bounds=c_text.numbers(layout.bounds),
        source=", ".join(map(str, layout.source)),
        of_features=_mirror_rows(feature_mirror, len(layout.features)),
        of_residual=_mirror_rows(residual_mirror, len(layout.residual)),
        layers="\n".join(_layer_tables(layout, prefix)),
        calls="\n".join(_layer_calls(layout, prefix, widths)),
        activation=_ACTIVATIONS[layout.description.activation],
        output=_output_expression(layout, prefix),
        clip=c_text.number(layout.description.clip),
        share=c_text.number(facts["share_per_control_step"]),
        rows=_TEST_ROWS,
        test_features=c_text.row_lines(samples["features"]),
        test_foot=c_text.numbers(samples["on_right"]),
        test_decided=c_text.row_lines(decided),
    )


def _origin_lines(facts: dict[str, Any]) -> Iterator[str]:
    yield c_text.GENERATED
    joints = ", ".join(map(c_text.plain_text, facts["joints"])) or "those of the robot"
    name, base, robot = (c_text.plain_text(facts[key]) for key in ("name", "base", "robot"))
    yield f"  {name}, on {base} of the {robot}"
    yield f"  joints: {joints}"


def _column_lines(columns: list[dict[str, Any]]) -> Iterator[str]:
    for index, column in enumerate(columns):
        bound = f", within {column['bound']:g}" if "bound" in column else ""
        unit = c_text.plain_text(column["unit"].replace("·", " ").replace("²", "^2"))
        yield f"  {index:3}  {c_text.plain_text(column['name'])} [{unit}]{bound}"


def _mirror_rows(mirror: Mirror | None, count: int) -> str:
    """Rows of a mirror's table; without a mirror a table that is never read."""
    if mirror is None:
        return ", ".join(["{0, 1.0, 0.0}"] * count)
    rows = zip(mirror.source, mirror.sign, mirror.offset, strict=True)
    return ", ".join(
        f"{{{source}, {c_text.number(sign)}, {c_text.number(offset)}}}"
        for source, sign, offset in rows
    )


def _layer_tables(layout: ResidualLayout, prefix: str) -> Iterator[str]:
    """Yield tables of the weights, a row per input, and of the biases."""
    for i in range(layout.num_layers):
        W: Array = np.ascontiguousarray(layout.tensors[f"weight{i}"].astype(np.float32).T)
        bias: Array = layout.tensors[f"bias{i}"].astype(np.float32)
        rows = ",\n".join(f"    {c_text.numbers(row)}" for row in W)
        yield f"static const float {prefix}_weight{i}_[{W.size}] = {{\n{rows}\n}};"
        yield f"static const float {prefix}_bias{i}_[{bias.size}] = {c_text.number_list(bias)};"


def _layer_calls(layout: ResidualLayout, prefix: str, widths: list[int]) -> Iterator[str]:
    """Yield the calls of the layers, from buffer x to y and back."""
    sizes = [len(layout.features), *widths]
    for i in range(layout.num_layers):
        source, target = _buffers(i)
        tables = f"{sizes[i]}, {prefix}_weight{i}_, {prefix}_bias{i}_, {sizes[i + 1]}"
        yield f"    {prefix}_affine_({source}, {tables}, {target});"
        if i < layout.num_layers - 1:
            yield f"    {prefix}_activate_({target}, {sizes[i + 1]});"


def _output_expression(layout: ResidualLayout, prefix: str) -> str:
    _, last = _buffers(layout.num_layers - 1)
    output = _OUTPUTS[layout.description.output].format(f"{last}[k]")
    return output.replace("residual_", f"{prefix}_")


def _buffers(layer: int) -> tuple[str, str]:
    """Buffers that a layer reads from and writes to."""
    return ("x", "y") if layer % 2 == 0 else ("y", "x")
