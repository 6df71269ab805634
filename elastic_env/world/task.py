"""A task: the control step with its robots, its episodes and their scores."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from elastic_env.core.compiled import compile_now
from elastic_env.core.episode_random import EpisodeRandom
from elastic_env.core.signals import Array, BoolArray, Signal, Signals, SignalTable
from elastic_env.motion.trajectory import Motion, PlanTable
from elastic_env.world import joint_signals, records
from elastic_env.world.control_step import ControlStep
from elastic_env.world.further_sensors import FurtherSensors
from elastic_env.world.many_worlds import simulate
from elastic_env.world.metrics import EpisodeMetrics, Metric
from elastic_env.world.noise_stream import NoiseStream
from elastic_env.world.physics import Simulation, substeps
from elastic_env.world.records import Records, Sample, joint_rules
from elastic_env.world.robot_model import RobotModel
from elastic_env.world.robot_ranges import DrawnRobot
from elastic_env.world.scenario import Scenario

DIVERGED = "diverged"
"""Reason of termination where the simulation produced a bad number; MuJoCo alone would restart
it silently.
"""

_ROWS_PER_BLOCK = 4096
"""Rows, which are steps of all worlds, whose signals are computed together."""
_FEWEST_STEPS = 16
_MOST_STEPS = 256
"""Bounds of the control steps in a block of records."""


class Task(ControlStep):
    """Rules of an environment.

    Args:
        config: Configuration with `control_period_s`, `timestep_s` and `sensors`.
        name: Name of the robot.
        model: Plant of the robot without drawn parameters.
        assumed: Robot as a compensator may know it.
        motion: Reference motion of the links.
        table: Signals of the observation without further sensors.
        sensors: Names of further sensors; their columns follow the others.
        joints: Joints in order, and the sign of each angle in the mirror image.
        scenarios: Scenario of every world.
        metrics: Figures of an episode.
        kinds: Kinds of worlds: encoder counts per turn, None for continuous encoders, and True if
            measurements are delayed.
        action_bound_rad: Largest command offset [rad].

    Attributes:
        failure_names: Reasons for a termination in addition to `DIVERGED`.
        noise_type: Structured type of a noise sample.
        num_steps: Control steps of an episode that does not fail.
        fewest_control_steps: Control steps of the shortest episode that does not fail.
    """

    failure_names: tuple[str, ...] = ()
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
        joints: joint_signals.Mirrors,
        scenarios: Sequence[Scenario],
        metrics: Sequence[Metric],
        kinds: Sequence[tuple[int | None, bool]],
        action_bound_rad: float = joint_signals.ACTION_BOUND_RAD,
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
        self.action_table = joint_signals.action_table(names, action_bound_rad)
        self.assumed_model = assumed.with_observation_table(self.observation_table)
        self.metrics = metrics
        self._reference = reference
        self._has_sensors = bool(sensors)
        further_terms = type(self).further_reward_terms
        self._has_further_terms = further_terms is not ControlStep.further_reward_terms
        self._width = len(self.observation_table)
        self._addresses = records.joint_addresses(model, names)
        groups = joint_signals.JOINT_COLUMNS
        self._columns = records.first_columns(self.observation_table, groups)
        self._rules = joint_rules(config.control_period_s, kinds)
        self._kind = np.zeros(num_worlds, dtype=np.int64)
        self._scenarios = scenarios
        self._robots: dict[int, DrawnRobot] = {}
        self._noise = NoiseStream(num_worlds, self.noise_type, block=_MOST_STEPS)
        self._bound = self.action_table.space(np.float32).high.astype(np.float64)
        self._action_shape = (num_worlds, len(self._bound))
        self._failures = (DIVERGED, *self.failure_names)
        self._no_reason = np.full(num_worlds, "", dtype="<U1")
        self._no_reason.flags.writeable = False
        self._has_episode = np.zeros(num_worlds, dtype=np.bool_)
        self._all_have_episodes = False
        plans = (reference.motion, reference.plan_of_world)
        noise = (self._noise.samples, self._noise.used)
        own = (self._addresses, self._columns)
        self._constants = (*own, *plans, self._rules, self._kind, *noise)
        steps = _ROWS_PER_BLOCK // num_worlds
        self._steps_per_block = min(max(steps, _FEWEST_STEPS), _MOST_STEPS)
        worlds = np.zeros((2, num_worlds), self.world_type)
        self._begin_block(np.zeros((2, num_worlds, len(names)), records.JOINT), worlds)

    def attach(
        self, simulation: Simulation | None, num_threads: int, is_scalar: bool = False
    ) -> None:
        """Attach the physics, and compile all kernels of a control step.

        Hardware cannot wait for the compiler later.

        Args:
            simulation: Replacement for MuJoCo's physics, such as hardware.
            num_threads: Threads of MuJoCo's physics, 0 for all cores; results do not depend on it.
            is_scalar: True if error messages describe one world, whose action has no axis of
                worlds.
        """
        own = simulation or simulate(self.model, self.num_worlds, num_threads)
        self.simulation = own
        self._action_rules = (self._action_shape, self._bound.max(), is_scalar)
        self._metrics = EpisodeMetrics(self.metrics, self.num_worlds)
        # scoring many steps takes 2 ms, half a control period of hardware
        if simulation is not None:
            self._steps_per_block = _FEWEST_STEPS
        compile_now(self._compile_kernels)

    def restart(self, worlds: BoolArray, random: Sequence[EpisodeRandom]) -> None:
        """Begin new episodes in some worlds, a (num_worlds,) mask.

        The robots rest under zero offset, their springs deflected.

        Args:
            worlds: Worlds that begin an episode.
            random: Generators of every world.
        """
        self.score()
        self._advance_rows(2)
        self.simulation.restart(worlds)
        self._metrics.restart(worlds)
        last = self._row - 1
        present = self._row
        for block in (self._joints, self._worlds):  # samples keep the old rows
            block[last] = block[last - 2]
            block[present] = block[present - 2]
        self._unscored = self._row + 1
        for world in np.flatnonzero(worlds).tolist():
            self._draw(world, random[world])
        self._place(worlds)
        self._begin_worlds(worlds)
        for block in (self._joints, self._worlds):
            block[last][worlds] = block[present][worlds]
        if self._has_sensors:
            self._sensors.restart(worlds, random, self._sensor_inputs())
        self._has_episode = self._has_episode | worlds
        self._all_have_episodes = bool(self._has_episode.all())

    def signals(self, sample: Sample | None = None) -> Signals:
        """Return truth and scores by name, one value per row; by default of the present step."""
        sample = self.sample() if sample is None else sample
        return self._signals(sample.joints["truth"], sample.worlds)

    def score(self) -> None:
        """Add all unscored steps to the metrics.

        The metrics do not depend on when this is called.
        """
        rows = slice(self._unscored, self._row + 1)
        shape = (rows.stop - rows.start, self.num_worlds)
        self._unscored = rows.stop
        if shape[0] <= 0:
            return
        joints = self._joints[rows].reshape(-1, len(self._addresses))
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
        """Return the weighted terms whose sum is the reward, one value per row."""
        scores = sample.worlds["scores"]
        terms = {name: scores[name].copy() for name in scores.dtype.names or ()}
        return terms | self.further_reward_terms(sample)

    @abstractmethod
    def masks(self, sample: Sample) -> dict[str, BoolArray]:
        """Return the mask "scored" of rows that count, and the other masks of the metrics."""

    def robot_record(self, world: int) -> dict[str, float]:
        """Parameters of a world's robot by name; empty where all robots are the same."""
        has_one = self._scenarios[world].has_one_robot
        return {} if has_one else self._robots[world].record()

    @abstractmethod
    def truth(self) -> Any:
        """Return the noise-free state and true parameters, for rewards, metrics and the oracle."""

    # steps that each robot implements

    @abstractmethod
    def _draw(self, world: int, random: EpisodeRandom) -> None:
        """Draw robot, sensors and noise of a new episode, see `_set_robot`."""

    @abstractmethod
    def _place(self, worlds: BoolArray) -> None:
        """Put the physics of some worlds at rest under zero offset."""

    @abstractmethod
    def _begin_worlds(self, worlds: BoolArray) -> None:
        """Fill truth and measurements at the start of an episode in some worlds."""

    @abstractmethod
    def _signals(self, joints: Records, worlds: Records) -> Signals:
        """`signals` from the truth of the joints, (rows, n), and records of worlds, (rows,)."""

    def _set_robot(self, world: int, robot: DrawnRobot) -> None:
        """Store the robot of a world, and write the true parameters of its joints."""
        self._robots[world] = robot
        truth = self._joints[self._row, world]["truth"]
        truth["homing"] = robot.homing_rad
        assumed = self.assumed_model
        truth["stiffness"] = assumed.stiffness * np.array(robot.stiffness)
        truth["damping"] = assumed.damping * robot.damping
        truth["backlash"] = assumed.backlash + robot.backlash_rad

    def _step_info(self, sample: Sample) -> dict[str, Any]:
        """Reward terms, signals and clipping of a step."""
        clipped = sample.worlds["truth"]["clipped"].astype(np.float64)
        terms = self.reward_terms(sample)
        return {"reward_terms": terms, **self.signals(sample), "clipped": clipped}

    def _compile_kernels(self) -> None:
        """Compile all kernels by a control step whose records are discarded."""
        every = np.ones(self.num_worlds, dtype=np.bool_)
        offset, is_clipped = self._command(np.zeros(self._action_shape))
        self.simulation.ctrl[:] = 0.0
        self._begin_worlds(every)
        self._advance_rows(1)
        self._sense(offset, is_clipped)
        self.observe()
        self.score()
        self._metrics.restart(every)
        joints = np.zeros_like(self._joints[:2])
        self._begin_block(joints, np.zeros_like(self._worlds[:2]))

    def _end_info(self, ends: BoolArray) -> dict[str, Any]:
        self.score()
        failed = dict(zip(self._failures, ends, strict=False))
        # of the reasons that apply in a world, the first one counts
        reasons = np.full(self.num_worlds, "", dtype=f"<U{max(map(len, failed))}")
        for reason, worlds in reversed(failed.items()):
            reasons[worlds] = reason
        return {"termination": reasons, "episode_metrics": {**self._metrics.values(), **failed}}
