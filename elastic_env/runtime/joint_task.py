"""A task of n elastic joints: make the links follow a reference although the joints bend under gravity.

The observation has the encoders, the reference of the coming control period, the last command, and the sensors that are
asked for; the action is the command offset of every joint. With one joint its signals have plain names, with several
`name.<joint>`, and `info` then has the figures of all joints together under the plain names: rms of the link errors, of
the deflections, of the servo errors and of the offsets' rates, largest joint torque.
"""

import copy
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from elastic_env.core.draws import Draws
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.rows import Rows
from elastic_env.core.signals import Array, BoolArray, IntArray, Kind, Signal, SignalGroup, Signals, SignalTable
from elastic_env.dynamics.tree.end_effector import EndEffector
from elastic_env.joint.elasticity import joint_torque
from elastic_env.joint.joint_names import JointAddresses, servo_name, spring_name
from elastic_env.joint.time_step import require_stable
from elastic_env.motion.trajectory import Planned, PlanTable
from elastic_env.runtime.further_sensors import ACCELEROMETER, Felt, FurtherSensors, specific_force
from elastic_env.runtime.joint_config import JointConfig
from elastic_env.runtime.metrics import Metric
from elastic_env.runtime.physics import DIVERGED_RAD_S, Simulation, substeps
from elastic_env.runtime.robot_model import RobotModel
from elastic_env.runtime.scenario import Scenario
from elastic_env.runtime.sensors import NoiseStream, PendulumImu, angle_of_count, attitude, is_due, quantise
from elastic_env.runtime.task import Outcome

ACTION_BOUND_RAD = 0.3
"""Largest command offset [rad]."""

LINK_IMU = Signal("link_angle_imu", "rad", "IMU on the link", kind="measured")
LINK_IMU_SENSOR = "link_imu"
"""Name by which `sensors=[...]` asks for it, on a robot of one joint; its errors are those of the scenario's IMU."""

NOISE = np.dtype([("imu", np.float64)])
"""A sample of noise [1]."""

_OF_EVERY_STEP = (
    *(Metric(f"command_rate_{s}_rad_s", "command_rate", s, over="all") for s in ("rms", "peak")),
    Metric("joint_torque_peak_nm", "joint_torque", "peak", over="all"),
    Metric("clipped_share", "clipped", "mean", over="all"),
)
METRICS_OF_ONE = (
    *(Metric(f"link_error_{s}_rad", "link_error", s) for s in ("rms", "peak", "min", "max")),
    *(Metric(f"link_error_imu_{s}_rad", "link_error_imu", s) for s in ("rms", "min", "max")),
    *(Metric(f"deflection_{s}_rad", "deflection", s) for s in ("rms", "peak")),
    *(Metric(f"servo_error_{s}_rad", "servo_error", s) for s in ("rms", "peak")),
    *_OF_EVERY_STEP,
)
METRICS_OF_SEVERAL = (
    Metric("link_error_rms_rad", "link_error", "rms"),
    Metric("link_error_peak_rad", "link_error_largest", "peak"),
    Metric("link_error_min_rad", "link_error_lowest", "min"),
    Metric("link_error_max_rad", "link_error_highest", "max"),
    Metric("deflection_rms_rad", "deflection", "rms"),
    Metric("servo_error_rms_rad", "servo_error", "rms"),
    *_OF_EVERY_STEP,
)
METRICS_OF_END_EFFECTOR = (
    *(Metric(f"end_effector_error_{s}_m", "end_effector_error", s) for s in ("rms", "peak")),
    *(Metric(f"end_effector_tilt_{s}_rad", "end_effector_tilt", s) for s in ("rms", "peak")),
)


@dataclass(frozen=True)
class JointPlant:
    """What moves, and what is known of it.

    Attributes:
        name: Of the robot.
        model: Compiled, with elastic joints.
        assumed, true: What a compensator may know, and what is; without a table of observations.
        static_torque: τ_g that holds the true links, from (..., n) [rad] to (..., n) [N·m].
        rest_angle: Link angles at rest without friction, from the servos' commands, (..., n) [rad], and if they differ
            from the true ones the springs' factors, (..., n) [1].
        motion: The reference as all joints follow it.
        imu_arm_m: Distance of the link's IMU from the only joint, which has a horizontal axis and a link that hangs at
            q = 0 [m]; None where there is no such IMU.
        end_effector: Whose place and tilt are scored; None where the joints alone are.
    """

    name: str
    model: mujoco.MjModel
    assumed: RobotModel
    true: RobotModel
    static_torque: Callable[[Array], Array]
    rest_angle: Callable[..., Array]
    motion: Planned
    imu_arm_m: float | None = None
    end_effector: EndEffector | None = None

    @property
    def joint_names(self) -> list[str]:
        """Names of the joints, in order."""
        return self.true.joint_names


@dataclass(frozen=True)
class JointTruth(Felt):
    """Noise-free state of the joints and their true parameters, one row per world. For scoring and the oracle.

    Attributes:
        theta, theta_dot, q_dot: Motor and link side, (num_worlds, n) [rad], [rad/s].
        deflection: θ − q, (num_worlds, n) [rad].
        stiffness: True K, (num_worlds, n) [N·m/rad].
        model: The true joints and links.
    """

    theta: Array
    theta_dot: Array
    q_dot: Array
    deflection: Array
    stiffness: Array
    model: RobotModel


@dataclass(frozen=True, slots=True)
class JointState(Rows):
    """Motor and link side of the joints, (num_worlds, n) each [rad], [rad/s]."""

    theta: Array
    theta_dot: Array
    q: Array
    q_dot: Array


@dataclass(frozen=True, slots=True)
class Measurement(Rows):
    """Sensor values, (num_worlds, n) each [rad]; the encoders also a control period earlier."""

    encoder: Array
    encoder_before: Array
    imu: Array


@dataclass(frozen=True, slots=True)
class JointSample(Rows):
    """What a step is scored by, one row per world.

    Attributes:
        step: Control steps since the start of the episode, (rows,).
        q_ref: Reference, (rows, n) [rad].
        scored, rest: Whether the step counts in metrics; number of the window at rest, −1 elsewhere, (rows,).
        state: Of the joints.
        imu: Link angles as IMUs show them, (rows, n) [rad].
        servo_error: θ_cmd − θ, (rows, n) [rad].
        command_rate: Rate of change of the offsets, (rows, n) [rad/s].
        stiffness: True K, (rows, n) [N·m/rad].
        diverged: Whether the world has no new state, (rows,).
    """

    step: IntArray
    q_ref: Array
    scored: BoolArray
    rest: IntArray
    state: JointState
    imu: Array
    servo_error: Array
    command_rate: Array
    stiffness: Array
    diverged: BoolArray


def tracking_penalty(link_error: Array) -> Array:
    """−|q_ref − q| [rad], the rms over several joints: linear, so that a large error never stops to matter."""
    return -over_joints(link_error)


def smoothness_penalty(command_rate: Array) -> Array:
    """−|ȧ|, the rate of change of the command offset, the rms over several joints [rad/s]."""
    return -over_joints(command_rate)


def divergence_penalty(diverged: BoolArray) -> Array:
    """−1 in the step in which the simulation diverges."""
    return -diverged.astype(np.float64)


def over_joints(values: Array) -> Array:
    """One magnitude for all joints: their rms, which for one joint is the magnitude itself, (n, m) to (n,)."""
    return np.abs(values[:, 0]) if values.shape[1] == 1 else np.sqrt(np.square(values).mean(axis=1))


def _names(name: str, joints: Sequence[str]) -> list[str]:
    return [f"{name}.{joint}" for joint in joints] if len(joints) > 1 else [name]


def action_table(joints: Sequence[str]) -> SignalTable:
    """The action: an offset for every joint."""
    offsets = SignalGroup.of("command_offset", "rad", "θ_cmd − q_ref", dict.fromkeys(joints), "command").signals
    return SignalTable(tuple(replace(signal, low=-ACTION_BOUND_RAD, high=ACTION_BOUND_RAD) for signal in offsets))


def observation_signals(joints: Sequence[str]) -> tuple[Signal, ...]:
    """The standard set."""
    groups: tuple[tuple[str, str, str, Kind], ...] = (
        ("encoder_angle", "rad", "motor encoder, θ in whole counts", "measured"),
        ("encoder_rate", "rad/s", "its change over the last control period", "measured"),
        ("reference_angle", "rad", "q_ref at the end of the coming control period", "reference"),
        ("reference_rate", "rad/s", "its rate", "reference"),
        ("reference_acceleration", "rad/s²", "its acceleration", "reference"),
        ("last_command", "rad", "θ_cmd of the last control period", "command"),
    )
    made = [SignalGroup.of(name, unit, meaning, dict.fromkeys(joints), kind) for name, unit, meaning, kind in groups]
    return SignalTable.of(made).signals


class JointTask:
    """Rules of a robot of elastic joints, see `elastic_env.runtime.task.Task`.

    Args:
        config: Reference, scenario, sensors, rewards, periods.
        plant: What moves.
        num_worlds: How many.
        observe_imu: Whether the IMU of the only link is observed, if no sensor of the configuration asks for it.

    Raises:
        ConfigurationError: An unknown sensor, or the IMU of the link on a robot of several joints.
    """

    failure_names: tuple[str, ...] = ()  # what stands on a fixed base cannot fall over

    def __init__(self, config: JointConfig, plant: JointPlant, num_worlds: int, observe_imu: bool = False) -> None:
        self.config, self.name, self.model, self.num_worlds = config, plant.name, plant.model, num_worlds
        self.num_substeps = substeps(config.control_period_s, config.timestep_s)
        joints, n = plant.joint_names, len(plant.joint_names)
        observe_imu = observe_imu or LINK_IMU_SENSOR in config.sensors
        if observe_imu and n > 1:
            raise ConfigurationError(
                f"the sensor {LINK_IMU_SENSOR!r} needs a robot of one joint, and {plant.name} has {n}; "
                "choose link_encoder to observe the links of several"
            )
        self._plant, self._joints, self._observes_imu = plant, joints, observe_imu
        self.metrics: Sequence[Metric] = (
            *(METRICS_OF_ONE if n == 1 else METRICS_OF_SEVERAL),
            *(() if plant.end_effector is None else METRICS_OF_END_EFFECTOR),
        )
        others = [sensor for sensor in config.sensors if sensor != LINK_IMU_SENSOR]
        self._sensors = FurtherSensors(
            others, dict.fromkeys(joints), [config.scenario] * num_worlds, plant.true.encoder_counts_per_turn
        )
        self.action_table = action_table(joints)
        observed = [*observation_signals(joints), *([LINK_IMU] if observe_imu else []), *self._sensors.signals]
        self.observation_table = SignalTable(tuple(observed))
        self.assumed_model = plant.assumed.observed_by(self.observation_table)
        self._true_model = plant.true.observed_by(self.observation_table)
        require_stable(stiffest(plant.model, config.scenario), config.control_period_s)
        self._at = JointAddresses.of(self.model, joints)
        servos = [self.model.actuator(servo_name(joint)) for joint in joints]
        self._inputs = np.array([servo.id for servo in servos])
        self._integrators = np.array([servo.actadr[0] for servo in servos])
        self._noise, self._imu = NoiseStream(num_worlds, NOISE), _inertial_imu(config, plant, num_worlds)
        self._reference = PlanTable(plant.motion, config.control_period_s, num_worlds)
        self._step = np.zeros(num_worlds, dtype=np.int64)
        self._present = self._coming = self._reference.at(self._step)
        self._state = JointState(*np.zeros((4, num_worlds, n)))
        self._measured = self._shown = Measurement(*np.zeros((3, num_worlds, n)))
        self._encoder_bias, self._imu_bias = np.zeros((2, num_worlds, n))
        self._offset, self._offset_before, self._command = np.zeros((3, num_worlds, n))
        self._diverged, self._force = np.zeros(num_worlds, dtype=np.bool_), np.full((num_worlds, 3), np.nan)
        self._factor = np.ones((num_worlds, n))
        self._stiffness = np.broadcast_to(self._true_model.stiffness, (num_worlds, n))
        self._springs = np.array([self.model.tendon(spring_name(joint)).id for joint in self._spread_joints()])

    @property
    def num_steps(self) -> int:
        """Control steps of an episode."""
        return self._reference.num_steps

    def restart(self, simulation: Simulation, worlds: BoolArray, draws: Sequence[Draws]) -> None:
        """Place the robot at rest under zero offset: the servos hold q_ref, the springs are already deflected."""
        scenario, n = self.config.scenario, len(self._joints)
        for world in np.flatnonzero(worlds).tolist():
            generator = draws[world].robot
            self._reference.draw(world, generator)
            self._encoder_bias[world] = scenario.encoder_bias_rad * generator.uniform(-1.0, 1.0, n)
            self._imu_bias[world] = scenario.imu.bias_spread_rad * generator.uniform(-1.0, 1.0)
            self._noise.restart(world, draws[world].noise())
            if self._imu is not None:
                self._imu_bias[world] += self._imu.draw(world, generator, draws[world].noise())
        if scenario.stiffness_spread > 0.0:
            self._spread(simulation, worlds, draws)
        self._step, self._diverged = np.where(worlds, 0, self._step), self._diverged & ~worlds
        self._follow()
        self._offset[worlds] = self._offset_before[worlds] = 0.0
        self._command[worlds] = self._present.q[worlds]
        if self._sensors:
            simulation.bind("sensordata")
        self._place(simulation, worlds)
        self._read(simulation, worlds)
        if self._imu is not None:
            self._imu.settle(worlds, self._state.q[:, 0])
        fresh = self._measure(worlds)
        at_rest = Measurement(fresh.encoder, fresh.encoder, fresh.imu)
        self._measured = self._measured.with_worlds(worlds, at_rest)
        self._shown = self._shown.with_worlds(worlds, at_rest)
        if self._sensors:
            simulation.refresh(worlds)
            self._feel(simulation)
            self._sensors.restart(worlds, draws, self.truth())

    def command(self, offset: Array, inputs: Array) -> None:
        """θ_cmd = q_ref + offset, as the servos get it: they know their angles only up to the homing error."""
        self._offset_before, self._offset = self._offset, offset.copy()
        self._command = self._coming.q + self._offset
        inputs[:, self._inputs] = self._command - self._encoder_bias

    def disturb(self, simulation: Simulation) -> None:
        """Nothing pushes the robot."""

    def sense(self, simulation: Simulation, diverged: BoolArray) -> Outcome:
        """Read the new state, then what the sensors show of it; score it."""
        diverged = diverged | (np.abs(simulation.qvel) > DIVERGED_RAD_S).any(axis=1)
        self._step, self._diverged = self._step + 1, diverged
        self._present, self._coming = self._coming, self._reference.at(self._step + 1)
        self._read(simulation, ~diverged)
        if self._imu is not None:
            self._imu.advance(~diverged, self._state.q[:, 0], self._state.q_dot[:, 0])
        before, self._measured = self._measured, self._measure(~diverged)
        self._shown = before if self.config.scenario.delay_steps else self._measured
        if self._sensors:
            self._feel(simulation)
            self._sensors.measure(~diverged, self.truth())
        sample = self.sample()
        ends = np.array([diverged, diverged, (self._step >= self.num_steps) & ~diverged])
        reward = functools.reduce(np.add, self.reward_terms(sample).values())
        return Outcome(self.observe(), sample, reward, ends, bool(ends.any()))

    def observe(self) -> Array:
        """The columns of `observation_table`."""
        coming, shown = self._coming, self._shown
        rate = (shown.encoder - shown.encoder_before) / self.config.control_period_s
        columns = [shown.encoder, rate, coming.q, coming.q_dot, coming.q_ddot, self._command]
        if self._observes_imu:
            columns.append(shown.imu)
        if self._sensors:
            columns.append(self._sensors.columns(np.full(self.num_worlds, self.config.scenario.delay_steps > 0)))
        return np.concatenate(columns, axis=1)

    def sample(self) -> JointSample:
        """What this step is scored by."""
        reference = self._present
        servo_error = self._command - self._encoder_bias - self._state.theta
        command_rate = (self._offset - self._offset_before) / self.config.control_period_s
        return JointSample(
            self._step, reference.q, reference.scored, reference.rest, self._state, self._shown.imu, servo_error,
            command_rate, self._stiffness, self._diverged,
        )  # fmt: skip

    def signals(self, sample: JointSample) -> Signals:
        """Truth and scores of samples, one value per row."""
        state = sample.state
        deflection = state.theta - state.q
        of_joints = {
            "reference_angle": sample.q_ref,
            "link_angle": state.q,
            "link_angle_imu": sample.imu,
            "link_error": sample.q_ref - state.q,
            "link_error_imu": sample.q_ref - sample.imu,
            "deflection": deflection,
            "joint_torque": self._joint_torque(deflection, state.theta_dot - state.q_dot, sample.stiffness),
            "servo_error": sample.servo_error,
            "command_rate": sample.command_rate,
        }
        if len(self._joints) == 1:
            shown = {name: values[:, 0].copy() for name, values in of_joints.items()}
        else:
            shown = self._of_several(of_joints)
        if self._plant.end_effector is not None:
            distance, tilt = self._plant.end_effector.errors(sample.q_ref, state.q)
            shown |= {"end_effector_error": distance, "end_effector_tilt": tilt}
        return {"time_s": sample.step * self.config.control_period_s, **shown, "rest": sample.rest.copy()}

    def _of_several(self, of_joints: dict[str, Array]) -> Signals:
        """Signals of every joint, and what they come to together."""
        each = {
            one: values[:, column].copy()
            for name, values in of_joints.items()
            if "imu" not in name
            for column, one in enumerate(_names(name, self._joints))
        }
        error = of_joints["link_error"]
        summed = "link_error", "deflection", "servo_error", "command_rate"
        together = {name: over_joints(of_joints[name]) for name in summed}
        return {
            **each,
            **together,
            "link_error_lowest": error.min(axis=1),
            "link_error_highest": error.max(axis=1),
            "link_error_largest": np.abs(error).max(axis=1),
            "joint_torque": np.abs(of_joints["joint_torque"]).max(axis=1),
        }

    def masks(self, sample: JointSample) -> dict[str, BoolArray]:
        """Windows at rest of `hold`; all but standing and onset of the other references."""
        return {"scored": sample.scored}

    def reward_terms(self, sample: JointSample) -> dict[str, Array]:
        """Weighted penalties for link error, restless commands and divergence."""
        weights = self.config.reward
        return {
            "link_error": weights.link_error * tracking_penalty(sample.q_ref - sample.state.q),
            "command_rate": weights.command_rate * smoothness_penalty(sample.command_rate),
            "divergence": weights.divergence * divergence_penalty(sample.diverged),
        }

    def truth(self) -> JointTruth:
        """State without noise, and the true parameters."""
        state = self._state
        deflection = state.theta - state.q
        torque = self._joint_torque(deflection, state.theta_dot - state.q_dot, self._stiffness)
        values = (state.q, torque, self._force, state.theta, state.theta_dot, state.q_dot, deflection, self._stiffness)
        return JointTruth(*(value.copy() for value in values), model=self._true_model)

    def _joint_torque(self, deflection: Array, deflection_rate: Array, stiffness: Array) -> Array:
        model = self._true_model
        return joint_torque(deflection, deflection_rate, stiffness, model.damping, model.backlash)

    def _spread_joints(self) -> Sequence[str]:
        """Joints whose springs differ from world to world."""
        return self._joints if self.config.scenario.stiffness_spread > 0.0 and self.config.form == "tendon" else ()

    def _spread(self, simulation: Simulation, worlds: BoolArray, draws: Sequence[Draws]) -> None:
        """Draw a factor on K for every joint of new robots, and give it to the springs."""
        width, factor = self.config.scenario.stiffness_spread, self._factor.copy()
        for world in np.flatnonzero(worlds).tolist():
            factor[world] = 1.0 + width * draws[world].robot.uniform(-1.0, 1.0, len(self._joints))
        # samples keep the array that they were taken with
        self._factor, self._stiffness = factor, factor * self._true_model.stiffness
        if len(self._springs):
            each = np.ix_(worlds, self._springs)
            simulation.vary("tendon_stiffness")[each] = factor[worlds] * self.model.tendon_stiffness[self._springs]

    def _place(self, simulation: Simulation, worlds: BoolArray) -> None:
        command = (self._command - self._encoder_bias)[worlds]
        q = self._plant.rest_angle(command, self._factor[worlds])
        torque = self._plant.static_torque(q)
        theta = command - self._true_model.servo_compliance * torque
        simulation.qpos[np.ix_(worlds, self._at.theta)] = theta
        simulation.qpos[np.ix_(worlds, self._at.q)] = q
        simulation.ctrl[np.ix_(worlds, self._inputs)] = command
        for column, servo in enumerate(self._true_model.servos):
            if servo.integral_gain > 0.0:
                simulation.act[worlds, self._integrators[column]] = torque[:, column] / servo.integral_gain

    def _read(self, simulation: Simulation, worlds: BoolArray) -> None:
        """The true state of some worlds; the others keep their last one."""
        at, qpos, qvel = self._at, simulation.qpos, simulation.qvel
        now = JointState(qpos[:, at.theta], qvel[:, at.theta_dot], qpos[:, at.q], qvel[:, at.q_dot])
        self._state = now if worlds.all() else self._state.with_worlds(worlds, now)

    def _follow(self) -> None:
        """Look the reference up at the present step and at the next one."""
        self._present, self._coming = self._reference.at(self._step), self._reference.at(self._step + 1)

    def _feel(self, simulation: Simulation) -> None:
        """Take the specific force, which lags one physics step behind, where the model has the sensor for it."""
        if ACCELEROMETER in self.config.sensors:
            self._force = specific_force(self.model, simulation.bind("sensordata"))

    def _measure(self, worlds: BoolArray) -> Measurement:
        """What the sensors say now; the other worlds keep their last values."""
        scenario, last = self.config.scenario, self._measured
        counts = self._true_model.encoder_counts_per_turn if scenario.encoder_counts else None
        due = worlds & is_due(self._step, scenario.imu.rate_hz, self.config.control_period_s)
        fresh = Measurement(
            encoder=quantise(self._state.theta + self._encoder_bias, angle_of_count(counts)),
            encoder_before=last.encoder,
            imu=np.where(due[:, None], self._link_angle(due), last.imu),
        )
        return fresh if worlds.all() else last.with_worlds(worlds, fresh)

    def _link_angle(self, due: BoolArray) -> Array:
        """What the IMUs of worlds whose next sample is due show of the links, (num_worlds, n) [rad]."""
        noise, imu = self._noise.next(due)["imu"][:, None], self.config.scenario.imu
        if self._imu is None:
            return attitude(imu, self._state.q, self._imu_bias, noise)
        return attitude(imu, self._imu.angle[:, None], self._imu_bias, np.zeros_like(noise))


def stiffest(model: mujoco.MjModel, scenario: Scenario) -> mujoco.MjModel:
    """A model with the stiffest springs that a scenario draws; all tendons with stiffness count as springs."""
    if scenario.stiffness_spread == 0.0:
        return model
    stiff = copy.copy(model)
    stiff.tendon_stiffness[:] *= 1.0 + scenario.stiffness_spread
    return stiff


def _inertial_imu(config: JointConfig, plant: JointPlant, num_worlds: int) -> PendulumImu | None:
    """The IMU that computes its attitude, in scenarios that have one.

    Raises:
        ConfigurationError: The robot has no place for it.
    """
    sensor = config.scenario.inertial
    if sensor is None:
        return None
    if plant.imu_arm_m is None:
        raise ConfigurationError(
            f"scenario {config.scenario.name!r} is about the IMU on a link, which {plant.name} does not have; "
            "choose another one, or the testbed or the walker"
        )
    gravity = float(np.linalg.norm(plant.model.opt.gravity))
    return PendulumImu(sensor, plant.imu_arm_m, gravity, config.control_period_s, num_worlds)
