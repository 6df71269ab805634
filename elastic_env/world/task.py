"""The control step of a robot of elastic joints, from the command to the observation.

    command → (physics) → truth → measured → score → observation

Kernels do the arithmetic, see `elastic_env.world.control_kernels`. The last control steps stand in
blocks of records, from which signals and metrics are made when they are needed.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded

from elastic_env.core.compiled import compile_now
from elastic_env.core.episode_random import EpisodeRandom
from elastic_env.core.errors import ActionError
from elastic_env.core.robot_ranges import DrawnRobot
from elastic_env.core.signals import Array, BoolArray, Signal, Signals, SignalTable
from elastic_env.joint.elasticity import joint_torque
from elastic_env.motion.trajectory import Motion, PlanTable
from elastic_env.world import control_kernels as kernels
from elastic_env.world import further_sensors as further
from elastic_env.world.further_sensors import FurtherSensors, SensorInputs
from elastic_env.world.joint_signals import (
    ACTION_BOUND_RAD,
    JOINT_COLUMNS,
    Mirrors,
    action_table,
)
from elastic_env.world.metrics import EpisodeMetrics, Metric
from elastic_env.world.physics import DIVERGED_RAD_S, Simulation, simulate, substeps
from elastic_env.world.robot_model import RobotModel
from elastic_env.world.rows import (
    JOINT,
    RULES,
    Records,
    Sample,
    addresses,
    columns_of,
)
from elastic_env.world.scenario import Scenario
from elastic_env.world.sensors import NoiseStream, angle_of_count
from elastic_env.world.step_info import StepInfo

DIVERGED = "diverged"
"""Reason of termination where the simulation produced a bad number; MuJoCo alone would restart
it silently.
"""

_SCORED_ROWS = 4096
_FEWEST_STEPS = 16
_MOST_STEPS = 256
"""Rows (steps of all worlds) whose signals are computed together, and how many steps that can
be.
"""


class Transition(NamedTuple):
    """Result of a control step, one row per world."""

    observation: Array
    reward: Array
    terminated: BoolArray
    truncated: BoolArray
    info: dict[str, Any]

    @property
    def done(self) -> BoolArray:
        """Worlds whose episode is over."""
        return self.terminated | self.truncated


class Task(ABC):
    """Rules of an environment.

    Args:
        config: With `control_period_s`, `timestep_s` and `sensors`.
        name: Of the robot.
        model: Its plant, what is drawn aside.
        assumed: What a compensator may know of it.
        motion: What the links are to do.
        table: What is observed, further sensors aside.
        sensors: Names of further sensors, whose columns stand behind the others.
        joints: In order, and what an angle of theirs is in the mirror.
        scenarios: Of every world.
        metrics: Figures of an episode.
        kinds: Of worlds: counts per turn of the encoders, None for none, and whether measurements
            are delayed.
        action_bound_rad: Largest command offset [rad].

    Attributes:
        failure_names: Reasons, beside `DIVERGED`, why an episode can be terminated.
        world_type: Structured type of what a control step keeps of a world: truth, shown, scores.
        noise_type: Structured type of a sample of noise.
        num_steps: Control steps of an episode that does not fail.
        fewest_control_steps: The same of the shortest one.
    """

    failure_names: tuple[str, ...] = ()
    world_type: np.dtype[Any]
    noise_type: np.dtype[Any]

    def __init__(
        self,
        *,
        config: Any,
        name: str,
        model: mujoco.MjModel,
        assumed: RobotModel,
        motion: Motion,
        table: Sequence[Signal],
        sensors: Sequence[str],
        joints: Mirrors,
        scenarios: Sequence[Scenario],
        metrics: Sequence[Metric],
        kinds: Sequence[tuple[int | None, bool]],
        action_bound_rad: float = ACTION_BOUND_RAD,
    ) -> None:
        num_worlds = len(scenarios)
        names = list(joints)
        counts = assumed.encoder_counts_per_turn
        reference = PlanTable(motion, config.control_period_s, num_worlds)
        self.config = config
        self.name = name
        self.model = model
        self.num_worlds = num_worlds
        self.num_steps = self.fewest_control_steps = reference.num_steps
        self.num_substeps = substeps(config.control_period_s, config.timestep_s)
        self._sensors = FurtherSensors(sensors, joints, scenarios, counts)
        self.observation_table = SignalTable((*table, *self._sensors.signals))
        self.action_table = action_table(names, action_bound_rad)
        self.assumed_model = assumed.observed_by(self.observation_table)
        self.metrics = metrics
        self._reference = reference
        self._has_sensors = bool(sensors)
        own_terms = type(self).further_reward_terms
        self._has_further_terms = own_terms is not Task.further_reward_terms
        self._width = len(self.observation_table)
        self._at = addresses(model, names)
        self._columns = columns_of(self.observation_table, JOINT_COLUMNS)
        self._rules = _joint_rules(config.control_period_s, kinds)
        self._kind = np.zeros(num_worlds, dtype=np.int64)
        self._scenarios = scenarios
        self._robots: dict[int, DrawnRobot] = {}
        self._noise = NoiseStream(num_worlds, self.noise_type)
        self._bound = self.action_table.space(np.float32).high.astype(np.float64)
        self._action_shape = (num_worlds, len(self._bound))
        self._failures = (DIVERGED, *self.failure_names)
        self._no_reason = np.full(num_worlds, "", dtype="<U1")
        self._no_reason.flags.writeable = False
        self._begun = np.zeros(num_worlds, dtype=np.bool_)
        self._is_begun = False
        self._constants = (
            *(self._at, self._columns, reference.motion, reference.plan_of_world),
            *(self._rules, self._kind, self._noise.samples, self._noise.used),
        )
        steps = _SCORED_ROWS // num_worlds
        self._steps_at_once = min(max(steps, _FEWEST_STEPS), _MOST_STEPS)
        worlds = np.zeros((2, num_worlds), self.world_type)
        self._begin_block(np.zeros((2, num_worlds, len(names)), JOINT), worlds)

    def attach(
        self, simulation: Simulation | None, num_threads: int, is_scalar: bool = False
    ) -> None:
        """Attach the physics, and compile all that a control step needs.

        Hardware cannot wait for the compiler later.

        Args:
            simulation: What moves instead of MuJoCo, such as hardware.
            num_threads: Threads of MuJoCo's physics, 0 for all cores; results do not depend on it.
            is_scalar: Whether errors speak of one world, whose action has no axis of worlds.
        """
        own = simulation or simulate(self.model, self.num_worlds, num_threads)
        self.simulation = own
        self._is_scalar = is_scalar
        self._metrics = EpisodeMetrics(self.metrics, self.num_worlds)
        # scoring many takes 2 ms, half a control period of hardware
        if simulation is not None:
            self._steps_at_once = _FEWEST_STEPS
        compile_now(self._rehearse)

    def restart(self, worlds: BoolArray, random: Sequence[EpisodeRandom]) -> None:
        """Begin new episodes in some worlds, a (num_worlds,) mask.

        The robots rest under zero offset, their springs deflected.

        Args:
            worlds: Which.
            random: Generators of every world.
        """
        simulation = self.simulation
        self.score()
        self._take_rows(2)
        simulation.restart(worlds)
        self._metrics.restart(worlds)
        last = self._row - 1
        now = self._row
        for block in (self._joints, self._worlds):  # what samples keep stays as it is
            block[last] = block[last - 2]
            block[now] = block[now - 2]
        self._unscored = self._row + 1
        for world in np.flatnonzero(worlds).tolist():
            self._draw(world, random[world])
        self._place(worlds)
        self._noise.make_ready()
        self._begin_worlds(worlds)
        for block in (self._joints, self._worlds):
            block[last][worlds] = block[now][worlds]
        if self._has_sensors:
            self._sensors.restart(worlds, random, self._sensor_inputs())
        self._begun = self._begun | worlds
        self._is_begun = bool(self._begun.all())

    def step(self, action: npt.ArrayLike) -> Transition:
        """One control period under the actions, (num_worlds, n) [rad].

        Raises:
            ActionError: Wrong shape, or a value that is not finite.
            ResetNeeded: A world has not begun an episode yet.
        """
        if not self._is_begun:
            missing = np.flatnonzero(~self._begun).tolist()
            some = f", of the worlds {missing} too" if self._begun.any() else ""
            raise ResetNeeded(f"reset() comes before the first step(){some}")
        offset, is_clipped = self._command(action)
        self._disturb()
        self.simulation.advance(self.num_substeps)
        self._take_rows(1)
        observation, reward, ends, is_over = self._sense(offset, is_clipped)
        rest = partial(self._describe, self.sample())
        info = StepInfo({"termination": self._no_reason}, rest)
        if is_over:
            info["termination"] = self._reasons(ends)
            self.score()
            info["episode_metrics"] = {
                **self._metrics.values(),
                **dict(zip(self._failures, ends, strict=False)),
            }
        return Transition(observation, reward, ends[-2], ends[-1], info)

    def observe(self) -> Array:
        """A fresh observation of the present state, (num_worlds, len(observation_table))."""
        observed = np.empty((self.num_worlds, self._width))
        kernels.show_joints(self._step, observed)
        self._show_worlds(observed)
        self._show_sensors(observed)
        return observed

    def sample(self) -> Sample:
        """The present control step."""
        return Sample(self._joints[self._row], self._worlds[self._row])

    def signals(self, sample: Sample | None = None) -> Signals:
        """Truth and scores by name, one value per row; by default of the present step."""
        sample = self.sample() if sample is None else sample
        return self._signals(sample.joints["truth"], sample.worlds)

    def score(self) -> None:
        """Take into the metrics the steps that are not yet.

        The time of the call makes no difference to them.
        """
        rows = slice(self._unscored, self._row + 1)
        shape = (rows.stop - rows.start, self.num_worlds)
        self._unscored = rows.stop
        if shape[0] <= 0:
            return
        joints = self._joints[rows].reshape(-1, len(self._at))
        sample = Sample(joints, self._worlds[rows].reshape(-1))
        truth = sample.worlds["truth"]
        masks = self.masks(sample)
        if truth["diverged"].any():
            masks = {name: mask & ~truth["diverged"] for name, mask in masks.items()}
        masks["all"] = np.ones(shape, dtype=np.bool_)
        clipped = truth["clipped"].astype(np.float64)
        signals = {**self.signals(sample), "clipped": clipped}
        self._metrics.update(
            {name: signal.reshape(shape) for name, signal in signals.items()},
            {name: mask.reshape(shape) for name, mask in masks.items()},
        )

    def reward_terms(self, sample: Sample) -> dict[str, Array]:
        """Weighted terms whose sum is the reward, one value per row."""
        scores = sample.worlds["scores"]
        terms = {name: scores[name].copy() for name in scores.dtype.names or ()}
        return terms | self.further_reward_terms(sample)

    def further_reward_terms(self, sample: Sample) -> dict[str, Array]:  # noqa: ARG002
        """Terms that a task of one's own adds to the reward, one value per row."""
        return {}

    @abstractmethod
    def masks(self, sample: Sample) -> dict[str, BoolArray]:
        """Rows that count in the metrics, "scored", and the parts of them that the metrics name."""

    def robot_record(self, world: int) -> dict[str, float]:
        """The robot of a world in figures, where robots differ; else nothing."""
        is_one = self._scenarios[world].has_one_robot
        return {} if is_one else self._robots[world].record()

    @abstractmethod
    def truth(self) -> Any:
        """Noise-free state and true parameters, for rewards, metrics and the oracle."""

    # what differs from robot to robot

    @abstractmethod
    def _draw(self, world: int, random: EpisodeRandom) -> None:
        """Draw robot, sensors and noise of a new episode, see `_take_robot`."""

    @abstractmethod
    def _place(self, worlds: BoolArray) -> None:
        """Set the physics of some worlds to rest under zero offset."""

    @abstractmethod
    def _begin_worlds(self, worlds: BoolArray) -> None:
        """Truth and measurements at the start of an episode in some worlds."""

    @abstractmethod
    def _sense_worlds(self, control: tuple[Any, ...]) -> bool:
        """Sense, score, end and observe a control step, `kernels.Control`; True if one ends."""

    @abstractmethod
    def _show_worlds(self, observed: Array) -> None:
        """Fill the columns of the present state that are not of the joints."""

    @abstractmethod
    def _signals(self, joints: Records, worlds: Records) -> Signals:
        """As `signals`, from the truth of the joints, (rows, n), and records of worlds, (rows,)."""

    def _take_robot(self, world: int, robot: DrawnRobot) -> None:
        """Keep the robot of a world, and write what is true of its joints."""
        self._robots[world] = robot
        truth = self._joints[self._row, world]["truth"]
        truth["homing"] = robot.homing_rad
        assumed = self.assumed_model
        truth["stiffness"] = assumed.stiffness * np.array(robot.stiffness)
        truth["damping"] = assumed.damping * robot.damping
        truth["backlash"] = assumed.backlash + robot.backlash_rad

    def _disturb(self) -> None:  # noqa: B027  most robots are not pushed
        """Apply what acts on the robot from outside during the coming control period."""

    _periods = 1.0
    """Control periods that the last step took."""

    @property
    def _step(self) -> tuple[Any, ...]:
        """The present step, as `kernels.step_of` takes it."""
        return (self._joints, self._worlds, self._row, *self._constants)

    def _command(self, action: npt.ArrayLike) -> tuple[Array, BoolArray]:
        """Command offsets within their bounds; where an action was beyond them, (num_worlds,)."""
        given = np.asarray(action)
        if given.dtype.kind not in "fiub" or given.shape != self._action_shape:
            raise self._refused(given)
        offset = given.astype(np.float64, order="C")
        is_clipped = np.empty(self.num_worlds, dtype=np.bool_)
        inputs = self.simulation.ctrl
        arrays = (offset, self._bound, is_clipped, inputs)
        if not kernels.command(self._step, *arrays, *kernels.EVERY_WORLD):
            raise self._refused(given.astype(np.float64))
        return offset, is_clipped

    def _sense(self, offset: Array, is_clipped: BoolArray) -> tuple[Array, Array, BoolArray, bool]:
        """Observation, reward and ends of the last control step; True if an episode ends."""
        n = self.num_worlds
        observed = np.empty((n, self._width))
        reward = np.empty(n)
        ends = np.empty((len(self._failures) + 2, n), dtype=np.bool_)
        diverged = self.simulation.divergence()
        self._noise.make_ready()
        command = (offset, is_clipped, diverged, self._periods)
        is_over = self._sense_worlds((*command, observed, reward, ends))
        if self._has_sensors:
            self._sensors.measure(~diverged, self._sensor_inputs())
            self._show_sensors(observed)
        if self._has_further_terms:
            for term in self.further_reward_terms(self.sample()).values():
                reward += term
        return observed, reward, ends, is_over

    def _show_sensors(self, observed: Array) -> None:
        """Fill the columns of further sensors."""
        if self._has_sensors:
            is_delayed = self._rules["is_delayed"][self._kind]
            first = self._width - len(self._sensors.signals)
            observed[:, first:] = self._sensors.columns(is_delayed)

    def _sensor_inputs(self) -> SensorInputs:
        """The truth that further sensors need; the specific force lags one physics step behind."""
        truth = self._joints[self._row]["truth"]
        force = np.full((self.num_worlds, 3), np.nan)
        if further.ACCELEROMETER in self.config.sensors:
            begin = int(self.model.sensor(further.ACCELEROMETER).adr[0])
            force = self.simulation.bind("sensordata")[:, begin : begin + 3].copy()
        return SensorInputs(truth["q"].copy(), spring_torque(truth), force)

    def _describe(self, sample: Sample) -> dict[str, Any]:
        """Reward terms, signals and clipping of a step, computed when somebody looks at them."""
        clipped = sample.worlds["truth"]["clipped"].astype(np.float64)
        terms = self.reward_terms(sample)
        return {"reward_terms": terms, **self.signals(sample), "clipped": clipped}

    def _take_rows(self, count: int) -> None:
        """Go on to fresh records, in a fresh block where this one is full.

        Samples may keep the old one.
        """
        if self._row + count >= len(self._joints):
            self.score()
            present = slice(self._row - 1, self._row + 1)
            self._begin_block(self._joints[present], self._worlds[present])
        self._row += count

    def _begin_block(self, joints: Records, worlds: Records) -> None:
        """Records for the next steps, behind those of the step before and of the present one."""
        steps = self._steps_at_once + 2
        self._joints = np.zeros((steps, *joints.shape[1:]), JOINT)
        self._worlds = np.zeros((steps, self.num_worlds), self.world_type)
        self._joints[:2] = joints
        self._worlds[:2] = worlds
        self._row = 1
        self._unscored = 2

    def _rehearse(self) -> None:
        """Compile all kernels by a control step of records that nobody sees."""
        every = np.ones(self.num_worlds, dtype=np.bool_)
        nothing = np.zeros((self.num_worlds, len(self._bound)))
        offset, is_clipped = self._command(nothing)
        self.simulation.ctrl[:] = 0.0
        self._noise.make_ready()
        self._begin_worlds(every)
        self._take_rows(1)
        self._sense(offset, is_clipped)
        self.observe()
        self.score()
        self._metrics.restart(every)
        joints = np.zeros_like(self._joints[:2])
        self._begin_block(joints, np.zeros_like(self._worlds[:2]))

    def _reasons(self, ends: BoolArray) -> npt.NDArray[np.str_]:
        """Reason of termination of every world, the first that applies, "" where there is none."""
        longest = max(map(len, self._failures))
        reasons = np.full(self.num_worlds, "", dtype=f"<U{longest}")
        for reason, failed in reversed([*zip(self._failures, ends, strict=False)]):
            reasons[failed] = reason
        return reasons

    def _refused(self, given: npt.NDArray[Any]) -> ActionError:
        """The error that says what is wrong with an action."""
        shape = self._action_shape
        bounds = f"within ±{self._bound.max():g} rad"
        if given.dtype.kind not in "fiub":
            problem = f"be real numbers, {bounds}, got an array of {given.dtype}"
        elif given.shape != shape:
            # a scalar environment adds the axis of worlds itself
            first = int(self._is_scalar)
            got = f"got shape {given.shape[first:]}"
            problem = f"have shape {shape[first:]} [rad], {bounds}; {got}"
        else:
            world = np.flatnonzero(~np.isfinite(given).all(axis=1))[0]
            got = f"got {given[world]} in world {world}"
            problem = f"be finite, {bounds}, shape {shape[1:]} a world; {got}"
        return ActionError(f"an action must {problem}")


def _joint_rules(period_s: float, kinds: Sequence[tuple[int | None, bool]]) -> Records:
    """Records of `RULES`, one for every kind of world."""
    rules = np.zeros(len(kinds), RULES)
    rules["control_period_s"] = period_s
    rules["count_rad"] = [angle_of_count(counts) for counts, _ in kinds]
    rules["is_delayed"] = [is_delayed for _, is_delayed in kinds]
    rules["highest_rad_s"] = DIVERGED_RAD_S
    return rules


def spring_torque(truth: Records) -> Array:
    """Torque of spring and damper on the links, from the truth of joints, (rows, n) [N·m]."""
    deflection = truth["theta"] - truth["q"]
    rate = truth["theta_dot"] - truth["q_dot"]
    spring = (truth["stiffness"], truth["damping"], truth["backlash"])
    return joint_torque(deflection, rate, *spring)
