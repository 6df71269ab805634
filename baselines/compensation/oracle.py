"""Oracle: a policy with perfect sensing and a perfect model of the joints.

On the walker it knows K of every joint, the links, the pelvis' attitude, the foot wrenches, and a
load that all robots of a scenario have on their shoulders. It does not know a drawn load, a slope,
a push, or the friction and backlash of drawn robots. Where these matter it is no bound.
"""

from typing import Any, NamedTuple, Self

import numpy as np
from typing_extensions import override

from baselines.compensation.compensators import Compensated
from baselines.compensation.dynamic_compensator import DriveMemory, DynamicCompensator
from baselines.compensation.policy import Motion, Policy, PolicyInputs, Step
from baselines.compensation.policy_around import PassingMemory
from baselines.compensation.ramp import Ramp
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, IntArray
from elastic_env.motion.trajectory import STAND_S
from elastic_env.world.robot_model import RobotModel

_LIMIT_RAD = 0.05
"""Largest correction of the integrator [rad]."""


class TrueMemory(NamedTuple):
    """Memory of the compensator with the true parameters.

    Attributes:
        steps: Control steps since the start of the episode, (num_worlds, 1).
        correction: Correction by the integrator, (num_worlds, n) [rad].
        target: Desired link angles of the last control step, (num_worlds, n) [rad].
        drives: Memory of the drives.
    """

    steps: IntArray
    correction: Array
    target: Array
    drives: DriveMemory


class TrueCompensator(DynamicCompensator):
    """The dynamic compensator with the true parameters and the true links of an environment.

    It needs no correction by inputs of a policy.

    Args:
        env: The environment itself.
        model: True model of the robot.
        ramp_s: Time after which the integrator begins [s].
        friction: True to compensate the friction.
        gain: Gain on the true link error [1/s].
    """

    modelled = 0.0

    def __init__(
        self, env: Any, model: RobotModel, ramp_s: float, friction: bool, gain: float
    ) -> None:
        self._env = env.unwrapped
        super().__init__(model, friction=friction)
        self._gain = gain * self._dt
        self._ramp = Ramp(self.model, ramp_s)
        self._truth: Any = None
        table = self.model.observation_table
        groups = ("encoder_angle", "encoder_rate", "last_command")
        self._checked = np.concatenate([np.r_[table.group(name)] for name in groups])

    @override
    def at(self, rows: Array) -> Self:
        """Compensator for the environment's present observations, (num_worlds, m).

        Raises:
            ElasticError: Other observations.
        """
        present = np.atleast_2d(self._env.task.observe())[:, self._checked]
        if not np.array_equal(rows[:, self._checked], present):
            raise ElasticError(
                "the oracle reads the truth of the environment that it was made for, and this is"
                ' not its present observation; make one with baselines.make("oracle", env) for the'
                " environment that it is to run in"
            )
        truth = self._env.truth()
        compensator = super().at(rows).with_stiffness(truth.stiffness)
        compensator._truth = truth
        return compensator

    @override
    def begin(self, motion: Motion) -> Any:
        steps = np.zeros((len(motion.q), 1), dtype=np.int64)
        zero = np.zeros_like(motion.q)
        return TrueMemory(steps, zero, motion.q.copy(), super().begin(motion))

    @override
    def offset(self, motion: Motion, memory: Any) -> Step:
        offset, drives = super().offset(motion, memory.drives)
        if self._gain == 0.0:
            return offset, memory._replace(drives=drives)
        is_over = self._ramp.is_over(memory.steps)
        error = np.where(is_over, memory.target - self._truth.q, 0.0)
        correction = memory.correction + self._gain * error
        correction = np.minimum(np.maximum(correction, -_LIMIT_RAD), _LIMIT_RAD)
        memory = TrueMemory(memory.steps + 1, correction, motion.q, drives)
        return offset + correction, memory

    @override
    def deflection(self, offset: Array, memory: Any) -> Array:
        return np.zeros_like(offset)

    @override
    def link_angle(self, theta: Array, memory: Any) -> Array:
        return self._truth.q

    @override
    def link_rate(self, theta: Array, theta_dot: Array) -> Array:
        return self._truth.q_dot


class Oracle(Compensated):
    """Perfect sensing and a perfect model: the only policy that may read the truth.

    It is the dynamic compensator with the true parameters around a policy that sees the true link
    angles. On the testbed an integrator of the true link error corrects the rest, with a gain below
    the damping of the link's resonance.

    Args:
        env: The environment itself, scalar or vector.
        policy: Policy inside it: on the walker its controller.
        model: True model of the robot; of a walker with the plan that it walks.
        ramp_s: Time in which the compensation grows from zero [s].
        friction: True to compensate the friction; False where the policy does so.
        integral_gain: Gain on the true link error [1/s]; 0 where the policy moves links off the
            reference on purpose.
    """

    def __init__(
        self,
        env: Any,
        policy: Policy,
        model: RobotModel,
        ramp_s: float = STAND_S,
        friction: bool = True,
        integral_gain: float = 1.0,
    ) -> None:
        compensator = TrueCompensator(env, model, ramp_s, friction, integral_gain)
        super().__init__(policy, compensator, ramp_s, corrects_policy=True)
        self.inputs = ()


class TrueSensors(PassingMemory):
    """A policy of a walker whose IMU and foot sensors measure without error or delay.

    Args:
        env: The environment itself, scalar or vector.
        policy: Commands the robot.
    """

    def __init__(self, env: Any, policy: Policy) -> None:
        self._env = env.unwrapped
        super().__init__(policy, self._env.assumed_model)
        table = self.model.observation_table
        names = ("imu_attitude", "imu_rate", "wrench")
        self._columns = [table.group(name) for name in names]

    @override
    def act(self, rows: Array, memory: Any, inputs: PolicyInputs) -> Step:
        truth = self._env.truth()
        true_rows = rows.copy()
        true_values = (truth.attitude, truth.pelvis_rate, truth.wrench)
        for columns, values in zip(self._columns, true_values, strict=True):
            true_rows[:, columns] = values.reshape(len(rows), -1)
        return self.policy.act(true_rows, memory, inputs)
