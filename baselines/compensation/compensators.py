r"""The compensators of the paper: input (Eq. 9) and output (Eqs. 10 to 12).

An input compensator computes by how much the motor side has to lead so that the link reaches its
desired angle. An output compensator estimates the link angle for a motor encoder at θ. All work on
(..., n) arrays.
"""

from typing import Any, Literal, NamedTuple, TypeVar, get_args

import numpy as np
from typing_extensions import override

from baselines.compensation.compensator import Compensator
from baselines.compensation.contact_torque import WrenchTorque, planned_feet, shift_plan
from baselines.compensation.gravity_torque import GravityMethod, GravityModel, make_gravity
from baselines.compensation.inputs import DEFLECTION
from baselines.compensation.memory_rows import put_rows, select_rows
from baselines.compensation.policy import Motion, Policy, PolicyInputs, Step, WalkView
from baselines.compensation.policy_around import PolicyAround
from baselines.compensation.ramp import Ramp
from elastic_env.core.errors import ConfigurationError, require_known
from elastic_env.core.signals import Array, IntArray, Parameter
from elastic_env.joint import elasticity
from elastic_env.joint.static_equilibrium import static_link_angle
from elastic_env.motion.trajectory import STAND_S
from elastic_env.rigid.leg_chains import LegTorque
from elastic_env.world.robot_model import RobotModel, WalkerModel

OutputMethod = Literal["taylor", "newton", "wrench", "none"]


def input_offset(
    q: Array, stiffness: Array, gravity: GravityModel, servo_compliance: Parameter = 0.0
) -> Array:
    r"""Eq. 9: the offset that brings the link to θ_d.

    It is θ_cmd − θ_d = K⁻¹ τ_g(θ_d), and the sag of the servo itself.

    .. math:: u - q = \left(K^{-1} + k_p^{-1}\right) \tau_g(q)

    Args:
        q: Link angle to reach, θ_d, (..., n) [rad].
        stiffness: K, (n,) [N·m/rad].
        gravity: τ_g of the assumed model.
        servo_compliance: 1/k_p of servos without an integrator, 0 for servos that hold their angle
            [rad/(N·m)].

    Returns:
        (..., n) [rad].
    """
    torque = gravity.gravity_torque(q)
    return elasticity.static_deflection(torque, stiffness) + servo_compliance * torque


def taylor_link_angle(theta: Array, stiffness: Array, gravity: GravityModel) -> Array:
    r"""Eq. 12: link angle from the encoder with τ_g expanded to first order about θ (Eq. 11).

    .. math:: q = \theta - (K + \partial\tau_g/\partial q|_\theta)^{-1} \tau_g(\theta)

    Args:
        theta: Encoder, θ, (..., n) [rad].
        stiffness: K, (n,) [N·m/rad].
        gravity: τ_g and its gradient.

    Returns:
        q, (..., n) [rad].

    Raises:
        ElasticError: The matrix is singular.
    """
    if isinstance(gravity, LegTorque):
        return theta - gravity.solve(theta, stiffness)
    return theta - _solve(gravity, theta, stiffness, gravity.gravity_torque(theta))


def newton_link_angle(theta: Array, stiffness: Array, gravity: GravityModel) -> Array:
    """Eq. 10 solved by Newton-Raphson from q = θ, to a residual below 1e-12.

    Arguments and errors are as in `taylor_link_angle`.
    """
    torque = gravity.gravity_torque
    gradient = gravity.gravity_gradient
    return static_link_angle(theta, stiffness, torque, gradient)


class GravityCompensator(Compensator):
    """The paper's compensator: Eq. 9 on the input, Eq. 12 (or Newton on Eq. 10) on the output.

    Args:
        model: Assumed robot.
        output: "taylor" for Eq. 12, "newton" for Eq. 10, "wrench" for Eq. 12 with the torque of the
            measured foot wrenches (walker), "none" to leave the encoder as it is.
        method: Method for the gravity torque; None for the robot's default.

    Raises:
        ConfigurationError: Unknown output method or gravity method, or one that the robot does not
            have.
    """

    def __init__(
        self,
        model: RobotModel,
        output: OutputMethod = "taylor",
        method: GravityMethod | None = None,
    ) -> None:
        require_known("output compensator", [output], get_args(OutputMethod))
        self.model = model
        self.stiffness = model.stiffness
        self.servo_compliance = model.servo_compliance
        self._per_deflection = 1.0 + self.stiffness * self.servo_compliance
        self.gravity = make_gravity(model, method)
        """τ_g of the desired posture."""
        self._load: Any = self.gravity  # torque of the measured posture
        self.output = output
        self.weighs = output == "wrench"
        if self.weighs:
            if not isinstance(model, WalkerModel):
                raise ConfigurationError(
                    "the output compensator 'wrench' needs a walker with force-torque"
                    " sensors at its feet"
                )
            self._load = WrenchTorque(model)

    @override
    def at(self, rows: Array) -> "GravityCompensator":
        if not isinstance(self.model, WalkerModel):
            return self
        compensator = shallow_copy(self)
        if self._load is self.gravity:
            compensator.gravity, compensator._load = self.gravity.level_and_tilted(rows)
        else:
            compensator.gravity = self.gravity.at(rows)
            compensator._load = self._load.at(rows)
        return compensator

    @override
    def begin(self, motion: Motion) -> Array:
        return np.zeros((len(motion.q), 0))

    @override
    def offset(self, motion: Motion, memory: Array) -> tuple[Array, Array]:
        compliance = self.servo_compliance
        return input_offset(motion.q, self.stiffness, self.gravity, compliance), memory

    @override
    def deflection(self, offset: Array, memory: Array) -> Array:
        """Offset without the sag of the servo itself, (num_worlds, n) [rad]."""
        return offset / self._per_deflection

    @override
    def link_angle(self, theta: Array, memory: Array | None = None) -> Array:
        """Estimate of q from the encoders, (num_worlds, n) [rad]; it needs no memory."""
        if self.output == "none":
            return theta
        solve = newton_link_angle if self.output == "newton" else taylor_link_angle
        return solve(theta, self.stiffness, self._load)

    def deflection_by_tilt(self, theta: Array) -> Parameter:
        """Deflection by the measured tilt of a walker's pelvis, (num_worlds, n) [rad]."""
        if self._load is self.gravity or self.weighs:
            return 0.0
        tilted = self._load.solve(theta, self.stiffness)
        return tilted - self.gravity.solve(theta, self.stiffness)

    @override
    def link_rate(self, theta: Array, theta_dot: Array) -> Array:
        """Rate at the estimated link angle by the derivative of Eq. 10, (num_worlds, n) [rad/s].

        It solves (K + ∂τ_g/∂q) q̇ = K θ̇.
        """
        if self.output == "none":
            return theta_dot
        q = self.link_angle(theta)
        return _solve(self._load, q, self.stiffness, self.stiffness * theta_dot)


def _solve(gravity: GravityModel, q: Array, stiffness: Array, torque: Array) -> Array:
    """(K + ∂τ_g/∂q)⁻¹ τ, leg by leg where the legs do not couple, (..., n) [rad]."""
    if isinstance(gravity, LegTorque):
        return gravity.solve(q, stiffness, torque)
    K = np.broadcast_to(stiffness, q.shape)
    return elasticity.solve_stiffness(K, gravity.gravity_gradient(q), torque)


_T = TypeVar("_T")


def shallow_copy(compensator: _T) -> _T:
    """Copy a compensator as `copy.copy` does, in a fraction of its time."""
    other = object.__new__(type(compensator))
    other.__dict__.update(compensator.__dict__)
    return other


class CompensatedMemory(NamedTuple):
    """Memory of a compensated policy.

    Attributes:
        steps: Control steps since the start of the episode, (num_worlds, 1).
        links: Link angles that the policy saw, (num_worlds, n) [rad].
        compensator: Memory of the compensator.
        inner: Memory of the policy.
    """

    steps: IntArray
    links: Array
    compensator: Any
    inner: Any


class Compensated(PolicyAround):
    """Any policy with a compensator of joint elasticity around it (Fig. 2 of the paper).

    The action a of the policy inside is the offset of its desired link angle, q_d = q_ref + a. It
    sees the estimated link angle and rate instead of the encoder's. The compensator's offset for
    q_d is added to its action. The compensation grows from zero in the first `ramp_s` of an
    episode, while the reference is at rest.

    Attributes:
        ramp: Share of the compensation after 0, 1, ... control steps, up to 1.

    Args:
        policy: Anything with `predict`; its state may be anything. An attribute `reads_rates =
            False` saves the estimate of joint rates for a policy that does not read them.
        compensator: Offsets of commands and estimates of link angles: an object with the
            attributes and methods of `baselines.compensation.compensators.Compensator`.
        ramp_s: Duration of the ramp [s].
        corrects_policy: True to hand the input `deflection` on to the policy, as a policy that
            winds springs needs it.
    """

    def __init__(
        self,
        policy: Policy,
        compensator: Compensator,
        ramp_s: float = STAND_S,
        corrects_policy: bool = False,
    ) -> None:
        model = compensator.model
        super().__init__(policy, model)
        self.inputs = (DEFLECTION, *self.policy.inputs)
        self.compensator = compensator
        self._theta = model.observation_table.group("encoder_angle")
        self._theta_dot = model.observation_table.group("encoder_rate")
        self._corrects_policy = corrects_policy
        self.ramp = Ramp(model, ramp_s).table
        self._plan: tuple[WalkView, Any] | None = None
        if isinstance(model, WalkerModel):
            self._plan = WalkView(model.observation_table), planned_feet(model.plan)

    @override
    def begin(self, rows: Array) -> CompensatedMemory:
        motion = self.view.motion(rows)
        steps = np.zeros((len(rows), 1), dtype=np.int64)
        state = self.compensator.at(rows).begin(motion)
        return CompensatedMemory(steps, motion.q.copy(), state, self.policy.begin(rows))

    @override
    def act(self, rows: Array, memory: CompensatedMemory, inputs: PolicyInputs) -> Step:
        """Act for a control step; the input `deflection` r makes every deflection (1 + r) δ.

        Link angles by torque sensors or foot wrenches already show an unknown load: for them r is
        without its part. The contact forces that load the joints act where the inputs shift the
        ZMP.
        """
        correction = inputs.deflection
        state = memory.compensator
        if self._plan is not None and (shift := inputs.zmp_shift) is not None:
            view, feet = self._plan
            rows = rows.copy()
            shift = np.ascontiguousarray(shift)
            shift_plan(view.fields(rows), shift, feet, self.model.control_period_s)
            state = self._begin_shifted(rows, memory)
        compensator = self.compensator.at(rows)
        theta = rows[:, self._theta]
        links = compensator.link_angle(theta, state)
        if correction is not None:
            without_load = correction
            if inputs.load is not None and compensator.weighs:
                without_load = (1.0 + correction) / (1.0 + inputs.load) - 1.0
            links = links - compensator.modelled * without_load * (theta - links)
            if not self._corrects_policy:
                inputs = inputs._replace(deflection=None)
        compensated = rows.copy()
        compensated[:, self._theta] = links
        if self.policy.reads_rates:
            rates = compensator.link_rate(theta, rows[:, self._theta_dot])
            compensated[:, self._theta_dot] = rates
        action, inner = self.policy.act(compensated, memory.inner, inputs)
        action = action.astype(np.float64)
        motion = self.view.motion(rows)
        desired = Motion(motion.q + action, motion.q_dot, motion.q_ddot)
        offset, state = compensator.offset(desired, state)
        if correction is not None:
            offset = offset + correction * compensator.deflection(offset, state)
        steps = memory.steps + 1
        total = action + self.ramp.take(steps, mode="clip") * offset
        memory = CompensatedMemory(steps, links.copy(), state, inner)
        return total.astype(np.float32), memory

    @override
    def link_angles(self, rows: Array, memory: CompensatedMemory) -> Array:
        return memory.links

    def _begin_shifted(self, rows: Array, memory: CompensatedMemory) -> Any:
        """Memory of the compensator, begun under the shifted plan where an episode begins."""
        if np.count_nonzero(memory.steps) == len(rows):
            return memory.compensator
        is_new = memory.steps[:, 0] == 0
        start = self.compensator.at(rows).begin(self.view.motion(rows))
        return put_rows(memory.compensator, is_new, select_rows(start, is_new))
