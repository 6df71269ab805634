r"""Controllers that were published for walkers like this one: THORMANG3 and TALOS.

**Stance roll**, of THORMANG3, lifts the pelvis in single support.

The stance hip is commanded φ(t) further, so that the swing side of the pelvis
rises. The swing hip gets −0.35 φ(t) about the same axis, which takes the swing foot outwards. φ
grows from zero at lift-off to all of it in the middle of the swing and falls to zero at touch-down.
Each half is a polynomial of fifth order from rest to rest:

.. math:: \varphi(t) = \varphi_0 \, s(1 - |2 p(t) - 1|), \quad s(x) = 10 x^3 - 15 x^4 + 6 x^5

p is the progress of the swing. A hip roll offset of +φ₀ turns the leg by +φ₀ about x in the pelvis.
Where the left foot stands, the pelvis turns by −φ₀, and its right side rises. On the right leg the
sign is the opposite one.

Source: thor-mang/ROBOTIS-THORMANG-MPC, a fork of ROBOTIS-GIT/ROBOTIS-THORMANG-MPC, has the method
and 0.35: thormang3_walking_module/src/thormang3_online_walking.cpp, with the joint axes of
thormang3_kinematics_dynamics/src/kinematics_dynamics.cpp. 0.017 rad is of
thor-mang/ROBOTIS-THORMANG-OPC, thormang3_foot_step_generator/data/balance_param.yaml; the later
thormang3_demo/config/balance_param.yaml has 0.

**Foot balance**, the stabiliser of THORMANG3, moves the feet. It takes the place of the walking
controller.

The planned poses of the feet in the pelvis are adjusted, and inverse kinematics give the joint
angles:

==============  =======================================================================================
both feet turn  :math:`u = k_\varphi \hat\varphi + 0.1 \, k_\omega \hat\omega` about x and y:
against the pelvis' tilt φ each foot z     :math:`(R_y(u_y) R_x(u_x) r)_z`, r its place from the
middle of the feet: they turn as one each foot gives :math:`k_f (f - f_{ref})` along x, y, z and
:math:`k_m m` about x and y
==============  =======================================================================================

f and m are force and moment of the foot on its leg: a foot that carries too much rises. The force
that is wanted has the planned load share, and m a of the planned center of mass. All of that is in the
frame of the pelvis, to which the wrenches are turned by the planned headings. Every measurement
passes a first-order low-pass, α = 2πfT/(1 + 2πfT). An adjustment is bounded. The center of mass is
not fed back, and motors are taken for links.

Source: thor-mang/ROBOTIS-THORMANG-MPC, a fork of ROBOTIS-GIT/ROBOTIS-THORMANG-MPC, has the method:
thormang3_balance_control/src/thormang3_balance_control.cpp (adjustments, bounds, the factor 0.1)
and thormang3_walking_module/src/thormang3_online_walking.cpp (forces wanted). Gains and cut-off
frequencies are those of thor-mang/ROBOTIS-THORMANG-OPC, thormang3_demo/config/balance_param.yaml.
Its derivative gains are zero and left out. Its shift of the center of mass, which was set by hand
for that robot, is left out too.

Other than published: 250 Hz instead of 125 Hz. In double support horizontal forces follow the load
share, not halves. A foot out of reach comes as near as the leg allows. The joint angles have no
further feedback.

**Hip torque**, the compensation of flexible hips of TALOS, leads hip rolls by their torque.

The measured torque of each hip roll passes a first-order low-pass, is divided by K, bounded,
limited in its rate, and added to the command:

.. math:: \Delta = \mathrm{rate}\big(\mathrm{clip}(\bar\tau_J / K, \pm\Delta_{max}), \pm\dot\Delta_{max}\big), \quad
          \bar\tau_k = \alpha \bar\tau_{k-1} + (1 - \alpha) \tau_k, \quad \alpha = e^{-2 \pi f T}

In double support the value before the rate limit is zero, as where the published entity has its
input for the phase connected. The joint torque is positive along q, so the motor leads by the
deflection that it stands for.

The published entity reads the joint torque sensors of TALOS, and divides by 973.2 N·m/rad, the
flexibility that was measured on that robot. Ours reads the sensor `joint_torque`, and divides by
the K that is assumed of this robot.

Source: loco-3d/sot-talos-balance, src/hip-flexibility-compensation.cpp (method);
src/dynamic_graph/sot_talos_balance/ talos/hip_flexibility_compensation_conf.py (1 Hz, 0.01 rad,
0.003 rad/s); create_entities_utils.py (torque sensors).
"""  # noqa: E501

from typing import Any, NamedTuple

import numpy as np
from typing_extensions import override

from baselines.compensation.measured import TORQUE_SENSOR, require_sensor
from baselines.compensation.policy import (
    BatchPolicy,
    PassingMemory,
    PolicyAround,
    PolicyInputs,
    Step,
)
from baselines.compensation.startup import Ramp
from baselines.walking.zmp_shift import within_reach
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, IntArray
from elastic_env.motion.gait import RIGHT
from elastic_env.motion.trajectory import STAND_S, derivatives, minimum_jerk
from elastic_env.rigid.contact_force import shares
from elastic_env.rigid.leg_kinematics import foot_pose, leg_angles, rotation_of_tilt, turn
from elastic_env.world.robot_model import WalkerModel

_HIP_ROLL = 1  # of six joints of a leg


class StanceRollGains(Model):
    """Hip roll feedforward in single support; the defaults are the published values."""

    angle_rad: float = quantity("rad", 0.017, ge=0, le=0.3)
    """Offset of the stance hip in mid swing [rad]."""
    swing_share: float = quantity("1", 0.35, ge=0, le=1)
    """Share that the swing hip gets, with the other sign [1]."""


def stance_roll(swing: Array, support: Array, gains: StanceRollGains) -> Array:
    """Offsets of all joints, (num_worlds, 12) [rad].

    Args:
        swing: Progress of the swing, (num_worlds,), 0 before lift-off, 1 after touch-down.
        support: Foot that stands, (num_worlds,), 0 left, 1 right.
        gains: Angle and share.
    """
    angle = gains.angle_rad * minimum_jerk(1.0 - np.abs(2.0 * swing - 1.0))
    of_stance = np.where(support == RIGHT, -angle, angle)
    stands = np.stack([support != RIGHT, support == RIGHT], axis=-1)
    shares = np.where(stands, 1.0, -gains.swing_share)
    offsets = np.zeros((len(swing), 2, 6))
    offsets[..., _HIP_ROLL] = shares * of_stance[:, None]
    return offsets.reshape(len(swing), 12)


class StanceRoll(PassingMemory):
    """Any policy of a walker with the hip roll feedforward added, see the module.

    It has no memory of its own.

    Args:
        policy: What commands the robot.
        model: Assumed walker.
        gains: Angle and share.
    """

    def __init__(self, policy: Any, model: WalkerModel, gains: StanceRollGains) -> None:
        super().__init__(policy, model)
        self._gains = gains
        self._clock = model.observation_table.group("clock")

    @override
    def act(self, rows: Array, memory: Any, inputs: PolicyInputs) -> Step:
        _, swing, support = rows[:, self._clock].T
        action, memory = self.policy.act(rows, memory, inputs)
        total = action + stance_roll(swing, support, self._gains)
        return total.astype(np.float32), memory


class FootBalanceGains(Model):
    """Gains of the balance by the feet; the defaults are the published values."""

    gyro_s: float = quantity("s", 0.05, ge=0)
    """Turn of the feet per rate of the tilt, 0.1 times 0.5 [s]."""
    attitude: float = quantity("1", 1.0, ge=0)
    """Turn of the feet per tilt [1]."""
    force_horizontal: float = quantity("m/N", 0.125e-3, ge=0)
    """Shift of a foot per excess force, x and y [m/N]."""
    force_vertical: float = quantity("m/N", 0.015e-3, ge=0)
    """Lift of a foot per excess force [m/N]."""
    moment: float = quantity("rad/(N·m)", 0.001, ge=0)
    """Turn of a foot per moment on it [rad/(N·m)]."""
    imu_cutoff_hz: float = quantity("Hz", 40.0, gt=0)
    """Cut-off frequency of attitude and gyroscope [Hz]."""
    wrench_cutoff_hz: float = quantity("Hz", 30.0, gt=0)
    """Cut-off frequency of forces and moments [Hz]."""
    shift_limit_m: float = quantity("m", 0.05, gt=0)
    """Largest shift of a foot along an axis [m]."""
    turn_limit_rad: float = quantity("rad", np.deg2rad(15.0), gt=0)
    """Largest turn of a foot about an axis [rad]."""


class BalanceMemory(NamedTuple):
    """Memory of the balance by the feet.

    Attributes:
        steps: Control steps since the start of the episode, (num_worlds, 1).
        imu: Filtered roll and pitch [rad] and their rates [rad/s], (num_worlds, 4).
        wrench: Filtered wrenches of both feet, (num_worlds, 12).
    """

    steps: IntArray
    imu: Array
    wrench: Array


class FootBalance(BatchPolicy):
    """Commands a walker around its plan by adjusting the feet, see the module.

    Args:
        model: Assumed walker.
        gains: Gains.
        ramp_s: Time in which the feedback grows from zero [s].
    """

    def __init__(
        self, model: WalkerModel, gains: FootBalanceGains, ramp_s: float = STAND_S
    ) -> None:
        super().__init__(model)
        table = model.observation_table
        self._gains = gains
        self._biped = model.biped
        self._plan = model.plan
        self._dt = model.control_period_s
        self._ramp = Ramp(model, ramp_s).table
        self._attitude = table.group("imu_attitude")
        self._rate = table.columns("imu_rate.x", "imu_rate.y")
        self._wrench = table.group("wrench")
        acceleration, _ = derivatives(self._plan.com_dot, self._dt)
        upright = np.ones((len(acceleration), 1))
        self._local = self._plan.local
        acceleration = turn(acceleration, -self._plan.heading)
        wanted = np.hstack([acceleration / self._biped.gravity, upright])
        of_feet = self._biped.weight * shares(self._plan.share)
        self._wanted = of_feet[..., None] * wanted[:, None]  # (T, 2, 3)

    @override
    def begin(self, rows: Array) -> BalanceMemory:
        steps = np.zeros((len(rows), 1), dtype=np.int64)
        return BalanceMemory(steps, self._imu(rows), rows[:, self._wrench].copy())

    @override
    def act(self, rows: Array, memory: BalanceMemory, inputs: PolicyInputs) -> Step:
        steps = memory.steps + 1
        share = self._share(self._gains.imu_cutoff_hz)
        imu = memory.imu + share * (self._imu(rows) - memory.imu)
        share = self._share(self._gains.wrench_cutoff_hz)
        wrench = memory.wrench + share * (rows[:, self._wrench] - memory.wrench)
        q_ref = self.view.motion(rows).q
        q = self._move_feet(q_ref, *self._adjustments(rows, imu, wrench))
        action = self._ramp.take(steps, mode="clip") * (q - q_ref)
        return action.astype(np.float32), BalanceMemory(steps, imu, wrench)

    def _imu(self, rows: Array) -> Array:
        return np.hstack([rows[:, self._attitude], rows[:, self._rate]])

    def _adjustments(self, rows: Array, imu: Array, wrench: Array) -> Any:
        """Shifts of the feet, (num_worlds, 2, 3) [m], and turns about x and y [rad]."""
        gains = self._gains
        row = np.clip(self.view.plan_row(rows) - 1, 0, self._plan.num_steps)
        yaw = self._local.foot_yaw[row]
        wrench = wrench.reshape(-1, 2, 2, 3)
        force = turn(wrench[:, :, 0], yaw)
        moment = turn(wrench[:, :, 1], yaw)
        together = gains.attitude * imu[:, :2] + gains.gyro_s * imu[:, 2:]
        horizontal = gains.force_horizontal
        gain = np.array([horizontal, horizontal, gains.force_vertical])
        shift = gain * (force - self._wanted[row])
        ankles = self._local.ankles[row, :, :2]
        from_middle = ankles - ankles.mean(axis=1, keepdims=True)
        lifts = rotation_of_tilt(together)[:, 2, :2]
        shift[..., 2] += np.einsum("wi,wfi->wf", lifts, from_middle)
        tilt = together[:, None] + gains.moment * moment[..., :2]
        shift = np.clip(shift, -gains.shift_limit_m, gains.shift_limit_m)
        return shift, np.clip(tilt, -gains.turn_limit_rad, gains.turn_limit_rad)

    def _move_feet(self, q: Array, shift: Array, tilt: Array) -> Array:
        """Joint angles with the soles shifted and turned about their middles, (num_worlds, 12)."""
        leg = self._biped.leg
        up = self._biped.ankle_height
        position, R = foot_pose(leg, q.reshape(-1, 2, 6))
        turned = rotation_of_tilt(tilt) @ R
        ankle = position + shift + up * (turned[..., 2] - R[..., 2])
        return leg_angles(leg, within_reach(leg, ankle), turned).reshape(q.shape)

    def _share(self, cutoff_hz: float) -> float:
        """Share of a step that the low-pass makes in one period."""
        x = 2.0 * np.pi * cutoff_hz * self._dt
        return float(x / (1.0 + x))


_HIP_ROLLS = [1, 7]  # of twelve joints, left and right


class HipTorqueGains(Model):
    """Hip roll by its measured torque; the defaults are the published values."""

    cutoff_hz: float = quantity("Hz", 1.0, gt=0)
    """Cut-off frequency of the torque's low-pass [Hz]."""
    limit_rad: float = quantity("rad", 0.01, gt=0)
    """Largest offset [rad]."""
    rate_rad_s: float = quantity("rad/s", 0.003, gt=0)
    """Largest rate of the offset [rad/s]."""
    in_double_support: bool = False
    """It also acts in double support, as where the published entity has no phase connected."""


def low_pass(before: Array, value: Array, cutoff_hz: float, period_s: float) -> Array:
    """A first-order low-pass after one more sample, elementwise."""
    decay = np.exp(-2.0 * np.pi * cutoff_hz * period_s)
    return decay * before + (1.0 - decay) * value


def limit_rate(before: Array, value: Array, rate: float, period_s: float) -> Array:
    """The value, or as near to it as a rate [1/s] allows after one period, elementwise."""
    return before + np.clip(value - before, -rate * period_s, rate * period_s)


class HipTorqueMemory(NamedTuple):
    """Memory of the hip rolls that are led by their torque.

    Attributes:
        torque: Filtered torques of both hip rolls, (num_worlds, 2) [N·m].
        offset: Their offsets, (num_worlds, 2) [rad].
        inner: Memory of the policy.
    """

    torque: Array
    offset: Array
    inner: Any


class HipTorque(PolicyAround):
    """Any policy of a walker with its hip rolls led by their measured torque, see the module.

    Args:
        policy: What commands the robot.
        model: Assumed walker, whose observation has the joint torque sensors.
        gains: Filter, bound and rate limit.

    Raises:
        ConfigurationError: The observation does not have the sensors.
    """

    def __init__(self, policy: Any, model: WalkerModel, gains: HipTorqueGains) -> None:
        super().__init__(policy, model)
        table = model.observation_table
        require_sensor(table, TORQUE_SENSOR)
        self._gains = gains
        self._dt = model.control_period_s
        self._clock = table.group("clock")
        self._torque = table.group(TORQUE_SENSOR)
        self._stiffness = model.stiffness[_HIP_ROLLS]

    @override
    def begin(self, rows: Array) -> HipTorqueMemory:
        torque = rows[:, self._torque][:, _HIP_ROLLS]
        return HipTorqueMemory(torque, np.zeros_like(torque), self.policy.begin(rows))

    @override
    def act(self, rows: Array, memory: HipTorqueMemory, inputs: PolicyInputs) -> Step:
        gains = self._gains
        action, inner = self.policy.act(rows, memory.inner, inputs)
        measured = rows[:, self._torque][:, _HIP_ROLLS]
        torque = low_pass(memory.torque, measured, gains.cutoff_hz, self._dt)
        wanted = np.clip(torque / self._stiffness, -gains.limit_rad, gains.limit_rad)
        if not gains.in_double_support:
            swing = rows[:, self._clock][:, [1]]
            wanted = np.where((swing > 0.0) & (swing < 1.0), wanted, 0.0)
        offset = limit_rate(memory.offset, wanted, gains.rate_rad_s, self._dt)
        total = action.astype(np.float64)
        total[:, _HIP_ROLLS] += offset
        return total.astype(np.float32), HipTorqueMemory(torque, offset, inner)
