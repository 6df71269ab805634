"""A base policy corrected by a residual: what the residual acts on, how fast it can change, what it is decided by.

The residual is a number in [−1, 1] for every corrected joint, decided once in `decision_period` control steps and
passed through a first-order low-pass. It acts in one of two spaces:

* `joint`: an offset of the command in rad, added to what the base commands;
* `model`: a relative change r of the deflection K⁻¹τ that the base compensates, (1 + r) δ, in the command and in the
  encoder readings alike. Zero means that the model is right.
"""

from collections.abc import Callable
from typing import Any, Literal, Self

import numpy as np
from pydantic import model_validator

from baselines.policy import Action, ObservationView, Policy, resume
from elastic_env.config import Model, quantity
from elastic_env.errors import ConfigurationError, unknown_name
from elastic_env.robots.robot_model import RobotModel, WalkerModel
from elastic_env.robots.thormang import SIDES
from elastic_env.signals import Array, BoolArray, IntArray
from elastic_env.walking.ground_contact import FootSensors, zero_moment_point

Space = Literal["joint", "model"]

_DEFAULT_SCALE = {"joint": 0.02, "model": 0.6}
_WITH_OFFSETS = ("imu_attitude", "wrench")
_MEASUREMENTS = ("encoder_angle", "encoder_rate", "imu_attitude", "imu_rate", "wrench", "link_angle_imu")


class ResidualSettings(Model):
    """How a residual acts and what it sees."""

    space: Space = "model"
    """What it acts on, see the module."""
    scale: float | dict[str, float] | None = None
    """Correction at a residual of 1, in rad for `joint`, relative for `model`; one for all joints, or by the end of the
    joints' names, as in {ankle_roll: 0.02}; None for 0.02 rad or 0.6."""
    decision_period: int = quantity("1", 25, ge=1, description="control steps between decisions")
    cutoff_hz: float = quantity("Hz", 2.0, gt=0, description="cut-off of the first-order low-pass of the correction")
    joints: tuple[str, ...] | None = None
    """Joints that are corrected, by the end of their names (ankle_roll means both); None for all."""
    observe_base_action: bool = False
    """Whether it sees what the base alone would command, beside the observation."""
    observe_errors: bool = False
    """Whether it sees differences to the plan too, which are small beside the observation: encoders less reference
    angles, and on the walker the measured ZMP and load share less the planned ones."""
    detrend_s: float | None = quantity(
        "s",
        None,
        gt=0,
        description="time constant of slow means taken off attitude and wrenches",
    )
    """So that the residual sees how they change over a step, as they do where a model is wrong, and not what a slope or
    a mounting error adds to them for good; None for what is measured."""
    history: int = quantity("1", 0, ge=0, description="measurements of earlier decisions that it sees as well")

    @model_validator(mode="after")
    def _scales_are_positive(self) -> Self:
        scales = self.scale.values() if isinstance(self.scale, dict) else [1.0 if self.scale is None else self.scale]
        if not all(0.0 < scale < np.inf for scale in scales):
            raise ValueError(f"scale must be positive, got {self.scale}")
        return self

    def corrected_joints(self, names: list[str]) -> IntArray:
        """Which of a robot's joints are corrected.

        Raises:
            ConfigurationError: A name fits no joint.
        """
        if self.joints is None:
            return np.arange(len(names))
        return np.flatnonzero(np.any([_fitting(wanted, names) for wanted in self.joints], axis=0))

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
        ConfigurationError: `model` around a policy that compensates nothing, or a joint that the robot has not.
    """

    def __init__(self, base: Policy, model: RobotModel, settings: ResidualSettings) -> None:
        if settings.space == "model" and not hasattr(base, "predict_corrected"):
            raise ConfigurationError(
                f"a residual in space 'model' corrects the deflection that its base compensates, and "
                f"{type(base).__name__} compensates none; use space 'joint', or a base such as input_output"
            )
        self.base, self.settings, self.model = base, settings, model
        self.joints = settings.corrected_joints(model.joint_names)
        self._scales, self._num_joints = settings.scales(model.joint_names), len(model.joint_names)
        self._share = 1.0 - float(np.exp(-2.0 * np.pi * settings.cutoff_hz * model.control_period_s))
        self._view = ObservationView(model.observation_table, model.control_period_s)

    @property
    def num_corrected(self) -> int:
        """Joints that are corrected, k."""
        return len(self.joints)

    def act(
        self, observation: Array, residual: Array, state: Any = None, episode_start: Any = None
    ) -> tuple[Action, Any]:
        """Action and new state under a residual, (num_worlds, k) within [−1, 1].

        A residual that has been zero since the start of the episode gives the base's action to the last bit.
        """
        rows = self._view.rows(observation)
        correction, inner = resume(
            state, episode_start, rows, self._view, lambda: np.zeros((len(rows), self._num_joints))
        )
        wanted = np.zeros_like(correction)
        wanted[:, self.joints] = self._scales * residual
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
        correction, inner = state
        if self.settings.space == "model":
            return self.base.link_estimate(observation, inner, correction)  # type: ignore[attr-defined]
        return self.base.link_estimate(observation, inner)  # type: ignore[attr-defined]


class Features:
    """What a residual is decided by: the observation, and what `ResidualSettings` asks for beside it.

    Their order is observation, errors, base action, earlier measurements.

    Memory per world: the measurements of the last decisions, the latest first, and slow means.

    Args:
        corrected: The base and its correction.
    """

    def __init__(self, corrected: Corrected) -> None:
        self._corrected, settings, table = corrected, corrected.settings, corrected.model.observation_table
        kinds = [name.split(".")[0] for name in table.names]
        measured = [i for i, kind in enumerate(kinds) if kind in _MEASUREMENTS]
        self._measured, self._history = np.array(measured), settings.history
        action = len(corrected.model.joint_names) if settings.observe_base_action else 0
        self._errors = _errors_of(corrected.model) if settings.observe_errors else []
        errors = [error(np.zeros((1, len(table)))).shape[1] for error in self._errors]
        slow = [i for i, kind in enumerate(kinds) if kind in _WITH_OFFSETS]
        slow += [len(table) + i for i in range(sum(errors[:1]), sum(errors))]  # all but those of the encoders
        self._slow = np.array(slow if settings.detrend_s is not None else [], dtype=np.int64)
        period_s = settings.decision_period * corrected.model.control_period_s
        self._gain = 1.0 if settings.detrend_s is None else 1.0 - float(np.exp(-period_s / settings.detrend_s))
        self.width = len(table) + sum(errors) + action + self._history * len(measured)
        self.memory_width = self._history * len(measured) + len(self._slow)

    def at(
        self, rows: Array, memory: Array | None, fresh: BoolArray, state: Any, episode_start: Any
    ) -> tuple[Array, Array]:
        """Features of a decision, and the memory for the next one.

        Args:
            rows: Observations, (num_worlds, m).
            memory: That of the last decision, (num_worlds, memory_width); None at the first.
            fresh: Worlds that decide for the first time in their episode.
            state: State of the corrected policy.
            episode_start: Worlds whose episode begins, for the policy.

        Returns:
            (num_worlds, width) and (num_worlds, memory_width).
        """
        seen = np.concatenate([rows, *(error(rows) for error in self._errors)], axis=1)
        slow, past = self._remembered(seen, memory, fresh)
        seen[:, self._slow] -= slow
        measured = seen[:, self._measured]
        past = np.tile(measured, (1, self._history)) if past is None else past
        past = np.where(fresh[:, None], np.tile(measured, (1, self._history)), past)
        parts = [seen]
        if self._corrected.settings.observe_base_action:
            parts.append(np.asarray(self._corrected.base_action(rows, state, episode_start), dtype=np.float64))
        remembered = np.concatenate([measured, past], axis=1)[:, : past.shape[1]]
        return np.concatenate([*parts, past], axis=1), np.concatenate([remembered, slow], axis=1)

    def _remembered(self, seen: Array, memory: Array | None, fresh: BoolArray) -> tuple[Array, Array | None]:
        """Slow means of now, and the measurements of earlier decisions."""
        now = seen[:, self._slow]
        if memory is None:
            return now, None
        past, slow = np.split(memory, [memory.shape[1] - len(self._slow)], axis=1)
        return np.where(fresh[:, None], now, slow + self._gain * (now - slow)), past


def _errors_of(model: RobotModel) -> list[Callable[[Array], Array]]:
    """Differences between measurement and plan as functions of observations, (num_worlds, m) to (num_worlds, k)."""
    encoder, reference = (model.observation_table.group(name) for name in ("encoder_angle", "reference_angle"))
    errors: list[Callable[[Array], Array]] = [lambda rows: rows[:, encoder] - rows[:, reference]]
    return [*errors, _ContactErrors(model)] if isinstance(model, WalkerModel) else errors


class _ContactErrors:
    """ZMP [m] and load share by the foot wrenches, as if the feet lay flat on their footholds, less the planned ones.

    Zero where the feet carry too little for a ZMP.
    """

    _LEAST_N = 50.0

    def __init__(self, model: WalkerModel) -> None:
        table, biped = model.observation_table, model.biped
        self._wrench, self._share, self._zmp = (table.group(n) for n in ("wrench", "load_share", "zmp_reference"))
        rigid = biped.rigid
        feet = [rigid.body(f"{side}_foot").id for side in SIDES]
        self._sensors = FootSensors(rigid.body_mass[feet], rigid.body_ipos[feet], rigid.opt.gravity)
        self._ankles = biped.ankles

    def __call__(self, rows: Array) -> Array:
        wrench = rows[:, self._wrench].reshape(-1, 2, 2, 3)
        force, moment = self._sensors.ground_wrench(wrench, np.broadcast_to(np.eye(3), (len(rows), 2, 3, 3)))
        zmp = zero_moment_point(force, moment, self._ankles, self._LEAST_N) - rows[:, self._zmp]
        vertical = force[:, :, 2].sum(axis=1)
        share = force[:, 1, 2] / np.where(vertical >= self._LEAST_N, vertical, np.nan) - rows[:, self._share][:, 0]
        return np.nan_to_num(np.column_stack([zmp, share]), nan=0.0)
