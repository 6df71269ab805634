"""The walking task: walk on elastic legs, in place or from foothold to foothold.

The goal is a level pelvis, and ZMP and feet at their planned places. `score_walk` in
`world.walk_reward` is the reward, `WalkRewardWeights` has its weights.

Observation of one world (float64); joints are l_hip_yaw, l_hip_roll, l_hip_pitch, l_knee,
l_ankle_pitch, l_ankle_roll, then the same of the right leg (r_...); a name before a dot has one
column per joint or component after it:

| columns | names | unit | meaning |
|---|---|---|---|
| 0 to 11 | `encoder_angle.<joint>` | rad | motor encoder, θ in whole counts |
| 12 to 23 | `encoder_rate.<joint>` | rad/s | its change over the last control period |
| 24, 25 | `imu_attitude.roll`, `.pitch` | rad | IMU in the pelvis; by its own filter in the scenario `imu` |
| 26 to 28 | `imu_rate.x`, `.y`, `.z` | rad/s | its gyroscope, in the frame of the pelvis; the mean of a period in `imu` |
| 29 to 31 | `wrench.l_fx`, `.l_fy`, `.l_fz` | N | left ankle sensor: force of foot on leg, in the foot's frame |
| 32 to 34 | `wrench.l_mx`, `.l_my`, `.l_mz` | N·m | moment about the ankle, likewise |
| 35 to 40 | `wrench.r_fx` to `.r_mz` | N, N·m | right ankle sensor |
| 41 to 52 | `reference_angle.<joint>` | rad | q_ref at the end of the coming control period |
| 53 to 64 | `reference_rate.<joint>` | rad/s | its rate |
| 65 to 76 | `reference_acceleration.<joint>` | rad/s² | its acceleration |
| 77 | `clock.time` | s | end of the coming control period, from the start of the walk plan |
| 78 | `clock.swing` | 1 | progress of the swing, 0 before lift-off, 1 after touch-down |
| 79 | `clock.support` | 1 | support foot of the step, 0 left, 1 right |
| 80 | `load_share` | 1 | share μ of the weight on the right foot |
| 81, 82 | `zmp_reference.x`, `.y` | m | in the plan's world frame |
| 83 to 94 | `last_command.<joint>` | rad | θ_cmd of the last control period |

Action of one world (float32): the command offsets a = θ_cmd − q_ref [rad] in the order of the
joints, within ±0.3.

`info` of one world, at the end of the control period; true values unless the table says otherwise.
Positions are in the plan's world frame, x forward at the start, y to the left:

| key | unit | meaning |
|---|---|---|
| `time_s` | s | since the start of the plan; a walk of fewer steps leaves out strides |
| `pelvis_roll`, `pelvis_pitch` | rad | attitude of the pelvis, positive to the right and forward down |
| `pelvis_error` | rad | angle between its z axis and the vertical, never negative |
| `pelvis_height` | m | of the pelvis' origin |
| `zmp_x`, `zmp_y` | m | ZMP by the ankle sensors; nan where the feet carry almost nothing |
| `zmp_reference_x`, `zmp_reference_y` | m | planned |
| `zmp_deviation` | m | distance to the plan; nan likewise |
| `zmp_deviation_x`, `zmp_deviation_y` | m | its parts, measured − planned |
| `foot_drift` | m | displacement of the feet from the plan, weighted by their shares of the force; nan likewise |
| `foot_drift_x`, `foot_drift_y` | m | its parts |
| `zmp_in_feet` | m | distance of the ZMP to the plan for feet at their planned places; nan likewise |
| `zmp_in_feet_x`, `zmp_in_feet_y` | m | its parts, `zmp_deviation` − `foot_drift` |
| `link_error` | rad | rms of q_ref − q over the twelve joints |
| `link_error_lowest`, `link_error_highest` | rad | smallest and largest of them |
| `deflection` | rad | rms of δ = θ − q over the joints |
| `joint_torque` | N·m | largest magnitude of the joints' spring torques |
| `servo_torque` | N·m | rms over the joints |
| `command_rate` | rad/s | rms of the rate of change of the offsets |
| `force_left`, `force_right` | N | vertical force of the ground on each foot |
| `load_share` | 1 | planned share of the weight on the right foot |
| `swing`, `single_support` | 1 | progress of the swing; 1 where one foot carries alone, else 0 |
| `support` | 1 | support foot of the step, 0 left, 1 right |
| `position_error` | m | distance of the middle of the ankles from the planned one |
| `heading_error` | rad | heading of the pelvis minus the planned one, positive to the left |
| `early_touchdown` | s | at a planned touch-down, time since the first touch-down in the second half of the swing; else 0 |
| `clipped` | 1 | 1 where an action was beyond its bounds |
| `reward_terms` | 1 | weighted terms of the reward, by name |
| `termination` | | why the episode ended: "fell", "diverged", or "" |
| `episode_metrics` | | at the end of the episode: its figures, whose names end with their unit; ZMP where loaded |
"""  # noqa: E501

from functools import partial
from typing import Any

import numpy as np

from elastic_env.core.episode_random import EpisodeRandom
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray, IntArray, Signals
from elastic_env.motion import walk_plan
from elastic_env.motion.gait import LEFT, RIGHT
from elastic_env.motion.trajectory import Motion, Plan
from elastic_env.motion.walk_plan import WalkPlan, plan_walk
from elastic_env.robots.thormang import NAME, constants, records, walk_signals
from elastic_env.robots.thormang.config import WalkConfig, placed_robot
from elastic_env.robots.thormang.constants import TOUCHDOWN, RobotKind
from elastic_env.robots.thormang.model import biped
from elastic_env.world import walk_kernels as kernels
from elastic_env.world.attitude_kernels import rotations_of
from elastic_env.world.foot_sensors import foot_errors
from elastic_env.world.joint_kernels import EVERY_WORLD
from elastic_env.world.records import Records, Sample, first_columns, spring_torque
from elastic_env.world.robot_model import WalkerModel
from elastic_env.world.task import Task


class WalkTask(Task):
    """Rules of `elastic_env/WalkInPlace-v0`: joints, gait, contacts, pelvis and ZMP."""

    config: WalkConfig
    assumed_model: WalkerModel
    failure_names: tuple[str, ...] = (walk_signals.FELL,)
    world_type = records.WORLD
    noise_type = records.NOISE

    def __init__(self, config: WalkConfig, num_worlds: int) -> None:
        scenarios = config.scenarios or (config.scenario,) * num_worlds
        if len(scenarios) != num_worlds:
            needed = f"a name, or a list with one for each world, {num_worlds}"
            raise ConfigurationError(f"scenario must be {needed}, got {len(scenarios)}")
        robot = biped(config.robot)  # pyright: ignore[reportArgumentType]  frozen models can be hashed
        period_s = config.control_period_s
        plan = plan_walk(config.gait, robot, period_s)  # pyright: ignore[reportArgumentType]
        joints = config.assumed_joints
        assumed = WalkerModel(joints, robot.rigid, period_s, biped=robot, plan=plan)
        walk_plan.require_feasible(plan, robot, assumed.servos)
        kinds = [RobotKind.of(part, plan) for part in config.scenario_configs()]
        self._variants = [(kind, *v) for kind in kinds for v in kind.sensor_variants]
        super().__init__(
            config=config,
            name=NAME,
            model=kinds[0].model,
            assumed=assumed,
            motion=Motion(partial(_joint_plan, plan)),
            table=walk_signals.OBSERVATION.signals,
            sensors=config.sensors,
            joints=walk_signals.JOINTS,
            scenarios=scenarios,
            metrics=walk_signals.METRICS,
            kinds=[(kind.encoder_counts, late) for kind, late, _ in self._variants],
        )
        table = self.observation_table
        by_scenario = {kind.config.scenario: kind for kind in kinds}
        self.plan = plan
        self._kinds = kinds
        models = [kind.true_model.with_observation_table(table) for kind in kinds]
        self._true_models = tuple(models)
        self._kind_of_world = [by_scenario[scenario] for scenario in scenarios]
        self._torso = self.model.body("upper_body").id
        self._phases = constants.phase_masks(plan)
        self._bias = np.zeros(num_worlds, records.BIAS)
        step_rows = round(plan.gait.step_period_s / period_s)
        most = plan.gait.num_steps
        self._skips = [step_rows * (most - steps) for steps in config.numbers_of_steps]
        self.fewest_control_steps = self.num_steps - max(self._skips)
        rows = [constants.walk_constants(kind, fitted) for kind, _, fitted in self._variants]
        self._walk_constants = np.concatenate(rows)
        self._inertial = constants.inertial_constants(self._variants, robot.gravity)
        self._plan_rows = constants.plan_rows(plan, config)
        self._walk_columns = first_columns(table, records.COLUMNS)
        self._has_push = any(each.push_n > 0.0 for kind in kinds for each in kind.bank)
        push_s = np.array([scenario.push_s for scenario in scenarios])
        self._push_steps = (push_s / period_s).round()
        self._push_force = np.zeros((num_worlds, 3))
        self._push_begin = np.full(num_worlds, -1, dtype=np.int64)

    def has_fallen(self) -> BoolArray:
        """Return a mask of worlds whose pelvis is too low or tilted too much, (num_worlds,)."""
        truth = self._worlds[self._row]["truth"]
        rules = self._walk_constants[self._kind]
        is_low = truth["pelvis"][:, 2] < rules["lowest_pelvis_m"]
        is_tilted = truth["tilt"] > rules["highest_tilt_rad"]
        return (is_low | is_tilted) & ~truth["diverged"]

    def truth(self) -> records.WalkTruth:
        """Return the state without noise, and the true parameters."""
        joints = self._joints[self._row]["truth"]
        body = self._worlds[self._row]["truth"]
        joint_fields = ("theta", "theta_dot", "q", "q_dot", "stiffness", "backlash")
        body_fields = ("pelvis", "ankles", "pelvis_rate", "wrench")
        return records.WalkTruth(
            **{name: joints[name].copy() for name in joint_fields},
            **{name: self._bias[name].copy() for name in ("load", "slope", "friction")},
            **{name: body[name].copy() for name in body_fields},
            mounting=self._bias["imu_attitude"].copy(),
            pelvis_R=rotations_of(body["quaternion"].copy()),
            attitude=np.column_stack([body["roll"], body["pitch"]]),
            models=self._true_models,
        )

    def _draw(self, world: int, random: EpisodeRandom) -> None:
        generator = random.robot
        kind = self._kind_of_world[world]
        robot = kind.bank[int(generator.integers(len(kind.bank)))]
        self._set_robot(world, robot)
        bias = self._bias
        kg = robot.load_kg
        bias["load"][world] = kg, kg * robot.load_x_m, kg * robot.load_y_m
        direction = robot.slope_direction_rad
        unit = np.array([np.cos(direction), np.sin(direction)])
        bias["slope"][world] = robot.slope_rad * unit
        bias["friction"][world] = robot.friction
        bias["imu_attitude"][world] = robot.mounting_rad
        # unused numbers, which keep the trials of recorded results the same
        generator.random(2)
        self._draw_push(world, random)
        self._noise.restart(world, random.noise())
        variant = (kind, robot.is_delayed, robot.is_inertial)
        self._kind[world] = self._variants.index(variant)
        self._draw_imu(world, generator)
        for name, values in foot_errors(robot).items():
            bias[name][world] = values
        if len(self._skips) > 1:
            number = random.draw_trial(lambda rng: int(rng.integers(len(self._skips))))
            bias["skipped"][world] = self._skips[number]

    def _draw_push(self, world: int, random: EpisodeRandom) -> None:
        """Draw time and direction of the push, within the scored steps."""
        scored = np.flatnonzero(self.plan.timing.scored)
        ends = (scored[0], scored[-1] + 1)
        self._push_begin[world] = random.draw_trial(lambda rng: rng.integers(*ends))
        direction = random.draw_trial(lambda rng: rng.uniform(0.0, 2.0 * np.pi))
        unit = np.array([np.cos(direction), np.sin(direction), 0.0])
        self._push_force[world] = self._robots[world].push_n * unit

    def _draw_imu(self, world: int, generator: np.random.Generator) -> None:
        """Draw the errors of an inertial IMU, if the robot has one."""
        bias = self._bias
        sensor = self._kind_of_world[world].config.scenario.inertial
        bias["gyro"][world] = bias["specific_force"][world] = 0.0
        if self._robots[world].is_inertial:
            normal = generator.standard_normal
            bias["imu_attitude"][world] += sensor.offset_rad * normal(2)
            bias["gyro"][world] = sensor.gyro_bias_rad_s * normal(3)
            bias["specific_force"][world] = sensor.accelerometer_bias_m_s2 * normal(3)

    def _place(self, worlds: BoolArray) -> None:
        simulation = self.simulation
        homing = self._joints[self._row]["truth"]["homing"]
        simulation.views(kernels.Physics._fields)
        simulation.bind("xfrc_applied")[worlds] = 0.0
        for world in np.flatnonzero(worlds).tolist():
            config = self._kind_of_world[world].config
            robot = self._robots[world].with_exact_sensors()
            model, rest = placed_robot(config, robot)  # pyright: ignore[reportArgumentType]  frozen models can be hashed
            simulation.set_model(world, model)
            simulation.qpos[world] = rest.qpos
            simulation.qvel[world] = 0.0
            simulation.act[world] = rest.act
            simulation.ctrl[world] = self.plan.q[0] - homing[world]
            simulation.bind("qacc_warmstart")[world] = rest.warmstart
        simulation.refresh(worlds)

    def _disturb(self) -> None:
        """Push the torso during the drawn time."""
        if self._has_push:
            steps = self._worlds[self._row]["truth"]["step"] - self._push_begin
            is_pushed = (steps >= 0) & (steps < self._push_steps)
            force = np.where(is_pushed[:, None], self._push_force, 0.0)
            self.simulation.bind("xfrc_applied")[:, self._torso, :3] = force

    def _begin_worlds(self, worlds: BoolArray) -> None:
        kernels.begin_walk(self._physics, self._step, self._walker, worlds)
        self._worlds[self._row]["scores"][worlds] = np.zeros((), records.SCORES)

    def _sense_worlds(self, control: tuple[Any, ...]) -> bool:
        state = (self._physics, self._step, self._walker)
        return kernels.sense_walk(*state, control, *EVERY_WORLD)

    def _observe_worlds(self, observation: Array) -> None:
        kernels.observe_all_walkers(self._step, self._walker, observation)

    @property
    def _physics(self) -> tuple[Any, ...]:
        """Parts of `kernels.Physics`."""
        return self.simulation.views(kernels.Physics._fields)

    @property
    def _walker(self) -> tuple[Any, ...]:
        """Parts of `kernels.Walker`."""
        fixed = (self._walk_constants, self._plan_rows)
        return (*fixed, self._bias, self._inertial, self._walk_columns)

    def _signals(self, joints: Records, worlds: Records) -> Signals:
        truth = worlds["truth"]
        plan = self.plan
        timing = self.plan.timing
        row = self._plan_row(truth)
        error = joints["q_ref"] - joints["q"]
        deflection = joints["theta"] - joints["q"]
        zmp_ref = plan.zmp[row]
        deviation = truth["zmp"] - zmp_ref
        drift = truth["drift"]
        in_feet = deviation - drift
        middle = truth["ankles"][:, :, :2].mean(axis=1)
        return {
            "time_s": truth["step"] * self.config.control_period_s,
            "pelvis_roll": truth["roll"].copy(),
            "pelvis_pitch": truth["pitch"].copy(),
            "pelvis_error": truth["tilt"].copy(),
            "pelvis_height": truth["pelvis"][:, 2].copy(),
            **_components("zmp", truth["zmp"].copy()),
            **_components("zmp_reference", zmp_ref),
            "zmp_deviation": np.hypot(deviation[:, 0], deviation[:, 1]),
            **_components("zmp_deviation", deviation),
            "zmp_in_feet": np.hypot(in_feet[:, 0], in_feet[:, 1]),
            **_components("zmp_in_feet", in_feet),
            "foot_drift": np.hypot(drift[:, 0], drift[:, 1]),
            **_components("foot_drift", drift.copy()),
            "link_error": rms(error),
            "link_error_lowest": -row_maxima(-error),
            "link_error_highest": row_maxima(error),
            "deflection": rms(deflection),
            "joint_torque": row_maxima(np.abs(spring_torque(joints))),
            "servo_torque": truth["servo_torque"].copy(),
            "command_rate": truth["command_rate"].copy(),
            "force_left": truth["force"][:, LEFT].copy(),
            "force_right": truth["force"][:, RIGHT].copy(),
            "load_share": plan.share[row],
            "swing": timing.swing[row],
            "single_support": timing.single[row],
            "support": timing.support[row],
            "position_error": np.hypot(*(middle - plan.origin[row]).T),
            "heading_error": heading_error(truth["quaternion"], plan.heading[row]),
            "early_touchdown": self._early_touchdown_s(truth, row),
        }

    def masks(self, sample: Sample) -> dict[str, BoolArray]:
        """Return masks of the scored steps, their phases and blocks, all also with a ZMP."""
        truth = sample.worlds["truth"]
        loaded = ~np.isnan(truth["zmp"][:, 0])
        phases = self._phases[:, self._plan_row(truth)]
        names = (*walk_signals.PHASES, *walk_signals.BLOCKS)
        loaded_names = [f"{name}_loaded" for name in names]
        return {
            **dict(zip(["scored", *names, "touchdown"], phases, strict=True)),
            **dict(zip(["loaded", *loaded_names], phases[:-1] & loaded, strict=True)),
            "unloaded": phases[0] & ~loaded,
            "end": truth["step"] == self.num_steps,
        }

    def _plan_row(self, truth: Records) -> IntArray:
        """Rows in the plan's tables."""
        return np.minimum(truth["step"], self.num_steps)

    def _early_touchdown_s(self, truth: Records, row: IntArray) -> Array:
        """Time between the actual and the planned touch-down of the last swing [s]."""
        since = truth["contact_since"]
        early_s = (truth["step"] - since) * self.config.control_period_s
        return np.where(self._phases[TOUCHDOWN, row] & (since >= 0), early_s, 0.0)


def _joint_plan(walk: WalkPlan, *_: Any) -> Plan:
    """Return a walk plan as the joints' reference, the same in all episodes."""
    scored = walk.timing.scored
    no_window = np.full(len(scored), -1, dtype=np.int64)
    return Plan(walk.q, walk.q_dot, walk.q_ddot, scored, no_window)


def _components(name: str, vectors: Array) -> Signals:
    """Components of vectors in the plane, (rows, 2)."""
    return {f"{name}_x": vectors[:, 0], f"{name}_y": vectors[:, 1]}


def heading_error(quaternion: Array, planned: Array) -> Array:
    """Heading (of yaw, pitch, roll) minus the planned one, within half a turn, (n,) [rad].

    Args:
        quaternion: Orientation w, x, y, z, (n, 4).
        planned: Planned heading, continuous over full turns, (n,) [rad].
    """
    w, x, y, z = quaternion.T
    error = np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z)) - planned
    return error - 2.0 * np.pi * np.round(error / (2.0 * np.pi))


def row_maxima(values: Array) -> Array:
    """Maximum over the last axis of (n, m); NumPy is several times as fast over a first axis."""
    return values.T.copy().max(axis=0)


def rms(values: Array) -> Array:
    """Root mean square over the last axis of (n, m)."""
    # the kernel is compiled for contiguous arrays
    return kernels.rms_of_rows(np.array(values, order="C"))
