"""A task of n elastic joints: the links follow a reference while the joints bend under gravity.

The observation contains the encoders, the reference of the coming control period, the last command,
and the requested sensors; the action is the command offset of every joint. Signals and metrics are
those of `elastic_env.world.link_signals`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from elastic_env.core.episode_random import EpisodeRandom
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray, Signals
from elastic_env.joint.time_step import require_stable
from elastic_env.world import drawn_robot, records
from elastic_env.world import joint_kernels as kernels
from elastic_env.world.joint_config import JointConfig
from elastic_env.world.joint_plant import JointPlant, JointTruth, place_at_rest
from elastic_env.world.joint_signals import joint_groups
from elastic_env.world.link_constants import link_constants, link_schedule
from elastic_env.world.link_signals import LINK_IMU, LINK_IMU_SENSOR, link_signals, metrics_of
from elastic_env.world.pendulum_imu import make_pendulum_imu
from elastic_env.world.physics import DIVERGED_RAD_S
from elastic_env.world.records import Records, Sample
from elastic_env.world.rest_watch import RestWatch
from elastic_env.world.robot_ranges import draw_robot, draw_robots
from elastic_env.world.task import Task


class JointTask(Task):
    """Rules of a robot of elastic joints on a fixed base.

    Args:
        config: Reference, scenario, sensors, rewards, periods, and the robot.
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
            metrics=metrics_of(len(joints), plant.end_effector is not None),
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
        self._imu = make_pendulum_imu(config, plant, num_worlds)
        self._imu_bias = np.zeros(num_worlds)
        columns = self.observation_table.names
        self._imu_column = columns.index(LINK_IMU.name) if observe_imu else -1
        self._schedule = link_schedule(self._reference, scenario.imu.rate_hz, period_s)
        self._link_constants = link_constants(config)
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
        """Mask of scored steps: where poses are held, their windows at rest.

        In other motions: all steps but those of standing and of the onset.
        """
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
        truth = self._joints[self._row]["truth"][worlds]
        drawn = np.flatnonzero(worlds & self._has_drawn_joints)
        for world in drawn.tolist():

            def field(name: str, world: int = world) -> Array:
                return simulation.vary(name)[world]

            links = addresses["q_dot"]
            robot = self._robots[world]
            scenario = self.config.scenario
            drawn_robot.set_joints(field, self.model, self._springs, links, robot, scenario)
        q_ref = self._reference.motion[self._reference.plan_of_world[worlds], 0, 0]
        place_at_rest(self._plant, simulation, addresses, worlds, q_ref, truth)
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
        signals = link_signals(joints, worlds, self._joint_names)
        if self._plant.end_effector is not None:
            distance, tilt = self._plant.end_effector.errors(joints["q_ref"], joints["q"])
            signals |= {"end_effector_error": distance, "end_effector_tilt": tilt}
        truth = worlds["truth"]
        time_s = truth["step"] * self.config.control_period_s
        return {"time_s": time_s, **signals, "rest": truth["rest"].copy()}
