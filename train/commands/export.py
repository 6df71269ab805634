"""`elastic export`: compensators and residuals for other programs, SB3's models as residuals."""

from collections.abc import Mapping
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

import baselines
from baselines import PositionCompensator
from baselines.residual.settings import RESIDUAL
from elastic_env.core.config import Locator, Model, Title, quantity
from elastic_env.core.errors import ConfigurationError, ResultsExistError, shorten
from elastic_env.core.files import is_file, write_whole
from elastic_env.joint.model_text import name_of, read_bytes
from train.commands.options import StiffnessOrFile, given_options
from train.export.c_arm import c_header, held_text
from train.export.c_text import c_example, prefix_of, require_prefix

_WALKER_POLICIES = ("input_output", "adaptive_posture")
"""Policies of a walker that can be exported to C."""
_ARM_OPTIONS = ["joints", "order", "position_gain", "limit_rad", "ramp_s", "period_s", "friction"]


class Output(Model):
    """Options for the file of an export."""

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """File to write; default the name of what is exported, in the working folder."""
    overwrite: bool = False
    """Replace existing files."""

    def write(self, files: Mapping[Path, str | bytes], console: Console) -> None:
        """Write files; the folder of the first one must exist.

        Raises:
            ResultsExistError: A file exists and must not be replaced; nothing is written.
            ConfigurationError: The folder does not exist.
        """
        folder = next(iter(files)).parent
        if not folder.is_dir():
            problem = f"no folder {shorten(folder)}; make it, or name another by --output"
            raise ConfigurationError(problem)
        for path in files:
            if path.exists() and not self.overwrite:
                cure = "add --overwrite, or name another file by --output"
                raise ResultsExistError(f"{shorten(path)} exists; {cure}")
        for path, content in files.items():
            path.parent.mkdir(exist_ok=True)
            write_whole(path, content)
            console.print(f"wrote {path}")


class C(Output):
    """A header in C99, without a heap: an arm's compensator, a walker's, a residual's network.

    The header of an arm has the functions of `PositionCompensator`: command, link_angle, torque,
    payload, ramp, limits and friction. Call begin(&arm) once, then command(&arm, q, q_dot, q_ddot,
    out). The first lines give units, signs, version and digests. The macro PREFIX_TEST adds a test
    vector, see docs/export.md.

    Example: elastic export c arm.urdf --joints joints.yaml -o arm.h

    Example, with a program that checks and times it: elastic export c arm.urdf --joints joints.yaml
        --ramp-s 1 --period-s 0.002 --example

    Example, of a residual: elastic export c residual:testbed/seed_0 -o net.h

    Example, of a policy of the walker: elastic export c adaptive_posture -o walker.h
    """

    model: Annotated[Locator, tyro.conf.Positional]
    """File of MJCF (.xml) or URDF (.urdf) of a robot on a fixed base, residual:PATH, or
    input_output or adaptive_posture, policies of the walker.
    """
    joints: StiffnessOrFile = None
    """YAML file of the elastic joints of an arm (elastic identify --robot writes one), or one K of
    all hinges [N·m/rad].
    """
    order: list[Title] = []
    """Commanded joints, in the order of the arrays; default all joints that are not held, in the
    order of the model.
    """
    position_gain: float | None = None
    """k_p of servos that give way under a load [N·m/rad], one for all; default the value in the
    file of joints.
    """
    limit_rad: float = quantity("rad", 0.2, gt=0)
    """Largest offset between command and desired angle [rad]."""
    ramp_s: float = quantity("s", 0.0, ge=0)
    """Time in which offsets grow from zero, and in which a payload takes effect [s]."""
    period_s: float = quantity("s", 0.01, gt=0)
    """Time between two commands [s]."""
    friction: bool | None = None
    """Compensate dry friction; default only if some of it grows with the load."""
    prefix: str | None = None
    """Prefix of all names in the header; default the name of the model's file or the residual."""
    env: Locator | None = None
    """Environment of a residual or of a walker's policy, as in elastic export onnx."""
    example: bool = False
    """Write a folder PREFIX_example next to the header: a program that checks the header against
    Python and times it, and its CMakeLists.txt.
    """

    def run(self, console: Console) -> None:
        """Write the header, and the example if it is wanted."""
        program = "arm"
        name = Path(self.model).stem
        if self.model.startswith(RESIDUAL):
            program = "residual"
            name = _short_name(self.model)
        elif self.model in _WALKER_POLICIES:
            program = name = "walker"
        elif self.model in baselines.policy_names() and not is_file(self.model):
            raise ConfigurationError(
                f"the policy {self.model} cannot be exported to C; policies that can:"
                f" {', '.join(_WALKER_POLICIES)}, {RESIDUAL}PATH"
            )
        if unused := given_options(self, ["env"] if program == "arm" else _ARM_OPTIONS):
            raise ConfigurationError(
                f"{', '.join(unused)}: without effect on {shorten(self.model)}; leave it out"
            )
        prefix = prefix_of(name) if self.prefix is None else require_prefix(self.prefix)
        output = self.output or Path(f"{prefix}.h")
        headers = {
            "arm": partial(self._arm, console),
            "residual": self._residual,
            "walker": self._walker,
        }
        files = {output: headers[program](prefix)}
        if self.example:
            folder = output.with_name(f"{prefix}_example")
            example = c_example(program, prefix, f"../{output.name}")
            files |= {folder / file: text for file, text in example.items()}
        self.write(files, console)

    def _residual(self, prefix: str) -> str:
        """Return the header of a residual."""
        from train.export.c_residual import c_residual
        from train.export.residual_layout import ResidualLayout

        return c_residual(ResidualLayout.load(self.model, self.env), prefix)

    def _walker(self, prefix: str) -> str:
        """Return the header of a walker's policy."""
        from train.evaluate.conditions import Condition, PolicySpec
        from train.evaluate.rollout import make_vector_env
        from train.export.c_walker import c_walker

        condition = Condition(env=self.env or "walker", policy=PolicySpec(name=self.model))
        with closing(make_vector_env(condition, num_envs=1, num_threads=1)) as worlds:
            return c_walker(baselines.make(self.model, worlds), prefix)

    def _arm(self, console: Console, prefix: str) -> str:
        """Return the header of an arm, and print which joints are held."""
        if not is_file(self.model):
            raise ConfigurationError(
                f"no model at {name_of(self.model)}; give a file of MJCF (.xml) or URDF (.urdf)"
            )
        if self.joints is None:
            raise ConfigurationError(
                "an arm needs the stiffness of its joints: name a file by --joints joints.yaml, or"
                " one K of all hinges [N·m/rad] by --joints 400"
            )
        compensator = PositionCompensator.from_model(
            self.model,
            self.joints,
            joints=self.order or None,
            position_gain=self.position_gain,
            limit_rad=self.limit_rad,
            ramp_s=self.ramp_s,
            period_s=self.period_s,
            friction=self.friction,
        )
        if held := held_text(compensator.joints, compensator.constants):
            console.print(held)
        files = [self.model, *([self.joints] if isinstance(self.joints, str) else [])]
        sources = {Path(file).name: read_bytes(Path(file)) for file in files}
        return c_header(compensator, prefix, sources)


class Onnx(Output):
    """A residual as one graph of ONNX, with normalisation, mirror and bounds, and a test vector.

    The input `features` has a column for each feature of the residual. The metadata of the file
    contain their names and units, the columns of the output, periods, version and digest. A second
    file, .npz, has inputs and the outputs of Python. docs/export.md describes the program that
    calls the graph.

    Example: elastic export onnx residual:testbed/seed_0 -o testbed.onnx

    Example, of a robot of your own: elastic export onnx residual:runs/mine/seed_0/last
        --env arm.yaml
    """

    residual: Annotated[Locator, tyro.conf.Positional]
    """residual:PATH, a folder or the name of a residual that comes with the package."""
    env: Locator | None = None
    """Environment of the residual, ROBOT.yaml or FILE.py:ROBOT; default the environment of the
    package that the residual names.
    """

    def run(self, console: Console) -> None:
        """Write the graph and its test vector."""
        from train.export.onnx_residual import onnx_model, played_vector
        from train.export.residual_layout import ResidualLayout

        layout = ResidualLayout.load(self.residual, self.env)
        output = self.output or Path(f"{_short_name(self.residual)}.onnx")
        if output.suffix != ".onnx":
            raise ConfigurationError(f"a graph of ONNX is a file .onnx, got {shorten(output)}")
        vector = output.with_suffix(".npz")
        self.write({output: onnx_model(layout), vector: played_vector(layout)}, console)


def _short_name(residual: str) -> str:
    """Return a name from the last two folders of a residual, such as testbed_seed_0."""
    return prefix_of("_".join(Path(residual.partition(":")[2]).parts[-2:]))


class Sb3(Model):
    """Turn a model of Stable-Baselines3 into a residual folder, which plays without torch.

    Loading the folder runs no code.

    Example: elastic export sb3 model.zip train_walker_3s --normaliser normaliser.pkl
        --trust-pickle
    """

    model: Annotated[Path, tyro.conf.Positional]
    """Zip of model.save()."""
    config: Annotated[Path, tyro.conf.Positional]
    """Configuration of its training, a file or a preset: algorithm, base, settings."""
    normaliser: Path | None = None
    """File of VecNormalize.save(); leave it out where observations were not normalised."""
    trust_pickle: bool = False
    """Load the model although it is a pickle, which can run code."""
    output: Path | None = None
    """Folder for the residual, new or empty; default runs/<name of the zip>, numbered if taken."""

    def run(self, console: Console) -> None:
        """Write the residual folder."""
        # these need torch, the other exports do not
        from elastic_env.core.config import load_yaml
        from train.learn.export import export_zip
        from train.learn.train_config import TrainConfig
        from train.runs.folders import result_folder
        from train.runs.presets import find_configuration

        config = load_yaml(find_configuration(self.config, "training"), TrainConfig)
        with result_folder(self.model.stem, self.output) as folder:
            export_zip(self.model, config, folder, self.normaliser, self.trust_pickle)
        console.print(f"play it as residual:{folder}")


class Export(Model):
    """Give compensators and residuals to other programs, and models of SB3 to this one.

    c: an arm's compensator as a header in C99. onnx: a residual as a graph. sb3: a model of
    Stable-Baselines3 as a residual.
    """

    command: C | Onnx | Sb3

    def run(self, console: Console) -> None:
        """Run the subcommand."""
        self.command.run(console)
