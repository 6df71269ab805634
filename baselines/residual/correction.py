"""A base policy corrected by a residual: what the residual acts on, and how fast it can change.

The residual is a number in [−1, 1] for every corrected joint, or for every pair of them, decided from the features of
`baselines.residual.features` once in `decision_period` control steps and passed through a first-order low-pass. It acts
in one of two spaces:

* `joint`: an offset of the command in rad, added to what the base commands;
* `model`: a relative change r of the deflection K⁻¹τ that the base compensates, (1 + r) δ, in the command and in the
  encoder readings alike. Zero means that the model is right.
"""

from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from baselines.compensation.policy import Action, ObservationView, Policy, taken_up
from elastic_env.core.config import MOST_ENTRIES, Model, Title, quantity
from elastic_env.core.errors import ConfigurationError, shown, unknown_name
from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.runtime.robot_model import RobotModel, WalkerModel

Space = Literal["joint", "model"]

_LARGEST_SCALE = 1e3
_DEFAULT_SCALE = {"joint": 0.02, "model": 0.6}


class ResidualSettings(Model):
    """How a residual acts and what it sees."""

    space: Space = "model"
    """What it acts on, see the module."""
    scale: float | dict[str, float] | None = None
    """Correction at a residual of 1, in rad for `joint`, relative for `model`; one for all joints, or by the end of the
    joints' names, as in {ankle_roll: 0.02}; None for 0.02 rad or 0.6."""
    decision_period: int = quantity("1", 25, ge=1, le=100_000, description="control steps between decisions")
    cutoff_hz: float = quantity(
        "Hz", 2.0, gt=0, le=1e6, description="cut-off of the first-order low-pass of the correction"
    )
    joints: Annotated[tuple[Title, ...], Field(min_length=1, max_length=MOST_ENTRIES)] | None = None
    """Joints that are corrected, by the end of their names (ankle_roll means both); None for all."""
    shared: bool = False
    """Whether left and right joints of the same name share their residual: there are half as many to explore, and one
    that follows the step still tells the legs apart by which of them carries the robot."""
    mirror: bool = False
    """Whether it sees a step on the right foot in the mirror, as a step on the left (`baselines.residual.mirror`). For
    a walker with `shared` corrections of the model, which are the same in the mirror."""
    cautious: bool = False
    """Whether it is played only as far as there is `evidence` that the model is wrong (`baselines.residual.evidence`),
    and else leaves the base alone. In training, under the wrappers of `train`, it acts freely. For a walker."""
    observe: tuple[Title, ...] = Field(default=("observation",), min_length=1, max_length=MOST_ENTRIES)
    """What it sees: groups of the observation such as (clock, load_share), or all of it, and what
    `baselines.residual.features` makes of it and of the plan."""
    history: int = quantity("1", 0, ge=0, le=1000, description="earlier decisions whose measurements it sees as well")

    @model_validator(mode="after")
    def _scales_are_positive(self) -> Self:
        scales = self.scale.values() if isinstance(self.scale, dict) else [1.0 if self.scale is None else self.scale]
        if not all(0.0 < scale <= _LARGEST_SCALE for scale in scales):
            raise ValueError(f"scale must be positive and at most {_LARGEST_SCALE:g}, got {shown(self.scale)}")
        return self

    @model_validator(mode="after")
    def _mirrored_corrections_are_alike(self) -> Self:
        if self.mirror and not (self.shared and self.space == "model"):
            raise ValueError(
                f"mirror needs corrections that are the same in the mirror: shared: true in space 'model', "
                f"got shared: {str(self.shared).lower()} in space {self.space!r}"
            )
        return self

    def corrected_joints(self, names: list[str]) -> IntArray:
        """Which of a robot's joints are corrected.

        Raises:
            ConfigurationError: A name fits no joint.
        """
        if self.joints is None:
            return np.arange(len(names))
        return np.flatnonzero(np.any([_fitting(wanted, names) for wanted in self.joints], axis=0))

    def residual_of(self, names: list[str]) -> IntArray:
        """Which of the residuals corrects each corrected joint, (k,)."""
        corrected = [names[joint] for joint in self.corrected_joints(names)]
        if self.shared:
            corrected = [name.removeprefix("l_").removeprefix("r_") for name in corrected]
        order = list(dict.fromkeys(corrected))
        return np.array([order.index(name) for name in corrected], dtype=np.int64)

    def scales(self, names: list[str]) -> Array:
        """Correction at a residual of 1 of every corrected joint, (k,).

        Raises:
            ConfigurationError: A name fits no joint, or a joint is left without a scale.
        """
        corrected = self.corrected_joints(names)
        if not isinstance(self.scale, dict):
            return np.full(len(corrected), _DEFAULT_SCALE[self.space] if self.scale is None else self.scale)
        scales = np.full(len(names), np.nan)
        for wanted, scale in self.scale.items():
            scales[_fitting(wanted, names)] = scale
        missing = [names[joint] for joint in corrected if np.isnan(scales[joint])]
        if missing:
            raise ConfigurationError(f"scale must have a value for every corrected joint, none fits {missing}")
        return scales[corrected]


def _fitting(wanted: str, names: list[str]) -> BoolArray:
    fits = np.array([name == wanted or name.endswith(f"_{wanted}") for name in names])
    if not fits.any():
        raise unknown_name("joint", wanted, names)
    return fits


class Corrected:
    """A base policy under a residual that somebody else decides.

    Memory per world: the correction behind the low-pass.

    Args:
        base: Any policy for `joint`, one that compensates (`baselines.Compensated`) for `model`.
        model: What may be known of the robot.
        settings: How the residual acts.

    Raises:
        ConfigurationError: `model` around a policy that compensates nothing, a joint that the robot has not, or caution
            without a walker.
    """

    def __init__(self, base: Policy, model: RobotModel, settings: ResidualSettings) -> None:
        if settings.space == "model" and not hasattr(base, "predict_corrected"):
            raise ConfigurationError(
                f"a residual in space 'model' corrects the deflection that its base compensates, and "
                f"{type(base).__name__} compensates none; use space 'joint', or a base such as input_output"
            )
        if settings.cautious and not isinstance(model, WalkerModel):
            raise ConfigurationError(
                f"cautious goes by how the legs of a walker bend, got a {type(model).__name__}; set cautious: false"
            )
        self.base, self.settings, self.model = base, settings, model
        self.joints = settings.corrected_joints(model.joint_names)
        self._residual = settings.residual_of(model.joint_names)
        self._scales, self._num_joints = settings.scales(model.joint_names), len(model.joint_names)
        self._share = 1.0 - float(np.exp(-2.0 * np.pi * settings.cutoff_hz * model.control_period_s))
        self._view = ObservationView(model.observation_table, model.control_period_s)

    @property
    def num_residuals(self) -> int:
        """Numbers that make up a residual, k."""
        return int(self._residual.max()) + 1

    def act(
        self, observation: Array, residual: Array, state: Any = None, episode_start: Any = None
    ) -> tuple[Action, Any]:
        """Action and new state under a residual, (num_worlds, k) within [−1, 1].

        A residual that has been zero since the start of the episode gives the base's action to the last bit.
        """
        rows = self._view.rows(observation)
        correction, inner = taken_up(
            state, episode_start, rows, self._view, lambda: np.zeros((len(rows), self._num_joints))
        )
        wanted = np.zeros_like(correction)
        wanted[:, self.joints] = self._scales * residual[:, self._residual]
        correction = correction + self._share * (wanted - correction)
        if self.settings.space == "model":
            action, inner = self.base.predict_corrected(observation, correction, inner, episode_start)  # type: ignore[attr-defined]
        else:
            action, inner = self.base.predict(observation, inner, episode_start, True)
            action = (action + correction.reshape(np.shape(action))).astype(np.float32)
        return action, (correction, inner)

    def base_action(self, observation: Array, state: Any, episode_start: Any) -> Action:
        """What the base alone would command now."""
        inner = None if state is None else state[1]
        return self.base.predict(observation, inner, episode_start, True)[0]

    def link_estimate(self, observation: Array, state: Any) -> Array:
        """Estimated link angle for an observation and the state that `act` returned for it, (..., n) [rad]."""
        return self.base.link_estimate(observation, state[1])  # type: ignore[attr-defined]
