"""Layout of a residual for exports: features, network, mirror and bounds, as plain arrays."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, Self

import numpy as np

import baselines
import elastic_env
from baselines.residual.mirror import Mirror
from baselines.residual.network import Network, Tensors
from baselines.residual.residual_folder import WEIGHTS, find_folder, load_residual
from baselines.residual.settings import RESIDUAL, ResidualDescription
from elastic_env.core.errors import ConfigurationError, quote
from elastic_env.core.signals import Array, BoolArray, IntArray, Signal
from elastic_env.core.tensors import read_tensors
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.environments import ENVIRONMENTS
from train.evaluate.rollout import make_vector_env

_HEAVY_TAIL = 3.0
"""Degrees of freedom of random features: two of a thousand are beyond ten standard deviations."""


@dataclass(frozen=True)
class ResidualLayout:
    """A residual's features, network, mirror and bounds.

    Attributes:
        name: Name of its policy, such as residual:testbed/seed_0.
        description: Content of its `residual.json`.
        network: Maps features to numbers within [−1, 1].
        tensors: Weights of the network.
        weights_sha256: Digest of their file.
        features: Columns that it sees; `NAME@-k` is a measurement of k decisions ago.
        residual: Numbers that it decides.
        columns: Columns of its base's inputs, on which it acts.
        bounds: Bounds of these columns, (columns,); zero where it does not act.
        source: Index of the residual that each column follows, (columns,).
        mirrors: Mirrors of features and residual in steps on the right foot; None without.
        control_period_s: Time between two commands [s].
    """

    name: str
    description: ResidualDescription
    network: Network
    tensors: Tensors
    weights_sha256: str
    features: tuple[Signal, ...]
    residual: tuple[Signal, ...]
    columns: tuple[Signal, ...]
    bounds: Array
    source: IntArray
    mirrors: tuple[Mirror, Mirror] | None
    control_period_s: float

    @classmethod
    def load(cls, name: str, env: str | None = None) -> Self:
        """Load the layout of a residual in the environment that it was trained in.

        Args:
            name: residual:PATH, a folder or the name of one that comes with the package.
            env: Environment, see `train.evaluate.environments.environment`; None for the one of the
                package that the residual names.

        Raises:
            ConfigurationError: There is no such residual, it sees the truth, or its environment is
                unknown.
        """
        if not name.startswith(RESIDUAL):
            raise ConfigurationError(
                f"a residual must be named residual:PATH, got {quote(name)}; such as"
                " residual:testbed/seed_0, or residual:FOLDER"
            )
        folder = find_folder(Path(name.removeprefix(RESIDUAL)))
        description, network = load_residual(folder)
        if description.settings.privileged:
            seen = ", ".join(description.settings.privileged)
            raise ConfigurationError(
                f"{name} is a teacher, which sees the true {seen}, and no residual for a robot"
            )
        with closing(_make_world(description, env)) as worlds:
            policy: Any = baselines.make(name, worlds)
        tensors, content = read_tensors(folder / WEIGHTS)
        channels = policy.corrected.channels
        mirror = policy.features.mirror
        return cls(
            name=name,
            description=description,
            network=network,
            tensors=tensors,
            weights_sha256=sha256(content).hexdigest(),
            features=policy.features.columns,
            residual=channels.signals,
            columns=channels.columns,
            bounds=channels.bounds,
            source=channels.source,
            mirrors=None if mirror is None else (mirror.of_features, mirror.of_residual),
            control_period_s=policy.corrected.model.control_period_s,
        )

    @property
    def num_layers(self) -> int:
        """Layers of the network."""
        return sum(name.startswith("weight") for name in self.tensors)

    def decide(self, features: Array, on_right: BoolArray) -> tuple[Array, Array]:
        """Residual and correction of a decision, (N, k) and (N, columns).

        Args:
            features: Features before the mirror, (N, width).
            on_right: True if the step is on the right foot, (N, 1); without a mirror it has no
                effect.
        """
        if self.mirrors is not None:
            features = np.where(on_right, self.mirrors[0](features), features)
        residual = self.network(features)
        if self.mirrors is not None:
            residual = np.where(on_right, self.mirrors[1](residual), residual)
        return residual, self.bounds * residual[:, self.source]

    def draw(self, count: int, seed: int = 0) -> dict[str, Any]:
        """Draw random arguments of `decide`; some features are beyond the bound of the network."""
        generator = np.random.default_rng(seed)
        normalised = generator.standard_t(_HEAVY_TAIL, (count, len(self.features)))
        features = self.tensors["mean"] + self.tensors["std"] * normalised
        on_right = generator.random((count, 1)) < 0.5
        if self.mirrors is not None:  # `decide` mirrors them back
            features = np.where(on_right, self.mirrors[0](features), features)
        return {"features": features, "on_right": on_right}

    def facts(self) -> dict[str, Any]:
        """Facts that a user of the export needs, in types of JSON."""
        settings = self.description.settings
        turns = settings.cutoff_hz * self.control_period_s
        columns = _signal_records(self.columns)
        for column, bound in zip(columns, self.bounds.tolist(), strict=True):
            column["bound"] = bound
        return {
            "elastic_env": elastic_env.__version__,
            "name": self.name,
            "weights_sha256": self.weights_sha256,
            "robot": self.description.robot,
            "joints": self.description.joints,
            "base": self.description.base,
            "base_options": self.description.base_options,
            "control_period_s": self.control_period_s,
            "decision_period": settings.decision_period,
            "cutoff_hz": settings.cutoff_hz,
            "share_per_control_step": 1.0 - float(np.exp(-2.0 * np.pi * turns)),
            "features": _signal_records(self.features),
            "residual": _signal_records(self.residual),
            "correction": columns,
        }


def _signal_records(signals: Sequence[Signal]) -> list[dict[str, Any]]:
    keys = ("name", "unit", "meaning")
    return [{key: asdict(signal)[key] for key in keys} for signal in signals]


def _make_world(description: ResidualDescription, env: str | None) -> Any:
    """Make one world of the environment of a residual."""
    name = description.robot if env is None else env
    if env is None and name not in ENVIRONMENTS:
        raise ConfigurationError(
            f"the residual is for {quote(name)}, which is no environment of the package"
            f" ({', '.join(ENVIRONMENTS)}); name its environment by --env ROBOT.yaml or"
            " FILE.py:ROBOT"
        )
    trained: Any = description.training.get("config", {})
    condition = Condition(
        env=name,
        policy=PolicySpec(name=description.base),
        reference=trained.get("reference"),
        env_options=trained.get("env_options", {}),
    )
    return make_vector_env(condition, num_envs=1, num_threads=1)
