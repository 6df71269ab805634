r"""Balance by moving the feet: the published stabiliser of THORMANG3.

It takes the place of the walking controller.

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
"""  # noqa: E501

from typing import Any, NamedTuple

import numpy as np
from typing_extensions import override

from baselines.compensation.policy import BatchPolicy, PolicyInputs, Step
from baselines.compensation.startup import Ramp
from baselines.walking.zmp_shift import within_reach
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, IntArray
from elastic_env.motion.trajectory import STAND_S
from elastic_env.motion.walk_plan import derivatives
from elastic_env.rigid.contact_force import shares
from elastic_env.rigid.leg_kinematics import foot_pose, leg_angles, rotation_of_tilt, turn
from elastic_env.world.robot_model import WalkerModel


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
        self._clock = table.group("clock")
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
        periods = np.round(rows[:, self._clock][:, 0] / self._dt)
        row = np.clip(periods.astype(np.int64) - 1, 0, self._plan.num_steps)
        yaw = self._local.foot_yaw[row]
        force, moment = (turn(part, yaw) for part in np.moveaxis(wrench.reshape(-1, 2, 2, 3), 2, 0))
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
