r"""The published hip roll feedforward of THORMANG3: it lifts the pelvis in single support.

In single support the stance hip is commanded φ(t) further, so that the swing side of the pelvis
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
"""

from typing import Any

import numpy as np
from typing_extensions import override

from baselines.compensation.policy import PassingMemory, PolicyInputs, Step
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array
from elastic_env.motion.gait import RIGHT
from elastic_env.motion.trajectory import minimum_jerk
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
