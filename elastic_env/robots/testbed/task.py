"""The testbed task: make the link follow a reference although the joint bends under gravity.

Observation of one world (float64):

| column | name | unit | meaning |
|---|---|---|---|
| 0 | `encoder_angle` | rad | motor encoder, θ in whole counts |
| 1 | `encoder_rate` | rad/s | its change over the last control period |
| 2 | `reference_angle` | rad | q_ref at the end of the coming control period |
| 3 | `reference_rate` | rad/s | its rate |
| 4 | `reference_acceleration` | rad/s² | its acceleration |
| 5 | `last_command` | rad | θ_cmd of the last control period |
| 6 | `link_angle_imu` | rad | IMU on the link; only with `observe_link=True` |

Action of one world (float32): the command offset a = θ_cmd − q_ref [rad], within ±0.3.

`info` of one world, all at the end of the control period, the truth where nothing else is said:

| key | unit | meaning |
|---|---|---|
| `time_s` | s | since the start of the episode |
| `reference_angle` | rad | q_ref |
| `link_angle`, `link_angle_imu` | rad | q, and what its IMU shows |
| `link_error`, `link_error_imu` | rad | q_ref − q, and by the IMU; positive where the link hangs behind |
| `deflection` | rad | δ = θ − q |
| `joint_torque` | N·m | of spring and damper on the link, positive along q |
| `servo_error` | rad | θ_cmd − θ |
| `command_rate` | rad/s | rate of change of the offset a |
| `rest` | 1 | number of the window at rest of `hold`, −1 elsewhere |
| `clipped` | 1 | 1 where the action was beyond its bounds |
| `reward_terms` | 1 | weighted terms of the reward, by name |
| `termination` | | why the episode ended: "diverged", or "" |
| `episode_metrics` | | at the end of the episode: its figures, whose names end with their unit |
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from elastic_env.core.rows import Rows
from elastic_env.core.signals import Array, BoolArray, IntArray, Signal, Signals, SignalTable
from elastic_env.joint.elasticity import ElasticJoint, joint_torque, static_link_angle
from elastic_env.joint.joint_names import JointAddresses
from elastic_env.joint.time_step import require_stable
from elastic_env.motion.trajectory import PlanTable
from elastic_env.robots.testbed.config import TestbedConfig, require_feasible
from elastic_env.robots.testbed.model import JOINT, Pendulum, elastic_spec
from elastic_env.runtime.metrics import Metric
from elastic_env.runtime.physics import DIVERGED_RAD_S, Simulation, substeps
from elastic_env.runtime.robot_model import RobotModel
from elastic_env.runtime.sensors import NoiseStream, attitude, is_due, quantise
from elastic_env.runtime.task import Outcome

ACTION_BOUND_RAD = 0.3
"""Largest command offset [rad]."""

ACTION = SignalTable((Signal("command_offset", "rad", "θ_cmd − q_ref", low=-ACTION_BOUND_RAD, high=ACTION_BOUND_RAD),))

OBSERVATION = SignalTable(
    (
        Signal("encoder_angle", "rad", "motor encoder, θ in whole counts"),
        Signal("encoder_rate", "rad/s", "its change over the last control period"),
        Signal("reference_angle", "rad", "q_ref at the end of the coming control period"),
        Signal("reference_rate", "rad/s", "its rate"),
        Signal("reference_acceleration", "rad/s²", "its acceleration"),
        Signal("last_command", "rad", "θ_cmd of the last control period"),
    )
)

LINK_IMU = Signal("link_angle_imu", "rad", "IMU on the link")

NOISE = np.dtype([("imu", np.float64)])
"""A sample of noise [1]."""

METRICS = (
    *(Metric(f"link_error_{s}_rad", "link_error", s) for s in ("rms", "peak", "min", "max")),
    *(Metric(f"link_error_imu_{s}_rad", "link_error_imu", s) for s in ("rms", "min", "max")),
    *(Metric(f"deflection_{s}_rad", "deflection", s) for s in ("rms", "peak")),
    *(Metric(f"servo_error_{s}_rad", "servo_error", s) for s in ("rms", "peak")),
    *(Metric(f"command_rate_{s}_rad_s", "command_rate", s, over="all") for s in ("rms", "peak")),
    Metric("joint_torque_peak_nm", "joint_torque", "peak", over="all"),
    Metric("clipped_share", "clipped", "mean", over="all"),
)


@dataclass(frozen=True)
class TestbedTruth:
    """Noise-free state of the testbed and its true parameters, one row per world. For scoring and the oracle.

    Attributes:
        theta, theta_dot, q, q_dot: Motor and link side, (num_worlds, 1) [rad], [rad/s].
        deflection: θ − q, (num_worlds, 1) [rad].
        joint_torque: Of spring and damper on the link, (num_worlds, 1) [N·m].
        stiffness: True K, (num_worlds, 1) [N·m/rad].
        model: The true joint and pendulum.
    """

    __test__ = False

    theta: Array
    theta_dot: Array
    q: Array
    q_dot: Array
    deflection: Array
    joint_torque: Array
    stiffness: Array
    model: RobotModel


@dataclass(frozen=True, slots=True)
class TestbedSample(Rows):
    """What a step is scored by, (n,) each.

    Attributes:
        step: Control steps since the start of the episode.
        q_ref: Reference [rad].
        scored, rest: Whether the step counts in metrics; number of the window at rest, −1 elsewhere.
        theta, theta_dot, q, q_dot: Motor and link side [rad], [rad/s].
        imu: Link angle as the IMU shows it [rad].
        servo_error: θ_cmd − θ [rad].
        command_rate: Rate of change of the offset [rad/s].
        diverged: Whether the world has no new state.
    """

    __test__ = False

    step: IntArray
    q_ref: Array
    scored: BoolArray
    rest: IntArray
    theta: Array
    theta_dot: Array
    q: Array
    q_dot: Array
    imu: Array
    servo_error: Array
    command_rate: Array
    diverged: BoolArray


def tracking_penalty(link_error: Array) -> Array:
    """−|q_ref − q| [rad]: linear, so that a large error never stops to matter."""
    return -np.abs(link_error)


def smoothness_penalty(command_rate: Array) -> Array:
    """−|ȧ|, the rate of change of the command offset [rad/s]."""
    return -np.abs(command_rate)


def divergence_penalty(diverged: BoolArray) -> Array:
    """−1 in the step in which the simulation diverges."""
    return -diverged.astype(np.float64)


class TestbedTask:
    """Rules of `elastic_env/Testbed-v0`, see `elastic_env.runtime.task.Task`."""

    __test__ = False

    name = "testbed"
    action_table = ACTION
    metrics: Sequence[Metric] = METRICS
    failure_names: tuple[str, ...] = ()  # a pendulum cannot fall over

    def __init__(self, config: TestbedConfig, num_worlds: int) -> None:
        require_feasible(config)
        self.config = config
        self.num_worlds = num_worlds
        self.num_substeps = substeps(config.control_period_s, config.timestep_s)
        self.observation_table = SignalTable((*OBSERVATION, LINK_IMU)) if config.observe_link else OBSERVATION
        self.assumed_model = config.robot_model(config.joint, config.pendulum, self.observation_table)
        self._joint, self._pendulum = config.true_joint, config.true_pendulum
        self._true_model = config.robot_model(self._joint, self._pendulum, self.observation_table)
        self.model = elastic_spec(self._pendulum, self._joint, config.form, config.timestep_s).compile()
        require_stable(self.model, config.control_period_s)
        self._at = JointAddresses.of(self.model, [JOINT])
        self._noise = NoiseStream(num_worlds, NOISE)
        self._reference = PlanTable(config.reference, config.control_period_s, num_worlds)
        self._step = np.zeros(num_worlds, dtype=np.int64)
        self._theta, self._theta_dot, self._q, self._q_dot = np.zeros((4, num_worlds))
        self._measured = self._shown = Measurement(*np.zeros((3, num_worlds)))
        self._encoder_bias, self._imu_bias = np.zeros((2, num_worlds))
        self._offset, self._offset_before, self._command = np.zeros((3, num_worlds))
        self._diverged = np.zeros(num_worlds, dtype=np.bool_)

    @property
    def num_steps(self) -> int:
        """Control steps of an episode."""
        return self._reference.num_steps

    def restart(self, simulation: Simulation, worlds: BoolArray, generators: Sequence[np.random.Generator]) -> None:
        """Place the testbed at rest under zero offset: the servo holds q_ref, the spring is already deflected."""
        scenario = self.config.scenario
        for world in np.flatnonzero(worlds).tolist():
            generator = generators[world]
            self._reference.draw(world, generator)
            self._encoder_bias[world] = scenario.encoder_bias_rad * generator.uniform(-1.0, 1.0)
            self._imu_bias[world] = scenario.imu.bias_spread_rad * generator.uniform(-1.0, 1.0)
            self._noise.restart(world, np.random.default_rng(generator.integers(2**63)))
        self._step, self._diverged = np.where(worlds, 0, self._step), self._diverged & ~worlds
        self._offset[worlds] = self._offset_before[worlds] = 0.0
        self._command[worlds] = self._reference.at(self._step).q[worlds]
        self._place(simulation, worlds)
        self._read(simulation, worlds)
        fresh = self._measure(worlds)
        at_rest = Measurement(fresh.encoder, fresh.encoder, fresh.imu)
        self._measured = self._measured.with_worlds(worlds, at_rest)
        self._shown = self._shown.with_worlds(worlds, at_rest)

    def command(self, offset: Array, inputs: Array) -> None:
        """θ_cmd = q_ref + offset, as the servo gets it: it knows its angle only up to the homing error."""
        self._offset_before, self._offset = self._offset, offset[:, 0].copy()
        self._command = self._reference.at(self._step + 1).q + self._offset
        inputs[:, 0] = self._command - self._encoder_bias

    def disturb(self, simulation: Simulation) -> None:
        """Nothing pushes the testbed."""

    def sense(self, simulation: Simulation, diverged: BoolArray) -> Outcome:
        """Read the new state, then what the sensors show of it; score it."""
        diverged = diverged | (np.abs(simulation.qvel) > DIVERGED_RAD_S).any(axis=1)
        self._step, self._diverged = self._step + 1, diverged
        self._read(simulation, ~diverged)
        before, self._measured = self._measured, self._measure(~diverged)
        self._shown = before if self.config.scenario.delay_steps else self._measured
        sample = self.sample()
        ends = np.array([diverged, diverged, (self._step >= self.num_steps) & ~diverged])
        reward = functools.reduce(np.add, self.reward_terms(sample).values())
        return Outcome(self.observe(), sample, reward, ends, bool(ends.any()))

    def observe(self) -> Array:
        """See the table of the module."""
        coming = self._reference.at(self._step + 1)
        shown = self._shown
        rate = (shown.encoder - shown.encoder_before) / self.config.control_period_s
        columns = [shown.encoder, rate, coming.q, coming.q_dot, coming.q_ddot, self._command]
        if self.config.observe_link:
            columns.append(shown.imu)
        return np.stack(columns, axis=-1)

    def sample(self) -> TestbedSample:
        """What this step is scored by."""
        reference = self._reference.at(self._step)
        servo_error = self._command - self._encoder_bias - self._theta
        command_rate = (self._offset - self._offset_before) / self.config.control_period_s
        return TestbedSample(
            self._step, reference.q, reference.scored, reference.rest, self._theta, self._theta_dot, self._q,
            self._q_dot, self._shown.imu, servo_error, command_rate, self._diverged,
        )  # fmt: skip

    def signals(self, sample: TestbedSample) -> Signals:
        """Truth and scores of samples, one value per row."""
        deflection = sample.theta - sample.q
        return {
            "time_s": sample.step * self.config.control_period_s,
            "reference_angle": sample.q_ref.copy(),
            "link_angle": sample.q.copy(),
            "link_angle_imu": sample.imu.copy(),
            "link_error": sample.q_ref - sample.q,
            "link_error_imu": sample.q_ref - sample.imu,
            "deflection": deflection,
            "joint_torque": self._joint_torque(deflection, sample.theta_dot - sample.q_dot),
            "servo_error": sample.servo_error.copy(),
            "command_rate": sample.command_rate.copy(),
            "rest": sample.rest.copy(),
        }

    def masks(self, sample: TestbedSample) -> dict[str, BoolArray]:
        """Windows at rest of `hold`; all but standing and onset of the other references."""
        return {"scored": sample.scored}

    def reward_terms(self, sample: TestbedSample) -> dict[str, Array]:
        """Weighted penalties for link error, restless commands and divergence."""
        weights = self.config.reward
        return {
            "link_error": weights.link_error * tracking_penalty(sample.q_ref - sample.q),
            "command_rate": weights.command_rate * smoothness_penalty(sample.command_rate),
            "divergence": weights.divergence * divergence_penalty(sample.diverged),
        }

    def truth(self) -> TestbedTruth:
        """State without noise, and the true parameters."""
        deflection = self._theta - self._q
        torque = self._joint_torque(deflection, self._theta_dot - self._q_dot)
        stiffness = np.full_like(torque, self._joint.stiffness)
        columns = (self._theta, self._theta_dot, self._q, self._q_dot, deflection, torque, stiffness)
        return TestbedTruth(*(column[:, None].copy() for column in columns), model=self._true_model)

    def _joint_torque(self, deflection: Array, deflection_rate: Array) -> Array:
        joint = self._joint
        return joint_torque(deflection, deflection_rate, joint.stiffness, joint.damping, joint.backlash)

    def _place(self, simulation: Simulation, worlds: BoolArray) -> None:
        joint, pendulum = self._joint, self._pendulum
        theta = (self._command - self._encoder_bias)[worlds, None]
        q = theta if self.config.form == "rigid" else _rest_angle(theta, joint, pendulum)
        simulation.qpos[np.ix_(worlds, self._at.theta)] = theta
        simulation.qpos[np.ix_(worlds, self._at.q)] = q
        simulation.ctrl[worlds] = theta
        if joint.servo is not None and joint.servo.integral_gain > 0.0:
            simulation.act[worlds] = pendulum.torque(q) / joint.servo.integral_gain

    def _read(self, simulation: Simulation, worlds: BoolArray) -> None:
        """The true state of some worlds; the others keep their last one."""
        at, qpos, qvel = self._at, simulation.qpos, simulation.qvel
        self._theta = np.where(worlds, qpos[:, at.theta[0]], self._theta)
        self._theta_dot = np.where(worlds, qvel[:, at.theta_dot[0]], self._theta_dot)
        self._q = np.where(worlds, qpos[:, at.q[0]], self._q)
        self._q_dot = np.where(worlds, qvel[:, at.q_dot[0]], self._q_dot)

    def _measure(self, worlds: BoolArray) -> "Measurement":
        """What the sensors say now; the other worlds keep their last values."""
        scenario, last = self.config.scenario, self._measured
        counts = self._joint.encoder_counts_per_turn if scenario.encoder_counts else None
        due = worlds & is_due(self._step, scenario.imu.rate_hz, self.config.control_period_s)
        imu = attitude(scenario.imu, self._q, self._imu_bias, self._noise.next(due)["imu"])
        return Measurement(
            encoder=np.where(worlds, quantise(self._theta + self._encoder_bias, counts), last.encoder),
            encoder_before=np.where(worlds, last.encoder, last.encoder_before),
            imu=np.where(due, imu, last.imu),
        )


@dataclass(frozen=True, slots=True)
class Measurement(Rows):
    """Sensor values, (num_worlds,) each [rad]; the encoder also a control period earlier."""

    encoder: Array
    encoder_before: Array
    imu: Array


def _rest_angle(theta: Array, joint: ElasticJoint, pendulum: Pendulum) -> Array:
    """Link angle at rest without friction; within the dead band the pendulum hangs straight down."""
    half = np.sign(theta) * joint.backlash / 2.0
    engaged = np.where(np.abs(theta) > np.abs(half), theta - half, 0.0)
    return static_link_angle(engaged, joint.stiffness, pendulum.torque, pendulum.torque_gradient)
