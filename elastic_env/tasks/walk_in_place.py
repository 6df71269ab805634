"""The walking task: a humanoid on elastic legs walks in place, its pelvis level, its ZMP where the plan has it.

Observation of one world (float64); joints are l_hip_yaw, l_hip_roll, l_hip_pitch, l_knee, l_ankle_pitch, l_ankle_roll,
then the same of the right leg (r_...); a name before a dot has one column per joint or component after it:

| columns | names | unit | meaning |
|---|---|---|---|
| 0 to 11 | `encoder_angle.<joint>` | rad | motor encoder, θ in whole counts |
| 12 to 23 | `encoder_rate.<joint>` | rad/s | its change over the last control period |
| 24, 25 | `imu_attitude.roll`, `.pitch` | rad | IMU in the pelvis |
| 26 to 28 | `imu_rate.x`, `.y`, `.z` | rad/s | its gyroscope, in the frame of the pelvis |
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

Action of one world (float32): the command offsets a = θ_cmd − q_ref [rad] in the order of the joints, within ±0.3.

`info` of one world, all at the end of the control period, the truth where nothing else is said; positions are in the
plan's world frame, x forward, y to the left:

| key | unit | meaning |
|---|---|---|
| `time_s` | s | since the start of the episode |
| `pelvis_roll`, `pelvis_pitch` | rad | attitude of the pelvis, positive to the right and forward down |
| `pelvis_error` | rad | angle between its z axis and the vertical, never negative |
| `pelvis_height` | m | of the pelvis' origin |
| `zmp_x`, `zmp_y` | m | ZMP by the ankle sensors; nan where the feet carry almost nothing |
| `zmp_reference_x`, `zmp_reference_y` | m | planned |
| `zmp_deviation` | m | distance to the plan; nan likewise |
| `zmp_deviation_x`, `zmp_deviation_y` | m | its parts, measured − planned |
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
| `early_touchdown` | s | at a planned touch-down, time since the first touch in the second half of the swing; else 0 |
| `clipped` | 1 | 1 where an action was beyond its bounds |
| `reward_terms` | 1 | weighted terms of the reward, by name |
| `termination` | | why the episode ended: "fell", "diverged", or "" |
| `episode_metrics` | | at the end of the episode: its figures, whose names end with their unit; ZMP where loaded |
"""

from collections.abc import Sequence

import numpy as np

from elastic_env.elasticity import joint_torque
from elastic_env.metrics import Metric
from elastic_env.robots.joint_names import JointAddresses
from elastic_env.robots.robot_model import RobotModel, WalkerModel
from elastic_env.robots.thormang import LEG_JOINTS, SIDES, biped
from elastic_env.scenario import Scenario
from elastic_env.sensors import NoiseStream, attitude, is_due, quantise
from elastic_env.signals import Array, BoolArray, IntArray, Signals
from elastic_env.simulation import Simulation, substeps
from elastic_env.tasks.walk_config import (
    FALL_HEIGHT_SHARE,
    FALL_TILT_RAD,
    WalkConfig,
    equilibrium,
    floor_tilt,
    robot_bank,
    spring_ids,
)
from elastic_env.tasks.walk_state import (
    ATTITUDE,
    RATE,
    WRENCH,
    WalkMeasurement,
    WalkSample,
    WalkState,
    WalkTruth,
    attitude_of,
    highest,
    rms,
    rotation_of,
)
from elastic_env.tasks.walk_tables import ACTION, FELL, METRICS, OBSERVATION, PHASES
from elastic_env.walking.gait import LEFT, RIGHT
from elastic_env.walking.ground_contact import FootSensors, zero_moment_point
from elastic_env.walking.walk_plan import WalkPlan, plan_walk, require_feasible, with_torque

UNLOADED_SHARE = 0.05
"""Share of the weight below which a foot, or the sensors of both together, count as unloaded."""


def tilt_penalty(pelvis_error: Array) -> Array:
    """−|tilt| [rad]: linear, so that a large error never stops to matter."""
    return -np.abs(pelvis_error)


def zmp_penalty(zmp_deviation: Array) -> Array:
    """−|ZMP deviation| [m]; none where the feet are not loaded and there is no ZMP."""
    return -np.where(np.isnan(zmp_deviation), 0.0, zmp_deviation)


class WalkTask:
    """Rules of `elastic_env/WalkInPlace-v0`, see `elastic_env.tasks.task.Task`."""

    name = "walker"
    action_table = ACTION
    observation_table = OBSERVATION
    assumed_model: RobotModel
    metrics: Sequence[Metric] = METRICS

    def __init__(self, config: WalkConfig, num_worlds: int) -> None:
        self.config = config
        self.num_worlds = num_worlds
        self.num_substeps = substeps(config.control_period_s, config.timestep_s)
        robot = biped(config.robot)  # pyright: ignore[reportArgumentType]  frozen models can be hashed
        self.plan = plan_walk(config.gait, robot, config.control_period_s)  # pyright: ignore[reportArgumentType]
        model = self.assumed_model = WalkerModel(
            config.assumed_joints, robot.rigid, config.control_period_s, OBSERVATION, biped=robot, plan=self.plan
        )
        require_feasible(self.plan, robot, model.servos)
        self._true_model = _true_model(config, self.plan)
        self.model = config.true_model()
        self._robot = robot
        at = JointAddresses.of(self.model, LEG_JOINTS)
        # motor sides, link sides, the pelvis
        self._positions = np.concatenate([at.theta, at.q, np.arange(7)])
        self._velocities = np.concatenate([at.theta_dot, at.q_dot, np.arange(3, 6)])
        self._bank = robot_bank(config.scenario, config.bank)
        self._springs = spring_ids(self.model) if config.form == "tendon" else None
        feet = [self.model.body(f"{side}_foot").id for side in SIDES]
        self._foot_sensors = FootSensors(
            self.model.body_mass[feet], self.model.body_ipos[feet], self.model.opt.gravity.copy()
        )
        self._sites = np.array([self.model.site(f"{side}_ft").id for side in SIDES])
        self._torso = self.model.body("upper_body").id
        self._weight = float(self.model.body_mass.sum()) * robot.gravity
        # sensors that carry nothing stand for a ground that carries the feet
        self._least_force = UNLOADED_SHARE * self._weight + float(self.model.body_mass[feet].sum()) * robot.gravity
        n, m = num_worlds, len(LEG_JOINTS)
        self.num_steps = self.plan.num_steps
        """Control steps of an episode."""
        self._count(np.zeros(n, dtype=np.int64))
        self._reference, self._phases = _reference_rows(self.plan), _phase_rows(self.plan)
        self._counts = np.where(self._phases[0], 1.0, config.reward.standing)
        self._half_of_swing, self._swing_foot = _halves_of_swing(self.plan), RIGHT - self.plan.timing.support
        for table in (self._reference, self._phases, self._counts):
            table.flags.writeable = False
        self._draw = np.zeros(n, dtype=np.int64)
        self._stiffness, self._damping = np.tile(self._true_model.stiffness, (n, 1)), self._true_model.damping
        self._backlash = self._true_model.backlash if self._true_model.backlash.any() else 0.0
        self._encoder_bias, self._imu_bias = np.zeros((n, m)), np.zeros((n, 2))
        self._push_force, self._push_begin = np.zeros((n, 3)), np.full(n, -1, dtype=np.int64)
        self._noise = NoiseStream(n, width=_NOISE_WIDTH)
        self._state = WalkState.zeros(n)
        self._measured = self._shown = WalkMeasurement.zeros(n)
        self._offset, self._offset_before, self._command = np.zeros((3, n, m))
        self._contact_since, self._each = np.full(n, -1, dtype=np.int64), np.arange(n)
        self._fallen = np.zeros(n, dtype=np.bool_)
        self._noise_spread = _noise_spread(config.scenario)
        steps, imu = np.arange(self.num_steps + 1), config.scenario.pelvis_imu
        self._imu_is_due = is_due(steps, imu.rate_hz, config.control_period_s)
        self._imu_is_due_always = bool(self._imu_is_due.all())

    def restart(self, simulation: Simulation, worlds: BoolArray, generators: Sequence[np.random.Generator]) -> None:
        """Place robots in static equilibrium under zero offset."""
        scenario = self.config.scenario
        # samples of the steps before keep what they hold
        self._offset, self._offset_before = self._offset.copy(), self._offset_before.copy()
        self._stiffness, self._contact_since = self._stiffness.copy(), self._contact_since.copy()
        for field in _DERIVED:
            simulation.bind(field)
        simulation.bind("xfrc_applied")[worlds] = 0.0
        for world in np.flatnonzero(worlds).tolist():
            generator = generators[world]
            self._draw[world] = generator.integers(len(self._bank))
            self._imu_bias[world] = scenario.pelvis_imu.bias_spread_rad * generator.uniform(-1.0, 1.0, 2)
            self._draw_push(world, generator)
            self._noise.restart(world, np.random.default_rng(generator.integers(2**63)))
            self._place(simulation, world)
        self._count(np.where(worlds, 0, self._step))
        self._offset[worlds] = self._offset_before[worlds] = 0.0
        self._command[worlds] = self.plan.q[0]
        self._contact_since[worlds] = -1
        simulation.refresh(worlds)
        self._read(simulation, worlds)
        fresh = self._measure(worlds)
        at_rest = WalkMeasurement(fresh.encoder, fresh.encoder, fresh.body)
        self._measured = self._measured.with_worlds(worlds, at_rest)
        self._shown = self._shown.with_worlds(worlds, at_rest)

    def command(self, offset: Array) -> Array:
        """θ_cmd = q_ref + offset, as the servos get it: they know their angles only up to the homing error."""
        self._offset_before, self._offset = self._offset, offset.copy()
        self._command = self.plan.q.take(self._next, axis=0) + offset
        return self._command - self._encoder_bias

    def disturb(self, simulation: Simulation) -> None:
        """Push the torso where and when the scenario says."""
        if self.config.scenario.push_n > 0.0:
            steps = round(self.config.scenario.push_s / self.config.control_period_s)
            since = self._step - self._push_begin
            active = (since >= 0) & (since < steps)
            simulation.bind("xfrc_applied")[:, self._torso, :3] = np.where(active[:, None], self._push_force, 0.0)

    def sense(self, simulation: Simulation, healthy: BoolArray) -> None:
        """Read the new state, then what the sensors show of it."""
        self._step, self._now = self._step + 1, self._next
        self._next = self._row(self._step + 1)
        self._read(simulation, healthy)
        before, self._measured = self._measured, self._measure(healthy)
        self._shown = before if self.config.scenario.delay_steps else self._measured
        self._watch_swing_foot()

    def observe(self) -> Array:
        """See the table of the module."""
        shown = self._shown
        observation = np.empty((self.num_worlds, len(OBSERVATION)))
        observation[:, 0:12] = shown.encoder
        observation[:, 12:24] = (shown.encoder - shown.encoder_before) / self.config.control_period_s
        observation[:, 24:41] = shown.body
        observation[:, 41:83] = self._reference.take(self._next, axis=0)
        observation[:, 83:95] = self._command
        return observation

    def sample(self) -> WalkSample:
        """What this step is scored by."""
        return WalkSample(
            self._step, self._state, self._offset, self._offset_before, self._stiffness, self._contact_since
        )

    def signals(self, sample: WalkSample) -> Signals:
        """Truth and scores of samples, one value per row."""
        row, state, plan, timing = self._row(sample.step), sample.state, self.plan, self.plan.timing
        error, deflection = plan.q[row] - state.q, state.theta - state.q
        deflection_rate = state.theta_dot - state.q_dot
        torque = joint_torque(deflection, deflection_rate, sample.stiffness, self._damping, self._backlash)
        zmp_ref = plan.zmp[row]
        deviation = state.zmp - zmp_ref
        roll, pitch, tilt = state.attitude.T.copy()
        return {
            "time_s": sample.step * self.config.control_period_s,
            "pelvis_roll": roll,
            "pelvis_pitch": pitch,
            "pelvis_error": tilt,
            "pelvis_height": state.pelvis[:, 2].copy(),
            "zmp_x": state.zmp[:, 0].copy(),
            "zmp_y": state.zmp[:, 1].copy(),
            "zmp_reference_x": zmp_ref[:, 0],
            "zmp_reference_y": zmp_ref[:, 1],
            "zmp_deviation": np.hypot(deviation[:, 0], deviation[:, 1]),
            "zmp_deviation_x": deviation[:, 0],
            "zmp_deviation_y": deviation[:, 1],
            "link_error": rms(error),
            "link_error_lowest": -highest(-error),
            "link_error_highest": highest(error),
            "deflection": rms(deflection),
            "joint_torque": highest(np.abs(torque)),
            "servo_torque": rms(state.servo_torque),
            "command_rate": self._command_rate(sample),
            "force_left": state.force[:, LEFT].copy(),
            "force_right": state.force[:, RIGHT].copy(),
            "load_share": plan.share[row],
            "swing": timing.swing[row],
            "single_support": timing.single[row],
            "support": timing.support[row],
            "early_touchdown": self._earliness(sample),
        }

    def masks(self, sample: WalkSample) -> dict[str, BoolArray]:
        """The walk (standing before and after it does not count), its phases, and where there is a ZMP."""
        loaded = ~np.isnan(sample.state.zmp[:, 0])
        phases = self._phases[:, self._row(sample.step)]
        names = [f"{name}_loaded" for name in PHASES]
        return {
            **dict(zip(["scored", *PHASES, "touchdown"], phases, strict=True)),
            **dict(zip(["loaded", *names], phases[:-1] & loaded, strict=True)),
            "unloaded": phases[0] & ~loaded,
        }

    def reward_terms(self, sample: WalkSample, diverged: BoolArray) -> dict[str, Array]:
        """Weighted penalties for tilt, ZMP deviation, effort, restless commands and a fall."""
        weights, state = self.config.reward, sample.state
        deviation = state.zmp - self.plan.zmp.take(self._now, axis=0)
        counts = self._counts.take(self._now)
        return {
            "tilt": weights.tilt * counts * tilt_penalty(state.attitude[:, 2]),
            "zmp": weights.zmp * counts * zmp_penalty(np.hypot(deviation[:, 0], deviation[:, 1])),
            "effort": -weights.effort * rms(state.servo_torque),
            "smoothness": -weights.smoothness * self._command_rate(sample),
            "fall": -weights.fall * (diverged | self._fallen),
        }

    def finished(self) -> BoolArray:
        """The plan has come to its end."""
        return self._step >= self.num_steps

    def failures(self) -> dict[str, BoolArray]:
        """A fall: the pelvis is too low or too much tilted."""
        return {FELL: self._fallen}

    def truth(self) -> WalkTruth:
        """State without noise, and the true parameters."""
        s = self._state
        pelvis_R = rotation_of(s.quaternion)
        copies = (x.copy() for x in (s.theta, s.theta_dot, s.q, s.q_dot, s.pelvis, pelvis_R, s.ankles))
        return WalkTruth(*copies, stiffness=self._stiffness.copy(), model=self._true_model)

    def _row(self, step: IntArray) -> IntArray:
        return np.minimum(step, self.num_steps)

    def _count(self, step: IntArray) -> None:
        self._step, self._now, self._next = step, self._row(step), self._row(step + 1)

    def _command_rate(self, sample: WalkSample) -> Array:
        """Rate of change of the offsets, rms over the joints [rad/s]."""
        return rms(sample.offset - sample.offset_before) / self.config.control_period_s

    def _draw_push(self, world: int, generator: np.random.Generator) -> None:
        """Time and direction of the push, in the walk."""
        walking = np.flatnonzero(self.plan.timing.walking)
        begin = generator.integers(walking[0], walking[-1] + 1)
        direction = generator.uniform(0.0, 2.0 * np.pi)
        self._push_begin[world] = begin
        self._push_force[world] = self.config.scenario.push_n * np.array([np.cos(direction), np.sin(direction), 0.0])

    def _place(self, simulation: Simulation, world: int) -> None:
        """Give a world its robot, at rest."""
        scenario, draw = self.config.scenario, self._bank[self._draw[world]]
        self._encoder_bias[world] = draw.encoder_bias_rad
        self._stiffness[world] = self._true_model.stiffness * np.array(draw.stiffness_factor)
        if scenario.stiffness_spread > 0.0 and self._springs is not None:
            simulation.vary("tendon_stiffness")[world, self._springs] = self._stiffness[world]
        if scenario.slope_rad > 0.0:
            floor = simulation.model.body("floor").id
            simulation.vary("body_quat")[world, floor] = floor_tilt(scenario.slope_rad, draw.slope_direction_rad)
        rest = equilibrium(self.config, draw)  # pyright: ignore[reportArgumentType]  frozen models can be hashed
        simulation.qpos[world] = rest.qpos
        simulation.qvel[world] = 0.0
        simulation.act[world] = rest.act
        simulation.ctrl[world] = self.plan.q[0] - self._encoder_bias[world]
        simulation.bind("qacc_warmstart")[world] = rest.warmstart

    def _read(self, simulation: Simulation, worlds: BoolArray) -> None:
        """The true state of some worlds; the others keep their last one."""
        # take, not an index: the memory order of its result does not depend on the number of worlds
        position = simulation.qpos.take(self._positions, axis=1)
        wrench = -simulation.bind("sensordata")  # MuJoCo's act on the foot, ours on the leg
        foot_R = simulation.bind("site_xmat").take(self._sites, axis=1).reshape(-1, 2, 3, 3)
        ankles = simulation.bind("site_xpos").take(self._sites, axis=1)
        force, moment = self._foot_sensors.ground_wrench(wrench.reshape(-1, 2, 2, 3), foot_R)
        fresh = WalkState(
            position=position,
            velocity=simulation.qvel.take(self._velocities, axis=1),
            attitude=attitude_of(position[:, -4:]),
            ankles=ankles,
            wrench=wrench,
            force=force[..., 2],
            zmp=zero_moment_point(force, moment, ankles, self._least_force),
            servo_torque=simulation.bind("actuator_force").copy(),
        )  # fmt: skip
        self._state = fresh if worlds.all() else self._state.with_worlds(worlds, fresh)
        low = self._state.pelvis[:, 2] < FALL_HEIGHT_SHARE * self.config.gait.hip_height_m
        self._fallen = low | (self._state.attitude[:, 2] > FALL_TILT_RAD)

    def _measure(self, worlds: BoolArray) -> WalkMeasurement:
        """What the sensors say now; the other worlds keep their last values."""
        scenario, state, last = self.config.scenario, self._state, self._measured
        counts = self._true_model.encoder_counts_per_turn if scenario.encoder_counts else None
        noise = self._noise.next(worlds)
        body = noise * self._noise_spread
        body[:, ATTITUDE] = attitude(scenario.pelvis_imu, state.attitude[:, :2], self._imu_bias, noise[:, ATTITUDE])
        body[:, RATE] += state.rate
        body[:, WRENCH] += state.wrench
        if not self._imu_is_due_always:
            due = worlds & self._imu_is_due.take(self._now)
            body[:, : WRENCH.start] = np.where(due[:, None], body[:, : WRENCH.start], last.body[:, : WRENCH.start])
        encoder = quantise(state.theta + self._encoder_bias, counts)
        fresh = WalkMeasurement(encoder, last.encoder, body)
        return fresh if worlds.all() else last.with_worlds(worlds, fresh)

    def _watch_swing_foot(self) -> None:
        """Since when the swing foot has been on the ground in the second half of its swing."""
        half = self._half_of_swing.take(self._now)
        if not half.any():  # worlds that were started together all stand on two feet, most of the time
            return
        foot = self._swing_foot.take(self._now)
        loaded = self._state.force[self._each, foot] > UNLOADED_SHARE * self._weight
        first = (half == SECOND_HALF) & loaded & (self._contact_since < 0)
        since = np.where(first, self._step, self._contact_since)
        self._contact_since = np.where(half == FIRST_HALF, -1, since)

    def _earliness(self, sample: WalkSample) -> Array:
        """By how much the swing foot of the last swing touched down before its time [s]."""
        early = (sample.step - sample.contact_since) * self.config.control_period_s
        is_touchdown = self._phases[TOUCHDOWN, self._row(sample.step)]
        return np.where(is_touchdown & (sample.contact_since >= 0), early, 0.0)


def _reference_rows(plan: WalkPlan) -> Array:
    """What the observation shows of the plan, one row per control step."""
    timing = plan.timing
    clock = [timing.time, timing.swing, timing.support, plan.share]
    return np.column_stack([plan.q, plan.q_dot, plan.q_ddot, *clock, plan.zmp])


def _phase_rows(plan: WalkPlan) -> BoolArray:
    """The walk, its phases in the order of `PHASES`, and when a foot should touch down, by control step."""
    timing, touchdown = plan.timing, np.zeros_like(plan.timing.single)
    touchdown[1:] = timing.single[:-1] & ~timing.single[1:]
    return timing.walking & np.stack(
        [np.ones_like(touchdown), ~timing.single, timing.single, timing.transition, touchdown]
    )


def _halves_of_swing(plan: WalkPlan) -> IntArray:
    """Which half of a swing a control step is in, 0 for none."""
    timing = plan.timing
    return np.where(timing.single, np.where(timing.swing > 0.5, SECOND_HALF, FIRST_HALF), 0)


def _noise_spread(scenario: Scenario) -> Array:
    """Standard deviations of gyroscope and foot sensors, (17,); the attitude sensor scales its noise itself."""
    wrench = [scenario.force_noise_n] * 3 + [scenario.moment_noise_nm] * 3
    return np.array([0.0] * 2 + [scenario.gyro_noise_rad_s] * 3 + wrench * 2)


def _true_model(config: WalkConfig, plan: WalkPlan) -> WalkerModel:
    """The true joints and masses, and the torques that the planned motion needs of them."""
    true = biped(config.true_robot)  # pyright: ignore[reportArgumentType]  frozen models can be hashed
    plan = plan if config.true_robot == config.robot else with_torque(plan, true, config.control_period_s)
    return WalkerModel(config.true_joints, true.rigid, config.control_period_s, OBSERVATION, biped=true, plan=plan)


_DERIVED = ("sensordata", "site_xpos", "site_xmat", "actuator_force")
"""What is read of the physics beside its state."""
_NOISE_WIDTH = 2 + 3 + 12
TOUCHDOWN = -1
"""Row of the touch-downs among the phases."""
FIRST_HALF, SECOND_HALF = 1, 2
"""Of a swing."""
