"""The upper bound: a policy that reads the truth."""

from typing import Any, NamedTuple

import numpy as np
from typing_extensions import override

from baselines.compensation.compensators import DriveMemory, DynamicCompensator
from baselines.compensation.policy import Motion, Policy, PolicyAround, PolicyInputs
from baselines.compensation.startup import Ramp
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, IntArray
from elastic_env.motion.trajectory import STAND_S


class OracleMemory(NamedTuple):
    """Memory of the oracle.

    Attributes:
        steps: Control steps since the start of the episode, (num_worlds, 1).
        correction: Of the integrator, (num_worlds, n) [rad].
        target: Reference of the last control step, (num_worlds, n) [rad].
        compensator: Memory of the compensator.
        inner: Memory of the policy.
    """

    steps: IntArray
    correction: Array
    target: Array
    compensator: DriveMemory
    inner: Any


class Oracle(PolicyAround):
    """Perfect sensing and a perfect model: the only policy that may read the truth.

    The dynamic compensator with the true parameters around a policy that sees the true link angles;
    on the testbed also an integrator on the true link error for what is left, with a gain below the
    damping of the link's resonance.

    Args:
        env: The environment itself, scalar or vector.
        policy: What is compensated: on the walker its controller.
        ramp_s: Time in which the compensation grows from zero [s].
        friction: Whether the compensator knows the friction; not where the policy does.
        integral_gain: Gain on the true link error [1/s]; 0 where the policy moves links off the
            reference on purpose.
    """

    integral_limit = 0.05
    """Largest correction of the integrator [rad]."""

    def __init__(
        self,
        env: Any,
        policy: Policy,
        ramp_s: float = STAND_S,
        friction: bool = True,
        integral_gain: float = 1.0,
    ) -> None:
        self._env = env.unwrapped
        model = self._env.truth().model
        super().__init__(policy, model)
        self.integral_gain = integral_gain
        self._compensator = DynamicCompensator(model, friction=friction)
        self._dt = model.control_period_s
        self._ramp = Ramp(model, ramp_s)

    @property
    @override
    def inputs(self) -> tuple[str, ...]:
        return ()

    @override
    def begin(self, rows: Array) -> OracleMemory:
        self._require_present(rows)
        motion = self.view.motion(rows)
        stiffness = self._env.truth().stiffness
        return OracleMemory(
            steps=np.zeros((len(rows), 1), dtype=np.int64),
            correction=np.zeros_like(motion.q),
            target=motion.q.copy(),
            compensator=self._compensator.at(rows).with_stiffness(stiffness).begin(motion),
            inner=self.policy.begin(rows),
        )

    @override
    def act(
        self, rows: Array, memory: OracleMemory, inputs: PolicyInputs
    ) -> tuple[Array, OracleMemory]:
        """The observation must be the environment's present one."""
        self._require_present(rows)
        truth = self._env.truth()
        motion = self.view.motion(rows)
        wanted, inner = self.policy.act(
            self.view.with_links(rows, truth.q, truth.q_dot), memory.inner, inputs
        )
        error = np.where(self._ramp.is_over(memory.steps), memory.target - truth.q, 0.0)
        correction = memory.correction + self.integral_gain * self._dt * error
        correction = np.clip(correction, -self.integral_limit, self.integral_limit)
        compensator = self._compensator.at(rows).with_stiffness(truth.stiffness)
        desired = Motion(motion.q + wanted, motion.q_dot, motion.q_ddot)
        offset, own = compensator.offset(desired, memory.compensator)
        steps = memory.steps + 1
        action = wanted + self._ramp.table.take(steps, mode="clip") * offset + correction
        return action.astype(np.float32), OracleMemory(
            steps, correction, motion.q.copy(), own, inner
        )

    @override
    def link_angles(self, rows: Array, memory: Any) -> Array:
        """The true link angles, (num_worlds, n) [rad]."""
        return self._env.truth().q

    def _require_present(self, rows: Array) -> None:
        if not np.array_equal(rows, np.atleast_2d(self._env.task.observe())):
            raise ElasticError(
                "the oracle reads the truth of the environment that it was made for, and this is"
                ' not its present observation; make one with baselines.make("oracle", env) for the'
                " environment that it is to run in"
            )
