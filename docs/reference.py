"""The reference pages that are written from the code, so that they can be read without a build:
environments, gains of policies, settings of hardware, and the help of commands.

    python -m docs.reference      # docs/lookup/*.md

A test compares pages and code.
"""

import contextlib
import io
import os
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import get_args
from unittest.mock import patch

import gymnasium
from pydantic.fields import FieldInfo

import baselines
from baselines.policy_options import PolicyOptions
from baselines.residual.settings import ResidualSettings
from elastic_env import IDS
from elastic_env.core.config import Model
from elastic_env.core.signals import Signal
from elastic_env.hardware.arm_settings import ArmSettings, ServoPlace
from elastic_env.hardware.settings import SafetyLimits
from elastic_env.world.robot_ranges import RobotRanges
from elastic_env.world.scenario import DISTRIBUTIONS, RANGES_BEYOND, TRAINING_RANGES, scenario_names
from train.commands.bench import BenchCase, BenchConfig
from train.commands.cli import COMMANDS, main
from train.commands.compare_config import CompareConfig
from train.commands.options import Mounting
from train.evaluate.conditions import PolicySpec
from train.learn.algorithm_options import MODELS
from train.learn.train_config import TrainConfig

PARTS = {
    "hardware": ("scan", "check", "run", "compensate", "log", "emulate"),
    "export": ("c", "onnx", "sb3"),
    "hub": ("push", "pull"),
}
"""Parts of commands, which have their help."""
FOLDER = Path(__file__).parent / "lookup"
_COLUMNS = "78"
"""Width of the terminal of the help."""


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _signals(signals: Iterable[Signal]) -> str:
    rows = ([str(i), f"`{s.name}`", s.unit, s.meaning] for i, s in enumerate(signals))
    return table(["column", "name", "unit", "meaning"], rows)


def known_scenarios(name: str) -> list[str]:
    """Scenarios of an environment by its short name; any robot has no IMU on a link."""
    names = [*scenario_names(walks=name == "walker"), *DISTRIBUTIONS]
    return [scenario for scenario in names if name != "robot" or scenario != "imu"]


def environments_page() -> str:
    """Every simulated environment: id, observation, action, metrics, from the declarations in
    the code.
    """
    parts = [
        "# Environments",
        "Written from the declarations in the code. [Options](../options.md) has all arguments.",
    ]
    for name, known in IDS.items():
        if name == "hardware":
            continue
        env = gymnasium.make(known, disable_env_checker=True).unwrapped
        task = env.task
        scenarios = ", ".join(f"`{scenario}`" for scenario in known_scenarios(name))
        metrics = ", ".join(f"`{metric.name}`" for metric in task.metrics)
        parts += [
            f"## `{known}`",
            (
                f"Control period {1e3 * task.num_substeps * task.model.opt.timestep:g} ms. On the"
                f" command line: `{name}`."
            ),
            f"**Scenarios**: {scenarios}.",
            "**Observation** (float64, one world):",
            _signals(task.observation_table),
            "**Action** (float32, one world), within the bounds of `env.action_space`:",
            _signals(task.action_table),
            f"**Episode metrics**, in `info['episode_metrics']` at the last step: {metrics}.",
        ]
        env.close()
    parts += [
        f"## `{IDS['hardware']}`",
        (
            "The testbed on a real servo, or an emulated one. Spaces and `info` are those of the"
            " simulated testbed. [Hardware](../hardware.md) has its arguments."
        ),
    ]
    return "\n\n".join(parts) + "\n"


def help_of(*words: str) -> str:
    """What `elastic WORDS --help` prints, without colours."""
    output = io.StringIO()
    with (
        patch.dict(os.environ, {"COLUMNS": _COLUMNS}),
        contextlib.redirect_stdout(output),
        contextlib.suppress(SystemExit),
    ):
        main([*words, "--help"])
    plain = re.sub(r"\x1b\[[0-9;]*m", "", output.getvalue()).rstrip()
    return "\n".join(
        textwrap.fill(line, 78, subsequent_indent="") if line[:1].isalpha() else line.rstrip()
        for line in plain.splitlines()
    )


def commands_page() -> str:
    """`--help` of every command."""
    parts = [
        "# Commands: help",
        "Output of `--help`. [Commands](../commands.md) has examples and durations.",
    ]
    for words in [
        *((command,) for command in COMMANDS.split() if command not in PARTS),
        *((command, part) for command, parts in PARTS.items() for part in parts),
    ]:
        parts += [f"## elastic {' '.join(words)}", f"```text\n{help_of(*words)}\n```"]
    return "\n\n".join(parts) + "\n"


def policy_table() -> str:
    """The table of `baselines.make`."""
    lines = [line.strip() for line in (baselines.make.__doc__ or "").splitlines()]
    return "\n".join(line for line in lines if line.startswith("|"))


def gains_page() -> str:
    """Every named policy and option, and every gain of the options that are mappings of gains."""
    intro = (
        "Written from the declarations in the code. [Options](../options.md#policies) says how"
        " they are given."
    )
    parts = ["# Policies, their options and gains", intro, "## Named policies", policy_table()]
    parts.append(_model(PolicyOptions, "Options"))
    for option, field in PolicyOptions.model_fields.items():
        models = [
            kind for kind in (field.annotation, *get_args(field.annotation)) if _is_model(kind)
        ]
        parts += [_model(model, option) for model in models]
    return "\n\n".join(parts) + "\n"


def configurations_page() -> str:
    """Every key of the configurations of comparisons, trainings and benches."""
    intro = (
        "Written from the declarations in the code. [Options](../options.md) explains the"
        " environments, and [Training](../training.md) the settings."
    )
    parts = [
        _model(CompareConfig, "Comparisons: elastic compare"),
        _model(PolicySpec, "policies"),
        _model(TrainConfig, "Trainings: elastic train"),
        _model(ResidualSettings, "settings"),
        _model(BenchConfig, "Figures in CI: elastic bench"),
        _model(BenchCase, "cases"),
    ]
    parts.append(_ranges())
    for algorithm, model in MODELS.items():
        parts.append(_model(model, f"Options of {algorithm}"))
        network = model.model_fields.get("policy_kwargs")
        if network and _is_model(network.annotation):
            parts.append(_model(network.annotation, f"Options of {algorithm}: policy_kwargs"))
    return "\n\n".join(["# Keys of configurations", intro, *parts]) + "\n"


def mountings_page() -> str:
    """Every key of the files that say how real hardware is mounted, with bounds."""
    intro = (
        "Written from the declarations in the code. A value beyond its bounds is refused."
        " [Hardware](../hardware.md) has examples."
    )
    testbed, arm = "A file of the testbed", "A file of an arm"
    parts = [
        _model(Mounting, testbed),
        _model(SafetyLimits, "limits"),
        _model(ArmSettings, arm),
        _model(ServoPlace, "joints"),
    ]
    return "\n\n".join(["# Mounting files", intro, *parts]) + "\n"


def _model(model: type[Model], title: str) -> str:
    """Name, default, bounds and meaning of every field, under a title."""
    shown = title if title[0].isupper() else f"`{title}`"
    about = (model.__doc__ or "").partition("\n")[0]
    rows = [_parameter(name, parameter) for name, parameter in model.model_fields.items()]
    head = ["name", "default", "bounds", "meaning"]
    return "\n\n".join([f"## {shown}", about, table(head, rows)])


def _ranges() -> str:
    """Ranges from which robots are drawn."""
    rows = []
    for name, parameter in RobotRanges.model_fields.items():
        *_, meaning = _parameter(name, parameter)
        beyond = "; ".join(_range(own[name]) for own in RANGES_BEYOND if name in own)
        rows.append([f"`{name}`", _range(getattr(TRAINING_RANGES, name)), beyond, meaning])
    about = (
        "`drawn` takes every quantity from its range. A robot of `drawn_beyond` has one quantity"
        " from beyond."
    )
    head = ["name", "`drawn`", "`drawn_beyond`", "meaning"]
    return "\n\n".join(["## Ranges of drawn robots", about, table(head, rows)])


def _range(value: float | tuple[float, float]) -> str:
    low, high = value if isinstance(value, tuple | list) else (value, value)
    return f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"


def _is_model(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, Model)


def _parameter(name: str, field: FieldInfo) -> list[str]:
    """Name, default, bounds and meaning of a parameter."""
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    found = [
        (sign, getattr(bound, key, None)) for bound in field.metadata for key, sign in signs.items()
    ]
    bounds = ", ".join(f"{sign} {value:g}" for sign, value in found if value is not None)
    default = "required" if field.is_required() else _value(field.default)
    meaning = re.sub(r"(?<!\S)(--[\w-]+)", r"`\1`", " ".join((field.description or "").split()))
    return [f"`{name}`", default, bounds, meaning]


def _value(value: object) -> str:
    """A default as a configuration writes it; of a model, what differs from its own defaults."""
    match value:
        case None:
            return "null"
        case bool():
            return str(value).lower()
        case float():
            return f"{value:.4g}"
        case Model():
            fields = type(value).model_fields.items()
            given = ((name, getattr(value, name), field.default) for name, field in fields)
            return _value({name: one for name, one, default in given if one != default})
        case list() | tuple():
            return f"[{', '.join(map(_value, value))}]"
        case dict():
            return f"{{{', '.join(f'{key}: {_value(one)}' for key, one in value.items())}}}"
        case _:
            return str(value)


PAGES: Mapping[str, Callable[[], str]] = {
    "environments.md": environments_page,
    "configurations.md": configurations_page,
    "gains.md": gains_page,
    "mountings.md": mountings_page,
    "help.md": commands_page,
}
"""The pages by the names of their files."""


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, page in PAGES.items():
        (FOLDER / name).write_text(page(), encoding="utf-8")
