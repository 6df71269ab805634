"""A residual with an untrained network, which costs as much time as a trained one."""

import itertools
from typing import Any

import numpy as np

from baselines.compensation.inputs import COMMAND, DEFLECTION, inputs_of
from baselines.residual.correction import Corrected
from baselines.residual.features import Features
from baselines.residual.network import Network
from baselines.residual.residual_policy import ResidualPolicy
from baselines.residual.settings import ResidualDescription, ResidualSettings


def untrained_residual(base: Any, env: Any) -> ResidualPolicy:
    """Return a residual on a base policy: an untrained network, 64×64, small random weights."""
    model = env.unwrapped.assumed_model
    corrected = Corrected(base, model, ResidualSettings(acts_on=residual_input(base)))
    features = Features(corrected).width
    generator = np.random.default_rng(0)
    tensors = {"mean": np.zeros(features), "std": np.ones(features)}
    widths = itertools.pairwise([features, 64, 64, corrected.num_residuals])
    for i, (inputs, outputs) in enumerate(widths):
        tensors[f"weight{i}"] = 0.01 * generator.normal(size=(outputs, inputs))
        tensors[f"bias{i}"] = np.zeros(outputs)
    robot = env.unwrapped.task.name
    description = ResidualDescription(robot=robot, base="", settings=corrected.settings)
    return ResidualPolicy(corrected, Network(description, tensors))


def residual_input(base: Any) -> dict[str, Any]:
    """Return the input of a base on which a residual acts, with its default bound (None)."""
    return {DEFLECTION if DEFLECTION in inputs_of(base) else COMMAND: None}
