"""The walking task: a humanoid on elastic legs walks in place, its pelvis level, its ZMP where the plan has it.

Observation of one world (float64); joints are l_hip_yaw, l_hip_roll, l_hip_pitch, l_knee, l_ankle_pitch, l_ankle_roll,
then the same of the right leg (r_...); a name before a dot has one column per joint or component after it:

| columns | names | unit | meaning |
|---|---|---|---|
| 0 to 11 | `encoder_angle.<joint>` | rad | motor encoder, θ in whole counts |
| 12 to 23 | `encoder_rate.<joint>` | rad/s | its change over the last control period |
| 24, 25 | `imu_attitude.roll`, `.pitch` | rad | IMU in the pelvis; in the scenario `imu` by its own filter |
| 26 to 28 | `imu_rate.x`, `.y`, `.z` | rad/s | its gyroscope, in the frame of the pelvis; in `imu` a period's mean |
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
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from elastic_env.core.compiled import compile_now
from elastic_env.core.draws import Draws
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.robot_ranges import RobotDraw
from elastic_env.core.signals import Array, BoolArray, IntArray, Signals, SignalTable
from elastic_env.dynamics import walk_kernels as kernels
from elastic_env.dynamics.ground_contact import FootSensors
from elastic_env.joint.elasticity import joint_torque
from elastic_env.joint.joint_names import JointAddresses
from elastic_env.motion.gait import LEFT, RIGHT
from elastic_env.motion.walk_plan import WalkPlan, plan_walk, require_feasible, with_torque
from elastic_env.robots.thormang import NAME
from elastic_env.robots.thormang.config import (
    FALL_HEIGHT_SHARE,
    FALL_TILT_RAD,
    PlacedRobot,
    WalkConfig,
    placed_robot,
    require_stable_walker,
    robot_bank,
)
from elastic_env.robots.thormang.model import LEG_JOINTS, SIDES, biped
from elastic_env.robots.thormang.rows import (
    ADDRESSES,
    BIAS,
    CONSTANTS,
    INERTIAL,
    NOISE,
    OBSERVED,
    QUALITY,
    ROW_OF_PLAN,
    RULES,
    SCORES,
    STEP,
    Records,
    WalkSample,
    WalkTruth,
    one,
)
from elastic_env.robots.thormang.tables import ACTION, FELL, GROUPS, JOINTS, METRICS, OBSERVATION, PHASES
from elastic_env.runtime.further_sensors import ACCELEROMETER, Felt, FurtherSensors, specific_force
from elastic_env.runtime.metrics import Metric
from elastic_env.runtime.physics import DIVERGED_RAD_S, Simulation, substeps
from elastic_env.runtime.robot_model import RobotModel, WalkerModel
from elastic_env.runtime.scenario import Scenario
from elastic_env.runtime.sensors import InertialSensor, NoiseStream, angle_of_count, is_due
from elastic_env.runtime.task import Outcome

FELL_ROW, NUM_ENDS = 1, 4
"""Of what ends an episode, beside `elastic_env.runtime.task.DIVERGED_ROW` and those after it."""
_ROWS_AT_ONCE = 64
UNLOADED_SHARE = 0.05
"""Share of the weight below which a foot, or the sensors of both together, count as unloaded."""


@dataclass(frozen=True, eq=False)
class _Kind:
    """The robots of one scenario.

    Attributes:
        config: Of their worlds, which have no other scenario.
        bank: What they are drawn from.
        model: Their plant, what is drawn aside.
        true_model: Their true joints and masses.
    """

    config: WalkConfig
    bank: Sequence[RobotDraw]
    model: mujoco.MjModel
    true_model: WalkerModel

    @staticmethod
    def of(config: WalkConfig, plan: WalkPlan, table: SignalTable) -> "_Kind":
        """Those of a configuration, a planned motion, and what is observed."""
        require_stable_walker(config)  # pyright: ignore[reportArgumentType]  frozen models can be hashed
        bank = robot_bank(config.scenario, config.bank)
        return _Kind(config, bank, config.true_model(), _true_model(config, plan, table))

    @property
    def fits(self) -> list[tuple[bool, bool]]:
        """Whether measurements are delayed, and whether the IMU is inertial, as far as robots of the bank have it."""
        return list(dict.fromkeys((robot.is_delayed, robot.is_inertial) for robot in self.bank))


class WalkTask:
    """Rules of `elastic_env/WalkInPlace-v0`, see `elastic_env.runtime.task.Task`."""

    name = NAME
    action_table = ACTION
    assumed_model: RobotModel
    metrics: Sequence[Metric] = METRICS
    failure_names: tuple[str, ...] = (FELL,)

    def __init__(self, config: WalkConfig, num_worlds: int) -> None:
        self.config = config
        self.num_worlds = num_worlds
        self.num_substeps = substeps(config.control_period_s, config.timestep_s)
        counts = next(iter(config.true_joints.values())).encoder_counts_per_turn
        scenarios = config.scenarios or (config.scenario,) * num_worlds
        if len(scenarios) != num_worlds:
            raise ConfigurationError(
                f"scenario must be a name, or a list with one for each world, {num_worlds}, got {len(scenarios)}"
            )
        self._sensors = FurtherSensors(config.sensors, JOINTS, scenarios, counts)
        table = self.observation_table = OBSERVATION.extended(self._sensors.signals)
        robot = biped(config.robot)  # pyright: ignore[reportArgumentType]  frozen models can be hashed
        self.plan = plan_walk(config.gait, robot, config.control_period_s)  # pyright: ignore[reportArgumentType]
        model = self.assumed_model = WalkerModel(
            config.assumed_joints, robot.rigid, config.control_period_s, table, biped=robot, plan=self.plan
        )
        require_feasible(self.plan, robot, model.servos)
        self._kinds = [_Kind.of(own, self.plan, table) for own in config.of_each_scenario()]
        number = {kind.config.scenario: index for index, kind in enumerate(self._kinds)}
        self._kind_of_world = [self._kinds[number[scenario]] for scenario in scenarios]
        self.model = self._kinds[0].model
        self._torso = self.model.body("upper_body").id
        n, m = num_worlds, len(LEG_JOINTS)
        self.num_steps = self.plan.num_steps
        """Control steps of an episode."""
        self._phases, self._bias = _phase_rows(self.plan), np.zeros(n, BIAS)
        self._fits = [(kind, *fit) for kind in self._kinds for fit in kind.fits]
        self._constants = np.concatenate([
            _constants(kind, is_delayed, is_inertial) for kind, is_delayed, is_inertial in self._fits
        ])  # fmt: skip
        self._inertial = _inertial(self._fits, robot.gravity)
        self._plan_rows = _plan_rows(self.plan, config)
        self._draw = np.zeros(n, dtype=np.int64)
        self._pushes = any(robot.push_n > 0.0 for kind in self._kinds for robot in kind.bank)
        self._push_steps = np.array([
            round(kind.config.scenario.push_s / config.control_period_s) for kind in self._kind_of_world
        ])  # fmt: skip
        self._push_force, self._push_begin = np.zeros((n, 3)), np.full(n, -1, dtype=np.int64)
        self._noise = NoiseStream(n, NOISE)
        self._rows = self._rows_before = np.zeros(n, STEP)
        self._rows_ahead, self._rows_left = np.zeros((0, n), STEP), 0
        self._offset, self._has_fallen = np.zeros((n, m)), np.zeros(n, dtype=np.bool_)
        self._phases.flags.writeable = False
        self._is_compiled = False

    def restart(self, simulation: Simulation, worlds: BoolArray, draws: Sequence[Draws]) -> None:
        """Place robots in static equilibrium under zero offset."""
        simulation.views(kernels.Physics._fields)
        simulation.bind("xfrc_applied")[worlds] = 0.0
        # the samples of the steps before keep theirs
        rows = self._rows.copy()
        rows["scores"][worlds] = np.zeros((), SCORES)
        truth = rows["truth"]
        truth["step"][worlds], truth["contact_since"][worlds] = 0, -1
        truth["offset"][worlds], truth["command_rate"][worlds] = 0.0, 0.0
        truth["command"][worlds] = self.plan.q[0]
        for world in np.flatnonzero(worlds).tolist():
            generator, kind = draws[world].robot, self._kind_of_world[world]
            self._draw[world] = generator.integers(len(kind.bank))
            mounting = kind.config.scenario.pelvis_imu.bias_spread_rad * generator.uniform(-1.0, 1.0, 2)
            self._bias["imu_attitude"][world] = mounting + np.array(self._robot(world).imu_bias_rad)
            self._draw_push(world, draws[world])
            self._noise.restart(world, draws[world].noise())
            self._place(simulation, world, truth)
            self._draw_imu(world, generator)
        simulation.refresh(worlds)
        if not self._is_compiled:
            compile_now(self._rehearse, simulation)
            self._is_compiled = True
        kernels.begin(self._physics(simulation), self._walker, self._noise.ready(), worlds, rows)
        self._rows, self._has_fallen = rows, self._has_fallen & ~worlds
        self._rows_before = np.where(worlds, rows, self._rows_before)
        if self._sensors:
            self._sensors.restart(worlds, draws, self._felt(simulation))

    def _rehearse(self, simulation: Simulation) -> None:
        """Call all kernels on rows of their own."""
        n, rows, samples = self.num_worlds, np.zeros((2, self.num_worlds), STEP), np.zeros((1, self.num_worlds), NOISE)
        noise, physics = (samples, np.zeros(n, dtype=np.int64)), self._physics(simulation)
        commanded = self._offset, np.zeros(n, dtype=np.bool_)
        outcome = _observed(n)[1], np.empty(n), np.empty((NUM_ENDS, n), dtype=np.bool_)
        kernels.begin(physics, self._walker, noise, ~commanded[1], rows[0])
        kernels.command(rows[0], self._offset, self._walker, np.zeros_like(simulation.ctrl))
        kernels.control_step(physics, self._walker, noise, commanded, rows[0], rows[1], outcome)
        kernels.show(rows[0], rows[1], self._walker, outcome[0])
        self.signals(WalkSample(rows[0]))

    def command(self, offset: Array, inputs: Array) -> None:
        """θ_cmd = q_ref + offset, as the servos get it: they know their angles only up to the homing error."""
        self._offset = offset
        kernels.command(self._rows, offset, self._walker, inputs)

    def disturb(self, simulation: Simulation) -> None:
        """Push the torso where and when the scenario says."""
        if self._pushes:
            since = self._rows["truth"]["step"] - self._push_begin
            active = (since >= 0) & (since < self._push_steps)
            simulation.bind("xfrc_applied")[:, self._torso, :3] = np.where(active[:, None], self._push_force, 0.0)

    def sense(self, simulation: Simulation, diverged: BoolArray) -> Outcome:
        """Read the new state, then what the sensors show of it; score it."""
        n, last, rows = self.num_worlds, self._rows, self._next_rows()
        columns, observed = _observed(n)
        reward, ends = np.empty(n), np.empty((NUM_ENDS, n), dtype=np.bool_)
        is_over = kernels.control_step(
            self._physics(simulation), self._walker, self._noise.ready(), (self._offset, diverged), last, rows,
            (observed, reward, ends),
        )  # fmt: skip
        self._rows, self._rows_before = rows, last
        self._has_fallen = ends[FELL_ROW]
        if self._sensors:
            self._sensors.measure(~diverged, self._felt(simulation))
        return Outcome(self._observation(columns), WalkSample(rows), reward, ends, is_over)

    def _next_rows(self) -> Records:
        """Rows for a control step, of which samples may keep them: several are made at once, which costs less."""
        if self._rows_left == 0:
            self._rows_ahead = np.zeros((max(_ROWS_AT_ONCE // self.num_worlds, 1), self.num_worlds), STEP)
            self._rows_left = len(self._rows_ahead)
        self._rows_left -= 1
        return self._rows_ahead[self._rows_left]

    def observe(self) -> Array:
        """See the table of the module."""
        columns, observed = _observed(self.num_worlds)
        kernels.show(self._rows, self._rows_before, self._walker, observed)
        return self._observation(columns)

    def _observation(self, columns: Array) -> Array:
        """The standard columns of an observation and what further sensors show."""
        if not self._sensors:
            return columns
        is_delayed = self._constants["rules"]["is_delayed"][self._bias["fit"]]
        return np.hstack([columns, self._sensors.columns(is_delayed)])

    def _felt(self, simulation: Simulation) -> Felt:
        """What further sensors feel; the specific force lags one physics step behind."""
        truth = self._rows["truth"]
        deflection, rate = truth["theta"] - truth["q"], truth["theta_dot"] - truth["q_dot"]
        torque = joint_torque(deflection, rate, truth["stiffness"], truth["damping"], truth["backlash"])
        has_force = ACCELEROMETER in self.config.sensors
        force = specific_force(self.model, simulation.bind("sensordata")) if has_force else np.zeros((len(truth), 3))
        return Felt(truth["q"].copy(), torque, force)

    def sample(self) -> WalkSample:
        """What this step is scored by."""
        return WalkSample(self._rows)

    def signals(self, sample: WalkSample) -> Signals:
        """Truth and scores of samples, one value per row."""
        truth, row, plan, timing = sample.rows["truth"], self._row(sample), self.plan, self.plan.timing
        error, deflection = plan.q[row] - truth["q"], truth["theta"] - truth["q"]
        deflection_rate = truth["theta_dot"] - truth["q_dot"]
        torque = joint_torque(deflection, deflection_rate, truth["stiffness"], truth["damping"], truth["backlash"])
        zmp_ref = plan.zmp[row]
        deviation = truth["zmp"] - zmp_ref
        return {
            "time_s": truth["step"] * self.config.control_period_s,
            "pelvis_roll": truth["roll"].copy(),
            "pelvis_pitch": truth["pitch"].copy(),
            "pelvis_error": truth["tilt"].copy(),
            "pelvis_height": truth["pelvis"][:, 2].copy(),
            "zmp_x": truth["zmp"][:, 0].copy(),
            "zmp_y": truth["zmp"][:, 1].copy(),
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
            "servo_torque": rms(truth["servo_torque"]),
            "command_rate": truth["command_rate"].copy(),
            "force_left": truth["force"][:, LEFT].copy(),
            "force_right": truth["force"][:, RIGHT].copy(),
            "load_share": plan.share[row],
            "swing": timing.swing[row],
            "single_support": timing.single[row],
            "support": timing.support[row],
            "early_touchdown": self._earliness(truth, row),
        }

    def reward_terms(self, sample: WalkSample) -> dict[str, Array]:
        """Weighted penalties for tilt, ZMP deviation, effort, restless commands and a fall."""
        return {name: sample.rows["scores"][name].copy() for name in SCORES.names or ()}

    def masks(self, sample: WalkSample) -> dict[str, BoolArray]:
        """The walk (standing before and after it does not count), its phases, and where there is a ZMP."""
        loaded = ~np.isnan(sample.rows["truth"]["zmp"][:, 0])
        phases = self._phases[:, self._row(sample)]
        names = [f"{name}_loaded" for name in PHASES]
        return {
            **dict(zip(["scored", *PHASES, "touchdown"], phases, strict=True)),
            **dict(zip(["loaded", *names], phases[:-1] & loaded, strict=True)),
            "unloaded": phases[0] & ~loaded,
        }

    def has_fallen(self) -> BoolArray:
        """Worlds whose pelvis is too low or too much tilted, (num_worlds,)."""
        return self._has_fallen

    def truth(self) -> WalkTruth:
        """State without noise, and the true parameters."""
        s = self._rows["truth"]
        names = "theta", "theta_dot", "q", "q_dot", "pelvis", "ankles", "stiffness"
        copies = {name: s[name].copy() for name in names}
        models = tuple(kind.true_model for kind in self._kinds)
        return WalkTruth(**copies, pelvis_R=rotation_of(s["quaternion"]), models=models)

    def robot_record(self, world: int) -> dict[str, float]:
        """The robot of a world in figures, where it was drawn from ranges; else nothing."""
        return self._robot(world).record() if self._kind_of_world[world].config.scenario.ranges else {}

    def _row(self, sample: WalkSample) -> IntArray:
        """Rows of the plan's tables."""
        return np.minimum(sample.rows["truth"]["step"], self.num_steps)

    def _physics(self, simulation: Simulation) -> tuple[Any, ...]:
        """`kernels.Physics`."""
        return simulation.views(kernels.Physics._fields)

    @property
    def _walker(self) -> tuple[Any, ...]:
        """`kernels.Walker`."""
        return self._constants, self._plan_rows, self._bias, self._inertial

    def _draw_push(self, world: int, draws: Draws) -> None:
        """Time and direction of the push, in the walk."""
        walking = np.flatnonzero(self.plan.timing.walking)
        begin = draws.of_trial(lambda generator: generator.integers(walking[0], walking[-1] + 1))
        direction = draws.of_trial(lambda generator: generator.uniform(0.0, 2.0 * np.pi))
        self._push_begin[world] = begin
        self._push_force[world] = self._robot(world).push_n * np.array([np.cos(direction), np.sin(direction), 0.0])

    def _draw_imu(self, world: int, generator: np.random.Generator) -> None:
        """Errors of an inertial IMU, where one is fitted."""
        scenario, bias = self._kind_of_world[world].config.scenario, self._bias
        sensor = _fitted(scenario, self._robot(world).is_inertial).inertial
        bias["gyro"][world] = bias["specific_force"][world] = 0.0
        if sensor is not None:
            bias["imu_attitude"][world] += sensor.offset_rad * generator.standard_normal(2)
            bias["gyro"][world] = sensor.gyro_bias_rad_s * generator.standard_normal(3)
            bias["specific_force"][world] = sensor.accelerometer_bias_m_s2 * generator.standard_normal(3)

    def _robot(self, world: int) -> RobotDraw:
        """The robot of a world."""
        return self._kind_of_world[world].bank[self._draw[world]]

    def _placed(self, world: int) -> PlacedRobot:
        """The robot of a world, at rest."""
        config = self._kind_of_world[world].config
        return placed_robot(config, self._robot(world))  # pyright: ignore[reportArgumentType]  frozen models can be hashed

    def _place(self, simulation: Simulation, world: int, truth: Records) -> None:
        """Give a world its robot, at rest, and its truth the robot's joints."""
        robot, kind, bias = self._robot(world), self._kind_of_world[world], self._bias
        model, placed = kind.true_model, self._placed(world)
        bias["encoder"][world] = robot.encoder_bias_rad
        bias["fit"][world] = self._fits.index((kind, robot.is_delayed, robot.is_inertial))
        simulation.take(world, placed.model)
        simulation.qpos[world] = placed.rest.qpos
        simulation.qvel[world] = 0.0
        simulation.act[world] = placed.rest.act
        simulation.ctrl[world] = self.plan.q[0] - bias["encoder"][world]
        simulation.bind("qacc_warmstart")[world] = placed.rest.warmstart
        truth["stiffness"][world] = model.stiffness * np.array(robot.stiffness_factor)
        truth["damping"][world] = model.damping * robot.damping_factor
        truth["backlash"][world] = model.backlash + robot.backlash_rad

    def _earliness(self, truth: Records, row: IntArray) -> Array:
        """By how much the swing foot of the last swing touched down before its time [s]."""
        early = (truth["step"] - truth["contact_since"]) * self.config.control_period_s
        return np.where(self._phases[TOUCHDOWN, row] & (truth["contact_since"] >= 0), early, 0.0)


def _plan_rows(plan: WalkPlan, config: WalkConfig) -> Records:
    """What a control step needs of the plan, one row per step."""
    timing, steps = plan.timing, np.arange(plan.num_steps + 1)
    rows = np.zeros(len(steps), ROW_OF_PLAN)
    rows["q"], rows["q_dot"], rows["q_ddot"] = plan.q, plan.q_dot, plan.q_ddot
    rows["clock"] = np.column_stack([timing.time, timing.swing, timing.support])
    rows["share"], rows["zmp"] = plan.share, plan.zmp
    rows["half_of_swing"], rows["swing_foot"] = _halves_of_swing(plan), RIGHT - timing.support
    rows["imu_is_due"] = is_due(steps, config.scenario.pelvis_imu.rate_hz, config.control_period_s)
    rows["weight"] = np.where(timing.walking, 1.0, config.reward.standing)
    rows.flags.writeable = False
    return rows


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
    return np.where(timing.single, np.where(timing.swing > 0.5, kernels.SECOND_HALF, kernels.FIRST_HALF), 0)


def _observed(n: int) -> tuple[Array, Records]:
    """Columns of an observation to be filled, (n, columns), and the same memory as rows of `OBSERVED`, (n,)."""
    columns = np.empty((n, len(OBSERVATION)))
    return columns, np.ndarray(n, OBSERVED, columns)


def _constants(kind: _Kind, is_delayed: bool, is_inertial: bool) -> Records:
    """What does not change of a robot, one row of `CONSTANTS`.

    Args:
        kind: Robots of its scenario.
        is_delayed: Whether its measurements are shown a step late.
        is_inertial: Whether its IMU computes its attitude.
    """
    config, model = kind.config, kind.model
    feet = [model.body(f"{side}_foot").id for side in SIDES]
    sensors = FootSensors(model.body_mass[feet], model.body_ipos[feet], model.opt.gravity.copy())
    joints, gravity = JointAddresses.of(model, LEG_JOINTS), biped(config.robot).gravity  # pyright: ignore[reportArgumentType]  frozen models can be hashed
    at = one(
        ADDRESSES, theta=joints.theta, q=joints.q, theta_dot=joints.theta_dot, q_dot=joints.q_dot,
        ankles=np.array([model.site(f"{side}_ft").id for side in SIDES]),
    )  # fmt: skip
    loaded_n = UNLOADED_SHARE * float(model.body_mass.sum()) * gravity
    # sensors that carry nothing stand for a ground that carries the feet
    zmp_n = loaded_n + float(model.body_mass[feet].sum()) * gravity
    return one(
        CONSTANTS, at=at, foot_com=sensors.com, foot_weight=sensors.weight,
        quality=_quality(_fitted(config.scenario, is_inertial), kind.true_model.encoder_counts_per_turn),
        rules=_rules(config, is_delayed, loaded_n, zmp_n),
    )  # fmt: skip


def _rules(config: WalkConfig, is_delayed: bool, loaded_n: float, zmp_n: float) -> Records:
    """Numbers that judge a control step, one row of `RULES`."""
    weights = one(SCORES, **{name: getattr(config.reward, name) for name in SCORES.names or ()})
    return one(
        RULES, control_period_s=config.control_period_s, is_delayed=is_delayed,
        loaded_n=loaded_n, zmp_n=zmp_n, weights=weights,
        lowest_pelvis_m=FALL_HEIGHT_SHARE * config.gait.hip_height_m, highest_tilt_rad=FALL_TILT_RAD,
        highest_rad_s=DIVERGED_RAD_S,
    )  # fmt: skip


def _fitted(scenario: Scenario, is_inertial: bool) -> Scenario:
    """The scenario of a robot with an inertial IMU, its own or where robots are drawn that of the data sheet."""
    if not is_inertial:
        return scenario
    return scenario.replace(ranges=(), inertial=scenario.inertial or InertialSensor())


def _inertial(fits: Sequence[tuple[_Kind, bool, bool]], gravity_m_s2: float) -> Records | None:
    """The inertial IMUs of robots as `WalkTask` lists them, rows of `INERTIAL`; None where no robot has one."""
    if not any(is_inertial for _, _, is_inertial in fits):
        return None
    sensors = [kind.config.scenario.inertial or InertialSensor() for kind, _, _ in fits]
    return np.concatenate([
        one(INERTIAL, is_fitted=fit[2], time_constant_s=sensor.time_constant_s, gravity_m_s2=gravity_m_s2)
        for fit, sensor in zip(fits, sensors, strict=True)
    ])  # fmt: skip


def _quality(scenario: Scenario, counts_per_turn: int | None) -> Records:
    """Quality of the sensors in a scenario, one row of `QUALITY`."""
    imu, noise = scenario.pelvis_imu, np.zeros(1, NOISE)
    for group in GROUPS:
        if group.noise is not None:
            noise[group.name] = group.noise(scenario)
    return one(
        QUALITY, count_rad=angle_of_count(counts_per_turn if scenario.encoder_counts else None), noise=noise,
        imu_bias_rad=imu.bias_rad, imu_sine_error_rad=imu.sine_error_rad,
    )  # fmt: skip


def _true_model(config: WalkConfig, plan: WalkPlan, table: SignalTable) -> WalkerModel:
    """The true joints and masses, and the torques that the planned motion needs of them."""
    true = biped(config.true_robot)  # pyright: ignore[reportArgumentType]  frozen models can be hashed
    plan = plan if config.true_robot == config.robot else with_torque(plan, true, config.control_period_s)
    return WalkerModel(config.true_joints, true.rigid, config.control_period_s, table, biped=true, plan=plan)


TOUCHDOWN = -1
"""Row of the touch-downs among the phases."""


def highest(values: Array) -> Array:
    """Maximum over the last axis of (n, m); NumPy is several times as fast over a first axis."""
    return values.T.copy().max(axis=0)


def rms(values: Array) -> Array:
    """Root of the mean square over the last axis of (n, m)."""
    return kernels.rms_of_rows(np.array(values, order="C"))  # of one kind, for which it is compiled


def rotation_of(quaternion: Array) -> Array:
    """Rotation of unit quaternions w, x, y, z, (n, 4) to (n, 3, 3)."""
    w, x, y, z = quaternion.T
    R = np.empty((len(quaternion), 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[:, 1, 0], R[:, 1, 1], R[:, 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[:, 2, 0], R[:, 2, 1], R[:, 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return R
