"""A task of n elastic joints: the links follow a reference while the joints bend under gravity.

The observation has the encoders, the reference of the coming control period, the last command, and
the sensors that are asked for; the action is the command offset of every joint. With one joint its
signals have plain names, with several `name.<joint>`, and `info` then has the figures of all joints
together under the plain names: rms of the link errors, of the deflections, of the servo errors and
of the offsets' rates, largest joint torque.
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
from elastic_env.core.robot_ranges import draw_robot, draw_robots
from elastic_env.core.signals import Array, BoolArray, Parameter, Signal, Signals
from elastic_env.joint.elasticity import static_link_angle
from elastic_env.joint.time_step import require_stable
from elastic_env.motion.trajectory import Motion, PlanTable
from elastic_env.rigid.tree.end_effector import EndEffector
from elastic_env.world import control_kernels as kernels
from elastic_env.world import rows as records
from elastic_env.world.drawn_robot import (
    joints_differ,
    require_passing,
    set_joints,
    spring_ids,
    stiffest_plant,
)
from elastic_env.world.further_sensors import SensorInputs
from elastic_env.world.joint_config import JointConfig
from elastic_env.world.joint_signals import joint_groups
from elastic_env.world.metrics import Metric
from elastic_env.world.physics import DIVERGED_RAD_S
from elastic_env.world.rest_check import RestWatch
from elastic_env.world.robot_model import RobotModel
from elastic_env.world.rows import Records, Sample, one
from elastic_env.world.sensors import PendulumImu, is_due
from elastic_env.world.task import Task, spring_torque

LINK_IMU = Signal("link_angle_imu", "rad", "IMU on the link", kind="measured")
LINK_IMU_SENSOR = "link_imu"
"""Name by which `sensors=[...]` asks for it, on a robot of one joint; its errors are those of
the scenario's IMU.
"""

_RIGID_NM_PER_RAD = 1e15
"""Stiffness of a joint without a spring beside servos that give way."""

_METRICS = read_rows(Path(__file__).with_name("joint_metrics.csv"))


def _metrics_of(robots: str) -> tuple[Metric, ...]:
    rows = [dict[str, Any](row) for row in _METRICS]
    return tuple(Metric(**row) for row in rows if row.pop("robots") == robots)


METRICS_OF_ONE = _metrics_of("one")
METRICS_OF_SEVERAL = _metrics_of("several")
METRICS_OF_TOOL = _metrics_of("end_effector")


@dataclass(frozen=True)
class JointPlant:
    """The plant, and what is known of it.

    Attributes:
        name: Of the robot.
        model: Compiled, with elastic joints.
        assumed, true: What a compensator may know, and what is; without a table of observations.
        form: "rigid" for a robot without springs.
        static_torque: τ_g that holds the true links, from (..., n) [rad] to (..., n) [N·m].
        torque_gradient: ∂τ_g/∂q, from (..., n) to (..., n, n) [N·m/rad].
        motion: The reference as all joints follow it.
        imu_arm_m: Distance of the link's IMU from the only joint, which has a horizontal axis and a
            link that hangs at q = 0 [m]; None where there is no such IMU.
        end_effector: Whose place and tilt are scored; None where the joints alone are.
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

        A dead band is crossed to the side to which the load pulls; a link that hangs at q = 0 hangs
        there within it.

        Args:
            command: Of the servos, (..., n) [rad].
            factor: On K, one number or (..., n) [1].
            backlash: Dead bands, (..., n) [rad]; None for those of the true joints.

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
        config: Reference, scenario, sensors, rewards, periods, and the plant that they make.
        num_worlds: How many.

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
        require_passing(plant.true, scenario)
        metrics = METRICS_OF_ONE if len(joints) == 1 else METRICS_OF_SEVERAL
        if plant.end_effector is not None:
            metrics = metrics + METRICS_OF_TOOL
        require_stable(stiffest_plant(plant.model, scenario), period_s)
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
        self._true_model = plant.true.observed_by(self.observation_table)
        stiffness = plant.true.rest_stiffness(config.form)
        lag_s = plant.true.servo_lag
        self._rests = bool((self._reference.rest >= 0).any())
        self._rest_watch = RestWatch(plant.static_torque, stiffness, joints, lag_s)
        self._imu = _inertial_imu(config, plant, num_worlds)
        self._imu_bias = np.zeros(num_worlds)
        columns = self.observation_table.names
        self._imu_column = columns.index(LINK_IMU.name) if observe_imu else -1
        self._schedule = _schedule(self._reference, scenario.imu.rate_hz, period_s)
        terms = records.LINK_SCORES.names or ()
        weights = {name: getattr(config.reward, name) for name in terms}
        self._link_constants = one(
            records.LINK_CONSTANTS,
            weights=one(records.LINK_SCORES, **weights),
            imu_noise_rad=scenario.imu.noise_rad,
            imu_bias_rad=scenario.imu.bias_rad,
            imu_sine_error_rad=scenario.imu.sine_error_rad,
        )
        self._springs = spring_ids(self.model, joints, config.form)
        self._joints_differ = joints_differ(scenario)
        is_one = scenario.has_one_robot
        same = draw_robots(scenario.parts, int(is_one), len(joints), [0])
        self._robot = same[0] if is_one else None

    def restart(self, worlds: BoolArray, random: Sequence[EpisodeRandom]) -> None:
        """Begin new episodes, also for the watch over windows at rest."""
        super().restart(worlds, random)
        self._rest_watch.restart(worlds)

    def score(self) -> None:
        """Score further steps, and look whether the joints rest in windows at rest."""
        rows = slice(self._unscored, self._row + 1)
        if self._rests and not self._rest_watch.is_said and rows.start < rows.stop:
            truth = self._worlds[rows]["truth"]
            coming = self._reference.rest[np.minimum(truth["step"] + 1, self.num_steps)]
            is_last = (coming != truth["rest"]) | (truth["step"] >= self.num_steps)
            self._rest_watch.see(truth["rest"], is_last, self._joints[rows]["truth"])
        super().score()

    def masks(self, sample: Sample) -> dict[str, BoolArray]:
        """Windows at rest of `hold`; all but standing and onset of the other references."""
        return {"scored": sample.worlds["truth"]["scored"]}

    def truth(self) -> JointTruth:
        """State without noise, and the true parameters."""
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
        robot = self._robot or draw_robot(parts, n, random.fork())
        self._take_robot(world, robot)
        # not used: noise follows what has always been drawn here
        generator.random(n + 1)
        self._noise.restart(world, random.noise())
        self._imu_bias[world] = robot.mounting_rad[0]
        if self._imu is not None:
            self._imu_bias[world] += self._imu.draw(world, generator, random.noise())
        self._kind[world] = int(robot.is_delayed)

    def _place(self, worlds: BoolArray) -> None:
        """The servos hold q_ref, the springs are already deflected."""
        simulation = self.simulation
        at = self._at
        scenario = self.config.scenario
        model = self._true_model
        truth = self._joints[self._row]["truth"][worlds]
        begun = np.flatnonzero(worlds).tolist()
        if self._joints_differ:
            for world in begun:

                def field(name: str, world: int = world) -> Array:
                    return simulation.vary(name)[world]

                links = at["q_dot"]
                robot = self._robots[world]
                set_joints(field, self.model, self._springs, links, robot, scenario)
        q_ref = self._reference.motion[self._reference.plan_of_world[worlds], 0, 0]
        command = q_ref - truth["homing"]
        factor = truth["stiffness"] / model.stiffness
        q = self._plant.rest_angle(command, factor, truth["backlash"])
        torque = self._plant.static_torque(q)
        theta = command - model.servo_compliance * torque
        simulation.qpos[np.ix_(worlds, at["theta"])] = theta
        simulation.qpos[np.ix_(worlds, at["q"])] = q
        simulation.ctrl[np.ix_(worlds, at["servo"])] = command
        for column, servo in enumerate(model.servos):
            if servo.integral_gain > 0.0:
                integrator = self.model.actuator_actadr[at["servo"][column]]
                held = torque[:, column] / servo.integral_gain
                simulation.act[worlds, integrator] = held
        if self._has_sensors:
            simulation.bind("sensordata")
            simulation.refresh(worlds)

    def _begin_worlds(self, worlds: BoolArray) -> None:
        qpos = self.simulation.qpos
        if self._imu is not None:
            self._imu.settle(worlds, qpos[:, self._at["q"][0]])
        kernels.begin_links(qpos, self.simulation.qvel, self._step, self._links, worlds)

    def _sense_worlds(self, control: tuple[Any, ...]) -> bool:
        qpos = self.simulation.qpos
        qvel = self.simulation.qvel
        if self._imu is not None:
            diverged = control[2] | (np.abs(qvel) > DIVERGED_RAD_S).any(axis=1)
            q_dot = qvel[:, self._at["q_dot"][0]]
            self._imu.advance(~diverged, qpos[:, self._at["q"][0]], q_dot)
        return kernels.sense_links(
            qpos, qvel, self._step, self._links, control, *kernels.EVERY_WORLD
        )

    def _show_worlds(self, observed: Array) -> None:
        if self._imu_column >= 0:
            shown = self._worlds[self._row]["shown"]
            observed[:, self._imu_column] = shown["visible_imu"]

    @property
    def _links(self) -> tuple[Any, ...]:
        """`kernels.Links`."""
        angle = None if self._imu is None else self._imu.angle
        constants = self._link_constants
        return self._schedule, constants, self._imu_bias, self._imu_column, angle

    def _signals(self, joints: Records, worlds: Records) -> Signals:
        q_ref = joints["q_ref"]
        q = joints["q"]
        of_joints = {
            "reference_angle": q_ref,
            "link_angle": q,
            "link_error": q_ref - q,
            "deflection": joints["theta"] - q,
            "joint_torque": spring_torque(joints),
            "servo_error": joints["command"] - joints["homing"] - joints["theta"],
            "command_rate": joints["command_rate"],
        }
        if len(self._joint_names) == 1:
            imu = worlds["shown"]["visible_imu"]
            shown = {name: values[:, 0].copy() for name, values in of_joints.items()}
            shown["link_angle_imu"] = imu.copy()
            shown["link_error_imu"] = q_ref[:, 0] - imu
        else:
            shown = self._signals_of_several(of_joints)
        if self._plant.end_effector is not None:
            distance, tilt = self._plant.end_effector.errors(q_ref, q)
            shown |= {"end_effector_error": distance, "end_effector_tilt": tilt}
        truth = worlds["truth"]
        time_s = truth["step"] * self.config.control_period_s
        return {"time_s": time_s, **shown, "rest": truth["rest"].copy()}

    def _signals_of_several(self, of_joints: dict[str, Array]) -> Signals:
        """Signals of every joint, and what they come to together."""
        each = {
            f"{name}.{joint}": values[:, column].copy()
            for name, values in of_joints.items()
            for column, joint in enumerate(self._joint_names)
        }
        error = of_joints["link_error"]
        summed = ("link_error", "deflection", "servo_error", "command_rate")
        squared = {name: np.square(of_joints[name]) for name in summed}
        return {
            **each,
            **{name: np.sqrt(own.mean(axis=1)) for name, own in squared.items()},
            "link_error_lowest": error.min(axis=1),
            "link_error_highest": error.max(axis=1),
            "link_error_largest": np.abs(error).max(axis=1),
            "joint_torque": np.abs(of_joints["joint_torque"]).max(axis=1),
        }


def _schedule(reference: PlanTable, imu_rate_hz: float, period_s: float) -> Records:
    """Records of `SCHEDULE`, one per step."""
    rows = np.zeros(reference.num_steps + 1, records.SCHEDULE)
    rows["scored"] = reference.scored
    rows["rest"] = reference.rest
    rows["imu_is_due"] = is_due(np.arange(len(rows)), imu_rate_hz, period_s)
    rows.flags.writeable = False
    return rows


def _inertial_imu(config: JointConfig, plant: JointPlant, num_worlds: int) -> PendulumImu | None:
    """The IMU that computes its attitude, in scenarios that have one.

    Raises:
        ConfigurationError: The robot has no place for it.
    """
    scenario = config.scenario
    if all(own.inertial_share == 0.0 for own in scenario.parts):
        return None
    if any(own.inertial_share < 1.0 for own in scenario.parts):
        raise ConfigurationError(
            f"scenario {scenario.name!r} gives only some robots an IMU that computes its attitude;"
            " only the walker supports that, set inertial_share to 0 or 1"
        )
    if plant.imu_arm_m is None:
        raise ConfigurationError(
            f"scenario {scenario.name!r} is about the IMU on a link, which {plant.name} does"
            " not have; choose another one, or the testbed or the walker"
        )
    gravity = float(np.linalg.norm(plant.model.opt.gravity))
    place = (plant.imu_arm_m, gravity, config.control_period_s)
    return PendulumImu(scenario.inertial, *place, num_worlds)
