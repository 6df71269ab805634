r"""Published controller of THORMANG3: stance roll and foot balance.

**Stance roll** lifts the pelvis in single support.

The stance hip is commanded φ(t) further, so that the swing side of the pelvis rises. The swing hip
gets −0.35 φ(t) about the same axis, which moves the swing foot outwards. φ grows from zero at
lift-off to its full value in the middle of the swing and falls to zero at touch-down. Each half is
a polynomial of fifth order from rest to rest:

.. math:: \varphi(t) = \varphi_0 \, s(1 - |2 p(t) - 1|), \quad s(x) = 10 x^3 - 15 x^4 + 6 x^5

p is the progress of the swing. A hip roll offset of +φ₀ turns the leg by +φ₀ about x in the pelvis.
Where the left foot stands, the pelvis turns by −φ₀, and its right side rises. On the right leg the
sign is the opposite one.

Source: thor-mang/ROBOTIS-THORMANG-MPC, a fork of ROBOTIS-GIT/ROBOTIS-THORMANG-MPC, has the method
and 0.35: thormang3_walking_module/src/thormang3_online_walking.cpp, with the joint axes of
thormang3_kinematics_dynamics/src/kinematics_dynamics.cpp. 0.017 rad is from
thor-mang/ROBOTIS-THORMANG-OPC, thormang3_foot_step_generator/data/balance_param.yaml; the later
thormang3_demo/config/balance_param.yaml has 0.

**Foot balance**, the stabiliser, moves the feet. It replaces the walking controller.

The planned poses of the feet in the pelvis are adjusted, and inverse kinematics give the joint
angles:

* Both feet turn by :math:`u = k_\varphi \hat\varphi + 0.1 \, k_\omega \hat\omega` about x and y,
  against the pelvis' tilt φ.
* Each foot rises by :math:`(R_y(u_y) R_x(u_x) r)_z`, with its place r from the middle of the feet:
  they turn as one.
* Each foot moves by :math:`k_f (f - f_{ref})` along x, y, z, and turns by :math:`k_m m` about x and
  y.

f and m are force and moment of the foot on its leg: a foot that carries too much rises. The wanted
force has the planned load share, and m a of the planned center of mass. All of that is in the frame
of the pelvis: the planned headings turn the wrenches into it. Every measurement passes a
first-order low-pass, α = 2πfT/(1 + 2πfT). An adjustment is bounded. The center of mass is not fed
back, and motor angles count as link angles.

Source: thor-mang/ROBOTIS-THORMANG-MPC, a fork of ROBOTIS-GIT/ROBOTIS-THORMANG-MPC, has the method:
thormang3_balance_control/src/thormang3_balance_control.cpp (adjustments, bounds, the factor 0.1)
and thormang3_walking_module/src/thormang3_online_walking.cpp (wanted forces). Gains and cut-off
frequencies are from thor-mang/ROBOTIS-THORMANG-OPC, thormang3_demo/config/balance_param.yaml. Its
derivative gains are zero and left out. Its shift of the center of mass, which was set by hand for
that robot, is left out too.

Differences from the published controller: 250 Hz instead of 125 Hz. In double support horizontal
forces follow the load share instead of halves. A foot out of reach comes as near as the leg allows.
The joint angles have no further feedback.
"""

from typing import Any, NamedTuple

import numpy as np
from typing_extensions import override

from baselines.compensation.policy import BatchPolicy, PolicyInputs, Step
from baselines.compensation.policy_around import PassingMemory
from baselines.compensation.ramp import Ramp
from baselines.walking.zmp_shift import within_reach
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, IntArray
from elastic_env.motion.gait import RIGHT
from elastic_env.motion.trajectory import STAND_S, minimum_jerk
from elastic_env.motion.walk_plan import derivatives
from elastic_env.rigid.contact_force import shares
from elastic_env.rigid.leg_kinematics import foot_pose, leg_angles, rotation_of_tilt, turn
from elastic_env.world.robot_model import WalkerModel

_HIP_ROLL = 1  # of the six joints of a leg


class StanceRollGains(Model):
    """Hip roll feedforward in single support; the defaults are the published values."""

    angle_rad: float = quantity("rad", 0.017, ge=0, le=0.3)
    """Offset of the stance hip in mid swing [rad]."""
    swing_share: float = quantity("1", 0.35, ge=0, le=1)
    """Share that the swing hip gets, with the other sign [1]."""


def stance_roll(swing: Array, support: Array, gains: StanceRollGains) -> Array:
    """Offsets of all joints by the hip roll feedforward, (num_worlds, 12) [rad].

    Args:
        swing: Progress of the swing, (num_worlds,), 0 before lift-off, 1 after touch-down.
        support: Foot that stands, (num_worlds,), 0 left, 1 right.
        gains: Angle and share.
    """
    angle = gains.angle_rad * minimum_jerk(1.0 - np.abs(2.0 * swing - 1.0))
    stance_angle = np.where(support == RIGHT, -angle, angle)
    stands = np.stack([support != RIGHT, support == RIGHT], axis=-1)
    shares = np.where(stands, 1.0, -gains.swing_share)
    offsets = np.zeros((len(swing), 2, 6))
    offsets[..., _HIP_ROLL] = shares * stance_angle[:, None]
    return offsets.reshape(len(swing), 12)


class StanceRoll(PassingMemory):
    """Any policy of a walker with the hip roll feedforward added, see the module.

    Args:
        policy: Commands the robot.
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
    """Commands a walker around its plan by moving its feet, see the module.

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
        acceleration = turn(acceleration, -self._plan.heading)
        per_load = np.hstack([acceleration / self._biped.gravity, upright])
        load = self._biped.weight * shares(self._plan.share)
        self._wanted_force = load[..., None] * per_load[:, None]  # (T, 2, 3)

    @override
    def begin(self, rows: Array) -> BalanceMemory:
        steps = np.zeros((len(rows), 1), dtype=np.int64)
        return BalanceMemory(steps, self._imu_state(rows), rows[:, self._wrench].copy())

    @override
    def act(self, rows: Array, memory: BalanceMemory, inputs: PolicyInputs) -> Step:
        steps = memory.steps + 1
        share = self._filter_share(self._gains.imu_cutoff_hz)
        imu = memory.imu + share * (self._imu_state(rows) - memory.imu)
        share = self._filter_share(self._gains.wrench_cutoff_hz)
        wrench = memory.wrench + share * (rows[:, self._wrench] - memory.wrench)
        q_ref = self.view.motion(rows).q
        q = self._move_feet(q_ref, *self._adjustments(rows, imu, wrench))
        action = self._ramp.take(steps, mode="clip") * (q - q_ref)
        return action.astype(np.float32), BalanceMemory(steps, imu, wrench)

    def _imu_state(self, rows: Array) -> Array:
        return np.hstack([rows[:, self._attitude], rows[:, self._rate]])

    def _adjustments(self, rows: Array, imu: Array, wrench: Array) -> Any:
        """Shifts of the feet, (num_worlds, 2, 3) [m], and turns about x and y [rad]."""
        gains = self._gains
        row = np.clip(self.view.plan_row(rows) - 1, 0, self._plan.num_steps)
        yaw = self._plan.local.foot_yaw[row]
        wrench = wrench.reshape(-1, 2, 2, 3)
        force = turn(wrench[:, :, 0], yaw)
        moment = turn(wrench[:, :, 1], yaw)
        common_turn = gains.attitude * imu[:, :2] + gains.gyro_s * imu[:, 2:]
        horizontal = gains.force_horizontal
        gain = np.array([horizontal, horizontal, gains.force_vertical])
        shift = gain * (force - self._wanted_force[row])
        ankles = self._plan.local.ankles[row, :, :2]
        from_middle = ankles - ankles.mean(axis=1, keepdims=True)
        lifts = rotation_of_tilt(common_turn)[:, 2, :2]
        shift[..., 2] += np.einsum("wi,wfi->wf", lifts, from_middle)
        tilt = common_turn[:, None] + gains.moment * moment[..., :2]
        shift = np.clip(shift, -gains.shift_limit_m, gains.shift_limit_m)
        return shift, np.clip(tilt, -gains.turn_limit_rad, gains.turn_limit_rad)

    def _move_feet(self, q: Array, shift: Array, tilt: Array) -> Array:
        """Joint angles for soles shifted and turned about their middles, (num_worlds, 12)."""
        leg = self._biped.leg
        height = self._biped.ankle_height
        position, before = foot_pose(leg, q.reshape(-1, 2, 6))
        after = rotation_of_tilt(tilt) @ before
        ankle = position + shift + height * (after[..., 2] - before[..., 2])
        return leg_angles(leg, within_reach(leg, ankle), after).reshape(q.shape)

    def _filter_share(self, cutoff_hz: float) -> float:
        """Share of its remaining way that the low-pass goes in a period [1]."""
        x = 2.0 * np.pi * cutoff_hz * self._dt
        return float(x / (1.0 + x))
