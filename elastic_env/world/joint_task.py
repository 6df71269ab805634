"""A task of n elastic joints: the links follow a reference while the joints bend under gravity.

The observation has the encoders, the reference of the coming control period, the last command, and
the sensors that are asked for; the action is the command offset of every joint. With one joint its
signals have plain names, with several `name.<joint>`, and `info` then has the figures of all joints
together under the plain names: rms of the link errors, of the deflections, of the servo errors and
of the offsets' rates, largest joint torque.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from typing_extensions import override

from elastic_env.core.episode_random import EpisodeRandom
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.robot_ranges import draw_robot
from elastic_env.core.signals import Array, BoolArray, Signal, Signals
from elastic_env.joint.time_step import require_stable
from elastic_env.motion.trajectory import Planned, PlanTable
from elastic_env.rigid.tree.end_effector import EndEffector
from elastic_env.world import control_kernels as kernels
from elastic_env.world.drawn_robot import (
    require_passing,
    set_joints,
    spring_ids,
    stiffest_plant,
)
from elastic_env.world.further_sensors import FurtherSensors, SensorInputs
from elastic_env.world.joint_config import JointConfig
from elastic_env.world.metrics import Metric
from elastic_env.world.physics import DIVERGED_RAD_S
from elastic_env.world.rest_check import RestWatch
from elastic_env.world.robot_model import RobotModel
from elastic_env.world.rows import COURSE, REAL, WHOLE, Records, Sample, one, record_type
from elastic_env.world.sensors import PendulumImu, is_due
from elastic_env.world.task import Task, joint_groups, joint_rules, spring_torque

LINK_IMU = Signal("link_angle_imu", "rad", "IMU on the link", kind="measured")
LINK_IMU_SENSOR = "link_imu"
"""Name by which `sensors=[...]` asks for it, on a robot of one joint; its errors are those of
the scenario's IMU.
"""

_SCORES = record_type(("link_error", REAL), ("command_rate", REAL), ("divergence", REAL))
_TRUTH = record_type(*COURSE, ("scored", np.bool_), ("rest", WHOLE))  # as in a `Plan`
_SHOWN = record_type(
    ("imu", REAL), ("visible_imu", REAL)
)  # link angle now, and as old as the scenario has it [rad]
_CONSTANTS = record_type(
    ("weights", _SCORES),
    ("imu_noise_rad", REAL),
    ("imu_bias_rad", REAL),
    ("imu_sine_error_rad", REAL),
)
_SCHEDULE = record_type(("scored", np.bool_), ("rest", WHOLE), ("imu_is_due", np.bool_))

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
    """The plant, and what is known of it.

    Attributes:
        name: Of the robot.
        model: Compiled, with elastic joints.
        assumed, true: What a compensator may know, and what is; without a table of observations.
        static_torque: τ_g that holds the true links, from (..., n) [rad] to (..., n) [N·m].
        rest_angle: Link angles at rest without friction, from the servos' commands, (..., n) [rad],
            and if they differ from the true ones the springs' factors, (..., n) [1], and the dead
            bands, (..., n) [rad].
        motion: The reference as all joints follow it.
        imu_arm_m: Distance of the link's IMU from the only joint, which has a horizontal axis and a
            link that hangs at q = 0 [m]; None where there is no such IMU.
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
        config: Reference, scenario, sensors, rewards, periods.
        plant: What moves.
        num_worlds: How many.
        observe_imu: Whether the IMU of the only link is observed, if no sensor of the configuration
            asks for it.

    Raises:
        ConfigurationError: An unknown sensor, or the IMU of the link on a robot of several joints.
    """

    config: JointConfig
    world_type = record_type(("truth", _TRUTH), ("shown", _SHOWN), ("scores", _SCORES))
    noise_type = record_type(("imu", REAL))

    def __init__(
        self, config: JointConfig, plant: JointPlant, num_worlds: int, observe_imu: bool = False
    ) -> None:
        joints = plant.joint_names
        observe_imu = observe_imu or LINK_IMU_SENSOR in config.sensors
        if observe_imu and len(joints) > 1:
            raise ConfigurationError(
                f"the sensor {LINK_IMU_SENSOR!r} needs a robot of one joint, and {plant.name} has"
                f" {len(joints)}; choose link_encoder to observe the links of several"
            )
        scenario = config.scenario
        scenarios = [scenario] * num_worlds
        period_s = config.control_period_s
        counts = plant.true.encoder_counts_per_turn if scenario.encoder_counts else None
        reference = PlanTable(plant.motion, period_s, num_worlds)
        require_passing(plant.true, scenario)
        require_stable(stiffest_plant(plant.model, scenario), period_s)
        super().__init__(
            config=config,
            name=plant.name,
            model=plant.model,
            assumed=plant.assumed,
            reference=reference,
            table=_observed(joints, observe_imu),
            sensors=FurtherSensors(
                names=[sensor for sensor in config.sensors if sensor != LINK_IMU_SENSOR],
                joints=dict.fromkeys(joints),
                scenarios=scenarios,
                counts_per_turn=plant.true.encoder_counts_per_turn,
            ),
            scenarios=scenarios,
            metrics=(
                *(METRICS_OF_ONE if len(joints) == 1 else METRICS_OF_SEVERAL),
                *(() if plant.end_effector is None else METRICS_OF_END_EFFECTOR),
            ),
            rules=joint_rules(period_s, [(counts, False), (counts, True)]),
            action_bound_rad=config.action_bound_rad,
        )
        self._plant = plant
        self._joint_names = joints
        self._true_model = plant.true.observed_by(self.observation_table)
        self._rest_watch = RestWatch(
            plant.static_torque,
            plant.true.rest_stiffness(config.form),
            joints,
            plant.true.servo_lag,
        )
        self._imu = _inertial_imu(config, plant, num_worlds)
        self._imu_bias = np.zeros(num_worlds)
        self._imu_column = self.observation_table.group(LINK_IMU.name).start if observe_imu else -1
        self._schedule = _schedule(reference, scenario.imu.rate_hz, period_s)
        self._link_constants = one(
            _CONSTANTS,
            weights=one(
                _SCORES, **{name: getattr(config.reward, name) for name in _SCORES.names or ()}
            ),
            imu_noise_rad=scenario.imu.noise_rad,
            imu_bias_rad=scenario.imu.bias_rad,
            imu_sine_error_rad=scenario.imu.sine_error_rad,
        )
        self._springs = spring_ids(self.model, joints, config.form)

    def restart(self, worlds: BoolArray, random: Sequence[EpisodeRandom]) -> None:
        """Begin new episodes, also for the watch over windows at rest."""
        super().restart(worlds, random)
        self._rest_watch.restart(worlds)

    def score(self) -> None:
        """Score further steps, and look whether the joints rest in windows at rest."""
        if not self._rest_watch.is_said and (self._reference.rest >= 0).any():
            for row in range(self._unscored, self._row + 1):
                joints = self._joints[row]["truth"]
                worlds = self._worlds[row]["truth"]
                coming = self._reference.rest[np.minimum(worlds["step"] + 1, self.num_steps)]
                is_last = (coming != worlds["rest"]) | (worlds["step"] >= self.num_steps)
                self._rest_watch.see(
                    rest=worlds["rest"],
                    is_last=is_last,
                    q_ref=joints["q_ref"],
                    q=joints["q"],
                    offset=joints["offset"],
                )
        super().score()

    def masks(self, sample: Sample) -> dict[str, BoolArray]:
        """Windows at rest of `hold`; all but standing and onset of the other references."""
        return {"scored": sample.worlds["truth"]["scored"]}

    def truth(self) -> JointTruth:
        """State without noise, and the true parameters."""
        inputs = self._sensor_inputs()
        state = self._joints[self._row]["truth"]
        return JointTruth(
            **vars(inputs),
            theta=state["theta"].copy(),
            theta_dot=state["theta_dot"].copy(),
            q_dot=state["q_dot"].copy(),
            deflection=state["theta"] - state["q"],
            stiffness=state["stiffness"].copy(),
            model=self._true_model,
        )

    def _draw(self, world: int, random: EpisodeRandom) -> None:
        scenario = self.config.scenario
        generator = random.robot
        n = len(self._joint_names)
        self._reference.draw(world, generator)
        homing = scenario.encoder_bias_rad * generator.uniform(-1.0, 1.0, n)
        mounting = scenario.imu.bias_spread_rad * generator.uniform(-1.0, 1.0)
        self._noise.restart(world, random.noise())
        if self._imu is not None:
            mounting += self._imu.draw(world, generator, random.noise())
        factor = np.ones(n)
        if scenario.stiffness_spread > 0.0:
            factor = 1.0 + scenario.stiffness_spread * generator.uniform(-1.0, 1.0, n)
        robot = scenario.make_robot(factor, homing, mounting_rad=(float(mounting), 0.0))
        if scenario.ranges:
            robot = draw_robot([ranges.on_fixed_base() for ranges in scenario.ranges], n, generator)
        self._take_robot(world, robot, self._true_model)
        self._imu_bias[world] = robot.mounting_rad[0]
        self._kind[world] = int(robot.is_delayed)

    def _place(self, worlds: BoolArray) -> None:
        """The servos hold q_ref, the springs are already deflected."""
        simulation = self.simulation
        at = self._at
        truth = self._joints[self._row]["truth"][worlds]
        robots = {world: self._robots[world] for world in np.flatnonzero(worlds).tolist()}
        if self.config.scenario.ranges or self.config.scenario.stiffness_spread > 0.0:
            for world, robot in robots.items():

                def field(name: str, world: int = world) -> Array:
                    return simulation.vary(name)[world]

                set_joints(field, self.model, self._springs, at["q_dot"], robot)
        q_ref = self._reference.motion[self._reference.plan_of_world[worlds], 0, 0]
        command = q_ref - truth["homing"]
        factor = np.array([robot.stiffness for robot in robots.values()])
        q = self._plant.rest_angle(command, factor, truth["backlash"])
        torque = self._plant.static_torque(q)
        simulation.qpos[np.ix_(worlds, at["theta"])] = (
            command - self._true_model.servo_compliance * torque
        )
        simulation.qpos[np.ix_(worlds, at["q"])] = q
        simulation.ctrl[np.ix_(worlds, at["servo"])] = command
        for column, servo in enumerate(self._true_model.servos):
            if servo.integral_gain > 0.0:
                integrator = self.model.actuator_actadr[at["servo"][column]]
                simulation.act[worlds, integrator] = torque[:, column] / servo.integral_gain
        if self._has_sensors:
            simulation.bind("sensordata")
            simulation.refresh(worlds)

    def _begin_worlds(self, worlds: BoolArray) -> None:
        simulation = self.simulation
        joints = self._constants
        if self._imu is not None:
            self._imu.settle(worlds, simulation.qpos[:, self._at["q"][0]])
        noise = self._noise.ready()
        kernels.begin_links(
            simulation.qpos, simulation.qvel, joints, self._links, noise, worlds, self._steps()
        )

    @override
    def _sense_worlds(
        self,
        joints: tuple[Any, ...],
        noise: tuple[Any, ...],
        commanded: tuple[Any, ...],
        steps: tuple[Any, ...],
        results: tuple[Any, ...],
    ) -> bool:
        qpos = self.simulation.qpos
        qvel = self.simulation.qvel
        if self._imu is not None:
            too_fast = (np.abs(qvel) > DIVERGED_RAD_S).any(axis=1)
            self._imu.advance(
                ~(commanded[2] | too_fast), qpos[:, self._at["q"][0]], qvel[:, self._at["q_dot"][0]]
            )
        return kernels.sense_links(
            qpos, qvel, joints, self._links, noise, commanded, steps, results
        )

    def _show_worlds(self, observed: Array) -> None:
        if self._imu_column >= 0:
            observed[:, self._imu_column] = self._worlds[self._row]["shown"]["visible_imu"]

    @property
    def _links(self) -> tuple[Any, ...]:
        """`kernels.Links`."""
        angle = None if self._imu is None else self._imu.angle
        return self._schedule, self._link_constants, self._imu_bias, self._imu_column, angle

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
            shown |= {"link_angle_imu": imu.copy(), "link_error_imu": q_ref[:, 0] - imu}
        else:
            shown = self._signals_of_several(of_joints)
        if self._plant.end_effector is not None:
            distance, tilt = self._plant.end_effector.errors(q_ref, q)
            shown |= {"end_effector_error": distance, "end_effector_tilt": tilt}
        truth = worlds["truth"]
        return {
            "time_s": truth["step"] * self.config.control_period_s,
            **shown,
            "rest": truth["rest"].copy(),
        }

    def _signals_of_several(self, of_joints: dict[str, Array]) -> Signals:
        """Signals of every joint, and what they come to together."""
        each = {
            f"{name}.{joint}": values[:, column].copy()
            for name, values in of_joints.items()
            for column, joint in enumerate(self._joint_names)
        }
        error = of_joints["link_error"]
        summed = ("link_error", "deflection", "servo_error", "command_rate")
        return {
            **each,
            **{name: np.sqrt(np.square(of_joints[name]).mean(axis=1)) for name in summed},
            "link_error_lowest": error.min(axis=1),
            "link_error_highest": error.max(axis=1),
            "link_error_largest": np.abs(error).max(axis=1),
            "joint_torque": np.abs(of_joints["joint_torque"]).max(axis=1),
        }


def _observed(joints: Sequence[str], observe_imu: bool) -> list[Signal]:
    """The standard columns."""
    groups = joint_groups(dict.fromkeys(joints))
    return [signal for group in groups for signal in group.signals] + (
        [LINK_IMU] if observe_imu else []
    )


def _schedule(reference: PlanTable, imu_rate_hz: float, period_s: float) -> Records:
    """Records of `_SCHEDULE`, one per step."""
    rows = np.zeros(reference.num_steps + 1, _SCHEDULE)
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
    sensor = config.scenario.inertial
    if sensor is None:
        return None
    if plant.imu_arm_m is None:
        raise ConfigurationError(
            f"scenario {config.scenario.name!r} is about the IMU on a link, which {plant.name} does"
            " not have; choose another one, or the testbed or the walker"
        )
    gravity = float(np.linalg.norm(plant.model.opt.gravity))
    return PendulumImu(sensor, plant.imu_arm_m, gravity, config.control_period_s, num_worlds)
