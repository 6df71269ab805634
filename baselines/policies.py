"""The baselines as policies: anything with `predict(observation, state, episode_start, deterministic)`.

Compensation is a wrapper: `Compensated(policy, compensator)` adds the input compensation to whatever a policy commands
and shows it compensated encoder readings. The named policies are such compositions, see `make`.

Policies take observations of one world, (m,), or of many, (num_worlds, m). Those with memory keep it in `state`, one
row per world: pass the returned state back, and `episode_start` where episodes begin, as Stable-Baselines3 does.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from baselines.compensators import Compensator, DynamicCompensator, GravityCompensator, Motion, OutputMethod
from baselines.gravity_torque import GravityMethod
from elastic_env.config import Model, quantity
from elastic_env.errors import ConfigurationError, ElasticError, unknown_name
from elastic_env.references import STAND_S, quintic
from elastic_env.robots.robot_model import RobotModel, read_stiffness
from elastic_env.signals import Array, BoolArray, SignalTable

Action = npt.NDArray[np.float32]


class Policy(Protocol):
    """Commands the robot; a Stable-Baselines3 model is one too."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        """Action and new state for an observation."""
        ...


class PolicyOptions(Model):
    """Options of the named policies, as keyword arguments of `make`."""

    stiffness: float | list[float] | str | Path | None = None
    """K that the compensator assumes [N·m/rad], or the path of an identification; None for the env's assumed model."""
    output: OutputMethod = "taylor"
    """Output compensator: "taylor" for Eq. 12, "newton" for Eq. 10."""
    gravity: GravityMethod = "pinocchio"
    """How τ_g is computed: "pinocchio" row by row, or "batched" in NumPy."""
    ramp_s: float = quantity("s", STAND_S, gt=0, description="time in which the compensation grows from zero")


class Zero:
    """Plays the reference back: no offset, no memory, and it takes the encoder for the link."""

    def __init__(self, table: SignalTable) -> None:
        self._encoder = table.columns("encoder_angle")

    def predict(
        self,
        observation: Array,
        state: Any = None,
        episode_start: Any = None,  # noqa: ARG002  the interface's
        deterministic: bool = True,  # noqa: ARG002
    ) -> tuple[Action, Any]:
        """Zero offset, (..., n)."""
        return np.zeros(observation[..., self._encoder].shape, dtype=np.float32), state

    def link_estimate(self, observation: Array, state: Any) -> Array:  # noqa: ARG002
        """The encoder angle, (..., n) [rad]."""
        return observation[..., self._encoder]


class Compensated:
    """Any policy with joint elasticity compensated around it (Fig. 2 of the paper).

    The wrapped policy's action is the offset of the link angle it wants, q_d = q_ref + a. It sees the estimated link
    angle and rate where the observation has the encoder's; the compensator's offset for q_d is added to its action.
    The compensation grows from zero in the first `ramp_s` of an episode, while the reference stands.

    Args:
        policy: Anything with `predict`; its state may be anything.
        compensator: Where the motor has to lead, and where the link is.
        table: Observation table of the environment, `env.unwrapped.task.observation_table`.
        control_period_s: Time between observations.
        ramp_s: Duration of the ramp.
    """

    def __init__(
        self,
        policy: Policy,
        compensator: Compensator,
        table: SignalTable,
        control_period_s: float = 0.004,
        ramp_s: float = STAND_S,
    ) -> None:
        self.policy, self.compensator = policy, compensator
        self._view = _View(table)
        self._ramp_steps = max(round(ramp_s / control_period_s), 1)

    def predict(
        self, observation: Array, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Action, Any]:
        """Compensated action and new state.

        Raises:
            ElasticError: Called in the middle of an episode without the state of the last call.
        """
        rows = np.atleast_2d(observation)
        desired = self._view.motion(rows)
        memory, inner_state = _resume(
            state, episode_start, rows, self._view, lambda: np.pad(self.compensator.begin(desired), ((0, 0), (1, 0)))
        )
        action, inner_state = self._inner(rows, inner_state, episode_start, deterministic, observation.ndim, memory)
        wanted = Motion(desired.q + action, desired.q_dot, desired.q_ddot)
        offset, kept = self.compensator.offset(wanted, memory[:, 1:])
        steps = memory[:, :1] + 1.0
        share, _, _ = quintic(steps / self._ramp_steps)
        total = (action + share * offset).astype(np.float32)
        return total.reshape((*observation.shape[:-1], total.shape[-1])), (np.hstack([steps, kept]), inner_state)

    def link_estimate(self, observation: Array, state: Any) -> Array:
        """Estimated link angle for an observation and the state that `predict` returned for it, (..., n) [rad]."""
        memory, _ = state
        theta = self._view.theta(np.atleast_2d(observation))
        estimate = self.compensator.link_angle(theta, memory[:, 1:])
        return estimate.reshape((*observation.shape[:-1], estimate.shape[-1]))

    def _inner(
        self, rows: Array, state: Any, episode_start: Any, deterministic: bool, ndim: int, memory: Array
    ) -> tuple[Array, Any]:
        """The wrapped policy's action on an observation whose encoder columns are those of the links."""
        theta, theta_dot = self._view.theta(rows), self._view.theta_dot(rows)
        seen = self._view.with_links(
            rows, self.compensator.link_angle(theta, memory[:, 1:]), self.compensator.link_rate(theta, theta_dot)
        )
        action, state = self.policy.predict(seen if ndim > 1 else seen[0], state, episode_start, deterministic)
        return np.atleast_2d(np.asarray(action, dtype=np.float64)), state


class Oracle:
    """What perfect sensing and a perfect model give: the only policy that may read the truth.

    The dynamic compensator with the true parameters, friction and backlash included, and an integrator on the true link
    error for what is left. Its gain stays below the damping of the link's resonance.

    Args:
        env: The environment itself, scalar or vector.
        options: As for the other policies; the stiffness is the true one.
    """

    integral_gain = 1.0
    """Gain on the true link error [1/s]."""
    integral_limit = 0.05
    """Largest correction of the integrator [rad]."""

    def __init__(self, env: Any, options: PolicyOptions) -> None:
        self._env = env.unwrapped
        model = self._env.truth().model
        self._view = _View(self._env.task.observation_table)
        self._compensator = DynamicCompensator(model, options.output, options.gravity, friction=True)
        self._dt = model.control_period_s
        self._ramp_steps = max(round(options.ramp_s / self._dt), 1)

    def predict(
        self,
        observation: Array,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,  # noqa: ARG002  the interface's
    ) -> tuple[Action, Any]:
        """Action and new state; the observation must be the environment's present one."""
        rows = np.atleast_2d(observation)
        motion = self._view.motion(rows)
        n = motion.q.shape[-1]
        memory, _ = _resume(
            state, episode_start, rows, self._view,
            lambda: np.hstack([np.zeros((len(rows), 1 + n)), motion.q, self._compensator.begin(motion)]),
        )  # fmt: skip
        steps, correction, target, kept = np.split(memory, [1, 1 + n, 1 + 2 * n], axis=1)
        steps = steps + 1.0
        error = np.where(steps > self._ramp_steps, target - self._env.truth().q, 0.0)
        correction = np.clip(
            correction + self.integral_gain * self._dt * error, -self.integral_limit, self.integral_limit
        )
        offset, kept = self._compensator.offset(motion, kept)
        share, _, _ = quintic(steps / self._ramp_steps)
        action = (share * offset + correction).astype(np.float32)
        new_state = np.hstack([steps, correction, motion.q, kept]), None
        return action.reshape((*observation.shape[:-1], n)), new_state

    def link_estimate(self, observation: Array, state: Any) -> Array:  # noqa: ARG002  the interface's
        """The true link angle, (..., n) [rad]."""
        return self._env.truth().q.reshape((*observation.shape[:-1], -1))


class _View:
    """Where an observation table holds what compensators need, by name."""

    def __init__(self, table: SignalTable) -> None:
        self._theta, self._theta_dot = table.columns("encoder_angle"), table.columns("encoder_rate")
        self._q, self._q_dot = table.columns("reference_angle"), table.columns("reference_rate")
        self._q_ddot, self._command = table.columns("reference_acceleration"), table.columns("last_command")

    def theta(self, rows: Array) -> Array:
        return rows[:, self._theta]

    def theta_dot(self, rows: Array) -> Array:
        return rows[:, self._theta_dot]

    def motion(self, rows: Array) -> Motion:
        return Motion(rows[:, self._q], rows[:, self._q_dot], rows[:, self._q_ddot])

    def with_links(self, rows: Array, q: Array, q_dot: Array) -> Array:
        """A copy of the observation with link angles and rates in place of the encoders'."""
        seen = rows.copy()
        seen[:, self._theta], seen[:, self._theta_dot] = q, q_dot
        return seen

    def is_start(self, rows: Array) -> BoolArray:
        """Whether an observation can be the first of an episode: standing, and nothing commanded yet."""
        standing = (rows[:, self._q_dot] == 0.0).all(axis=1)
        return standing & (rows[:, self._command] == rows[:, self._q]).all(axis=1)


def _resume(state: Any, episode_start: Any, rows: Array, view: _View, begin: Callable[[], Array]) -> tuple[Array, Any]:
    """Memory and inner state for this call, with the rows of new episodes begun afresh."""
    if state is None:
        starts = view.is_start(rows) if episode_start is None else np.broadcast_to(episode_start, (len(rows),))
        if not np.all(starts):
            raise ElasticError(
                "predict() was called in the middle of an episode without `state`: this policy has memory; pass the "
                "state that the last call returned, and episode_start=True where an episode begins"
            )
        return begin(), None
    memory, inner_state = state
    if len(memory) != len(rows):
        raise ElasticError(f"`state` must have one row per world, {len(rows)}, got {len(memory)}")
    if episode_start is not None and np.any(episode_start):
        fresh = np.broadcast_to(np.asarray(episode_start, dtype=np.bool_), (len(rows),))
        memory = np.where(fresh[:, None], begin(), memory)
    return memory, inner_state


def _zero(env: Any, options: PolicyOptions) -> Policy:  # noqa: ARG001  one signature for all
    return Zero(env.unwrapped.task.observation_table)


def _compensated(compensator: type[GravityCompensator] | type[DynamicCompensator]) -> Callable[..., Policy]:
    def build(env: Any, options: PolicyOptions) -> Policy:
        model, table = _assumed(env, options), env.unwrapped.task.observation_table
        return Compensated(
            Zero(table), compensator(model, options.output, options.gravity), table, model.control_period_s,
            options.ramp_s,
        )  # fmt: skip

    return build


POLICIES: dict[str, Callable[[Any, PolicyOptions], Policy]] = {
    "zero": _zero,
    "uncompensated": _zero,
    "input": _compensated(GravityCompensator),
    "dynamic": _compensated(DynamicCompensator),
    "oracle": Oracle,
}
"""Named policies of the testbed; there `uncompensated` has no controller to add and equals `zero`."""


def policy_names() -> list[str]:
    """Names that `make` accepts."""
    return list(POLICIES)


def make(name: str, env: Any, **options: Any) -> Policy:
    """A named baseline for an environment.

    | name | what it does on the testbed |
    |---|---|
    | `zero`, `uncompensated` | plays the reference back |
    | `input` | Eq. 9 on the command, Eq. 12 (or Newton) on the encoder |
    | `dynamic` | deflection from the full joint torque, with D, B and the servo inverted |
    | `oracle` | true parameters, integral action on the true link error |

    Args:
        name: As in the table.
        env: The environment, scalar or vector, wrapped or not; it provides the assumed model.
        **options: Parameters of `PolicyOptions`: stiffness, output, gravity, ramp_s.

    Returns:
        An object with `predict`, usable on scalar and vector environments and in SB3's `evaluate_policy`.

    Raises:
        ConfigurationError: Unknown name or option, or an environment that is not ours.
    """
    if name not in POLICIES:
        raise unknown_name("policy", name, POLICIES)
    if not hasattr(env.unwrapped, "assumed_model"):
        raise ConfigurationError(
            f"a baseline needs an environment with an assumed model, got {type(env.unwrapped).__name__}; make one with "
            'gymnasium.make("elastic_env/Testbed-v0") and pass it here, also if the policy is to run on a wrapper of it'
        )
    return POLICIES[name](env, PolicyOptions(**options))


def _assumed(env: Any, options: PolicyOptions) -> RobotModel:
    model: RobotModel = env.unwrapped.assumed_model
    if options.stiffness is None:
        return model
    given = options.stiffness
    return model.with_stiffness(given if isinstance(given, list) else read_stiffness(given))
