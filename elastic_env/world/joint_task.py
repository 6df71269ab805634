"""A task of n elastic joints: the links follow a reference while the joints bend under gravity.

The observation contains the encoders, the reference of the coming control period, the last command,
and the requested sensors; the action is the command offset of every joint. The signals of one joint
have plain names, those of several joints are `name.<joint>`. With several joints `info` has figures
of all joints together under the plain names: rms of the link errors, deflections, servo errors and
rates of the offsets, and the largest joint torque.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from elastic_env.core.episode_random import EpisodeRandom
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.files import read_rows
from elastic_env.core.signals import Array, BoolArray, Parameter, Signal, Signals
from elastic_env.joint.elasticity import static_link_angle
from elastic_env.joint.time_step import require_stable
from elastic_env.motion.trajectory import Motion, PlanTable
from elastic_env.rigid.tree.end_effector import EndEffector
from elastic_env.world import control_kernels as kernels
from elastic_env.world import drawn_robot, records
from elastic_env.world.further_sensors import SensorInputs
from elastic_env.world.joint_config import JointConfig
from elastic_env.world.joint_signals import joint_groups
from elastic_env.world.metrics import Metric
from elastic_env.world.physics import DIVERGED_RAD_S
from elastic_env.world.records import Records, Sample, single_record
from elastic_env.world.rest_watch import RestWatch
from elastic_env.world.robot_model import RobotModel
from elastic_env.world.robot_ranges import draw_robot, draw_robots
from elastic_env.world.sensors import PendulumImu, is_due
from elastic_env.world.task import Task, spring_torque

LINK_IMU = Signal("link_angle_imu", "rad", "IMU on the link", kind="measured")
LINK_IMU_SENSOR = "link_imu"
"""Its name in `sensors=[...]`, on a robot of one joint; its errors are the errors of the
scenario's IMU.
"""

_RIGID_NM_PER_RAD = 1e15
"""Finite stiffness of a joint without a spring, on a robot whose other servos give way."""

_METRIC_ROWS = read_rows(Path(__file__).with_name("joint_metrics.csv"))


def _metrics_for(robots: str) -> tuple[Metric, ...]:
    rows = [dict[str, Any](row) for row in _METRIC_ROWS]
    return tuple(Metric(**row) for row in rows if row.pop("robots") == robots)


METRICS_OF_ONE = _metrics_for("one")
METRICS_OF_SEVERAL = _metrics_for("several")
METRICS_OF_TOOL = _metrics_for("end_effector")


@dataclass(frozen=True)
class JointPlant:
    """The plant, and the robot as it is assumed and as it really is.

    Attributes:
        name: Name of the robot.
        model: Compiled model with elastic joints.
        assumed, true: Robot as a compensator may know it, and true robot; both without a table of
            observations.
        form: "rigid" for a robot without springs.
        static_torque: τ_g that holds the true links, from (..., n) [rad] to (..., n) [N·m].
        torque_gradient: ∂τ_g/∂q, from (..., n) to (..., n, n) [N·m/rad].
        motion: Reference motion of all joints.
        imu_arm_m: Distance of the link's IMU from the only joint [m]; the joint's axis is
            horizontal, and its link hangs at q = 0. None for a robot without such an IMU.
        end_effector: End effector whose place and tilt are scored; None to score joints only.
    """

    name: str
    model: mujoco.MjModel
    assumed: RobotModel
    true: RobotModel
    form: str
    static_torque: Callable[[Array], Array]
    torque_gradient: Callable[[Array], Array]
    motion: Motion
    imu_arm_m: float | None = None
    end_effector: EndEffector | None = None

    @property
    def joint_names(self) -> list[str]:
        """Names of the joints, in order."""
        return self.true.joint_names

    def rest_angle(
        self, command: Array, factor: Parameter = 1.0, backlash: Array | None = None
    ) -> Array:
        """Link angles at rest without friction.

        The load pulls a link to one side of its dead band. A link that hangs at q = 0 stays there
        within its dead band.

        Args:
            command: Commands of the servos, (..., n) [rad].
            factor: Factor on K, one number or (..., n) [1].
            backlash: Dead bands, (..., n) [rad]; None for the true joints' dead bands.

        Returns:
            (..., n) [rad].
        """
        stiffness = self.true.rest_stiffness(self.form, factor)
        if np.isinf(stiffness).all():
            return command
        band = self.true.backlash if backlash is None else backlash
        half = np.sign(self.static_torque(command)) * band / 2.0
        engaged = command - half
        if self.imu_arm_m is not None:
            engaged = np.where(np.abs(command) > np.abs(half), engaged, 0.0)
        finite = np.minimum(stiffness, _RIGID_NM_PER_RAD)
        return static_link_angle(
            engaged, finite, self.static_torque, self.torque_gradient, unique=False
        )


@dataclass(frozen=True)
class JointTruth(SensorInputs):
    """Noise-free state of the joints and their true parameters, one row per world.

    For scoring and the oracle.

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


class JointTask(Task):
    """Rules of a robot of elastic joints on a fixed base.

    Args:
        config: Reference, scenario, sensors, rewards, periods, and the plant that follows.
        num_worlds: Number of worlds.

    Raises:
        ConfigurationError: An unknown sensor, or the IMU of the link on a robot of several joints.
    """

    config: JointConfig
    world_type = records.LINK_WORLD
    noise_type = records.record_type(("imu", records.REAL))

    def __init__(self, config: JointConfig, num_worlds: int) -> None:
        plant: JointPlant = config.plant()
        joints = plant.joint_names
        observe_imu = LINK_IMU_SENSOR in config.sensors
        if observe_imu and len(joints) > 1:
            raise ConfigurationError(
                f"the sensor {LINK_IMU_SENSOR!r} needs a robot of one joint, and {plant.name} has"
                f" {len(joints)}; choose link_encoder to observe the links of several"
            )
        groups = joint_groups(dict.fromkeys(joints)).values()
        standard = [signal for group in groups for signal in group.signals]
        scenario = config.scenario
        period_s = config.control_period_s
        counts = plant.true.encoder_counts_per_turn if scenario.encoder_counts else None
        drawn_robot.require_bearable_friction(plant.true, scenario)
        metrics = METRICS_OF_ONE if len(joints) == 1 else METRICS_OF_SEVERAL
        if plant.end_effector is not None:
            metrics = metrics + METRICS_OF_TOOL
        require_stable(drawn_robot.stiffest_plant(plant.model, scenario), period_s)
        super().__init__(
            config=config,
            name=plant.name,
            model=plant.model,
            assumed=plant.assumed,
            motion=plant.motion,
            table=[*standard, LINK_IMU] if observe_imu else standard,
            sensors=[name for name in config.sensors if name != LINK_IMU_SENSOR],
            joints=dict.fromkeys(joints),
            scenarios=[scenario] * num_worlds,
            metrics=metrics,
            kinds=[(counts, False), (counts, True)],
            action_bound_rad=config.action_bound_rad,
        )
        self._plant = plant
        self._joint_names = joints
        self._true_model = plant.true.with_observation_table(self.observation_table)
        stiffness = plant.true.rest_stiffness(config.form)
        lag_s = plant.true.servo_lag
        self._has_rest_windows = bool((self._reference.rest >= 0).any())
        self._rest_watch = RestWatch(plant.static_torque, stiffness, joints, lag_s)
        self._imu = _inertial_imu(config, plant, num_worlds)
        self._imu_bias = np.zeros(num_worlds)
        columns = self.observation_table.names
        self._imu_column = columns.index(LINK_IMU.name) if observe_imu else -1
        self._schedule = _schedule(self._reference, scenario.imu.rate_hz, period_s)
        terms = records.LINK_SCORES.names or ()
        weights = {name: getattr(config.reward, name) for name in terms}
        self._link_constants = single_record(
            records.LINK_CONSTANTS,
            weights=single_record(records.LINK_SCORES, **weights),
            imu_noise_rad=scenario.imu.noise_rad,
            imu_bias_rad=scenario.imu.bias_rad,
            imu_sine_error_rad=scenario.imu.sine_error_rad,
        )
        self._springs = drawn_robot.spring_ids(self.model, joints, config.form)
        self._has_drawn_joints = drawn_robot.draws_joints(scenario)
        has_one_robot = scenario.has_one_robot
        robots = draw_robots(scenario.parts, int(has_one_robot), len(joints), [0])
        self._only_robot = robots[0] if has_one_robot else None

    def restart(self, worlds: BoolArray, random: Sequence[EpisodeRandom]) -> None:
        """Begin new episodes, also for the check of windows at rest."""
        super().restart(worlds, random)
        self._rest_watch.restart(worlds)

    def score(self) -> None:
        """Score further steps, and check that the joints rest in windows at rest."""
        rows = slice(self._unscored, self._row + 1)
        is_watched = self._has_rest_windows and not self._rest_watch.has_warned
        if is_watched and rows.start < rows.stop:
            truth = self._worlds[rows]["truth"]
            coming = self._reference.rest[np.minimum(truth["step"] + 1, self.num_steps)]
            is_last = (coming != truth["rest"]) | (truth["step"] >= self.num_steps)
            self._rest_watch.update(truth["rest"], is_last, self._joints[rows]["truth"])
        super().score()

    def masks(self, sample: Sample) -> dict[str, BoolArray]:
        """Mask of scored steps: windows at rest of `hold`; else all except standing and onset."""
        return {"scored": sample.worlds["truth"]["scored"]}

    def truth(self) -> JointTruth:
        """Return the state without noise, and the true parameters."""
        state = self._joints[self._row]["truth"]
        names = ("theta", "theta_dot", "q_dot", "stiffness")
        return JointTruth(
            **vars(self._sensor_inputs()),
            **{name: state[name].copy() for name in names},
            deflection=state["theta"] - state["q"],
            model=self._true_model,
        )

    def _draw(self, world: int, random: EpisodeRandom) -> None:
        generator = random.robot
        n = len(self._joint_names)
        self._reference.draw(world, generator)
        parts = self.config.scenario.parts
        robot = self._only_robot or draw_robot(parts, n, random.fork())
        self._set_robot(world, robot)
        # unused numbers, which keep the noise of recorded results the same
        generator.random(n + 1)
        self._noise.restart(world, random.noise())
        self._imu_bias[world] = robot.mounting_rad[0]
        if self._imu is not None:
            self._imu_bias[world] += self._imu.draw(world, generator, random.noise())
        self._kind[world] = int(robot.is_delayed)

    def _place(self, worlds: BoolArray) -> None:
        """Put the springs at their static deflection while the servos hold q_ref."""
        simulation = self.simulation
        addresses = self._addresses
        model = self._true_model
        truth = self._joints[self._row]["truth"][worlds]
        if self._has_drawn_joints:
            for world in np.flatnonzero(worlds).tolist():

                def field(name: str, world: int = world) -> Array:
                    return simulation.vary(name)[world]

                links = addresses["q_dot"]
                robot = self._robots[world]
                scenario = self.config.scenario
                drawn_robot.set_joints(field, self.model, self._springs, links, robot, scenario)
        q_ref = self._reference.motion[self._reference.plan_of_world[worlds], 0, 0]
        command = q_ref - truth["homing"]
        factor = truth["stiffness"] / model.stiffness
        q = self._plant.rest_angle(command, factor, truth["backlash"])
        torque = self._plant.static_torque(q)
        theta = command - model.servo_compliance * torque
        simulation.qpos[np.ix_(worlds, addresses["theta"])] = theta
        simulation.qpos[np.ix_(worlds, addresses["q"])] = q
        simulation.ctrl[np.ix_(worlds, addresses["servo"])] = command
        for column, servo in enumerate(model.servos):
            if servo.integral_gain > 0.0:
                integrator = self.model.actuator_actadr[addresses["servo"][column]]
                windup = torque[:, column] / servo.integral_gain
                simulation.act[worlds, integrator] = windup
        if self._has_sensors:
            simulation.bind("sensordata")
            simulation.refresh(worlds)

    def _begin_worlds(self, worlds: BoolArray) -> None:
        qpos = self.simulation.qpos
        if self._imu is not None:
            self._imu.settle(worlds, qpos[:, self._addresses["q"][0]])
        kernels.begin_links(qpos, self.simulation.qvel, self._step, self._links, worlds)

    def _sense_worlds(self, control: tuple[Any, ...]) -> bool:
        qpos = self.simulation.qpos
        qvel = self.simulation.qvel
        if self._imu is not None:
            is_too_fast = (np.abs(qvel) > DIVERGED_RAD_S).any(axis=1)
            diverged = kernels.Control(*control).diverged | is_too_fast
            q_dot = qvel[:, self._addresses["q_dot"][0]]
            self._imu.advance(~diverged, qpos[:, self._addresses["q"][0]], q_dot)
        return kernels.sense_links(
            qpos, qvel, self._step, self._links, control, *kernels.EVERY_WORLD
        )

    def _observe_worlds(self, observation: Array) -> None:
        if self._imu_column >= 0:
            measured = self._worlds[self._row]["measured"]
            observation[:, self._imu_column] = measured["visible_imu"]

    @property
    def _links(self) -> tuple[Any, ...]:
        """Parts of `kernels.Links`."""
        angle = None if self._imu is None else self._imu.angle
        constants = self._link_constants
        return self._schedule, constants, self._imu_bias, self._imu_column, angle

    def _signals(self, joints: Records, worlds: Records) -> Signals:
        q_ref = joints["q_ref"]
        q = joints["q"]
        joint_signals = {
            "reference_angle": q_ref,
            "link_angle": q,
            "link_error": q_ref - q,
            "deflection": joints["theta"] - q,
            "joint_torque": spring_torque(joints),
            "servo_error": joints["command"] - joints["homing"] - joints["theta"],
            "command_rate": joints["command_rate"],
        }
        if len(self._joint_names) == 1:
            imu = worlds["measured"]["visible_imu"]
            signals = {name: rows[:, 0].copy() for name, rows in joint_signals.items()}
            signals["link_angle_imu"] = imu.copy()
            signals["link_error_imu"] = q_ref[:, 0] - imu
        else:
            signals = self._signals_of_several(joint_signals)
        if self._plant.end_effector is not None:
            distance, tilt = self._plant.end_effector.errors(q_ref, q)
            signals |= {"end_effector_error": distance, "end_effector_tilt": tilt}
        truth = worlds["truth"]
        time_s = truth["step"] * self.config.control_period_s
        return {"time_s": time_s, **signals, "rest": truth["rest"].copy()}

    def _signals_of_several(self, joint_signals: dict[str, Array]) -> Signals:
        """Signals of each joint, and of all joints together."""
        each = {
            f"{name}.{joint}": values[:, column].copy()
            for name, values in joint_signals.items()
            for column, joint in enumerate(self._joint_names)
        }
        error = joint_signals["link_error"]
        rms_names = ("link_error", "deflection", "servo_error", "command_rate")
        squares = {name: np.square(joint_signals[name]) for name in rms_names}
        return {
            **each,
            **{name: np.sqrt(square.mean(axis=1)) for name, square in squares.items()},
            "link_error_lowest": error.min(axis=1),
            "link_error_highest": error.max(axis=1),
            "link_error_largest": np.abs(error).max(axis=1),
            "joint_torque": np.abs(joint_signals["joint_torque"]).max(axis=1),
        }


def _schedule(reference: PlanTable, imu_rate_hz: float, period_s: float) -> Records:
    """Records of `SCHEDULE`, one per control step."""
    rows = np.zeros(reference.num_steps + 1, records.SCHEDULE)
    rows["scored"] = reference.scored
    rows["rest"] = reference.rest
    rows["imu_is_due"] = is_due(np.arange(len(rows)), imu_rate_hz, period_s)
    rows.flags.writeable = False
    return rows


def _inertial_imu(config: JointConfig, plant: JointPlant, num_worlds: int) -> PendulumImu | None:
    """Make the IMU that computes its attitude; None in scenarios without one.

    Raises:
        ConfigurationError: The robot has no place for it.
    """
    scenario = config.scenario
    if all(part.inertial_share == 0.0 for part in scenario.parts):
        return None
    if any(part.inertial_share < 1.0 for part in scenario.parts):
        raise ConfigurationError(
            f"scenario {scenario.name!r} gives only some robots an IMU that computes"
            " its attitude; only the walker supports that, set inertial_share to 0 or 1"
        )
    if plant.imu_arm_m is None:
        raise ConfigurationError(
            f"scenario {scenario.name!r} is about the IMU on a link, which {plant.name}"
            " does not have; choose another one, or the testbed or the walker"
        )
    gravity = float(np.linalg.norm(plant.model.opt.gravity))
    place = (plant.imu_arm_m, gravity, config.control_period_s)
    return PendulumImu(scenario.inertial, *place, num_worlds)
