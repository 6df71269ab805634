r"""Foothold correction: feet land where the plan has them, by the forces that closed legs carry.

A robot on elastic joints puts its foot down beside its foothold: the joints of the standing leg
give way under the load. Encoders and IMU do not measure by how much. Once both feet stand, the legs
and the ground close a chain, whose springs pull the feet to where the joints are commanded. The
ground holds the feet apart by friction, so that a landing error e appears as a pair of horizontal
forces,

.. math:: e = p_l - p_r - (p_l - p_r)_{plan} = C \, \tfrac12 (f_l - f_r) + o_l - o_r

with the forces f of the feet on the legs, the compliance C of the closed legs, and the offsets o of
the commanded feet, all in the plan's local frame. A foot lands farther forward than its shear
shows, the quicker the load comes on it: e_x has the further term −λ dμ/dt, with the planned share μ
of the load on the right foot. λ was fitted to robots of bank 1 at step periods of 3, 1.6 and 1.1 s.
Without it all feet walk forward. The places of the feet in the plan's world frame add up the errors
from landing to landing,

.. math:: P_{landed} = P_{standing} \pm e

A constant e does not add up: left and right feet alternate, and the signs with them. The next swing
is offset by −P − b, where P is the place of the standing foot and b the error with which this foot
landed before. The offset is gone once the foot is to carry a quarter of the load (`return_load`).
"""

import math
from typing import Any

import numpy as np
from typing_extensions import override

from baselines.compensation.compiled_rows import record_row, record_rows
from baselines.compensation.policy import PolicyInputs, Step, WalkView
from baselines.compensation.policy_around import MemoryAround, PolicyAround
from baselines.walking.zmp_offset import IN_PLANE
from baselines.walking.zmp_shift import Stances, move_feet
from elastic_env.core.compiled import compiled, compiled_part, record_type
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, IntArray, Mirrored, SignalGroup
from elastic_env.motion.walk_plan import derivatives
from elastic_env.rigid.leg_kinematics import turn
from elastic_env.world.robot_model import WalkerModel


class FootholdGains(Model):
    """Gains of the foothold correction."""

    compliance_m_n: float = quantity("m/N", 4.4e-4, gt=0)
    """Compliance C of the closed legs, forward and sideways [m/N]."""
    first_gain: float = quantity("1", 0.8, ge=0, le=1)
    """Share of its first landing error that a foot learns [1]."""
    gain: float = quantity("1", 0.4, ge=0, le=1)
    """Share of every further landing error [1]."""
    begin: float = quantity("1", 0.1, ge=0, lt=0.5)
    """Progress of the swing at which the foot begins to be moved; it ends as long before landing
    [1]."""
    limit_m: float = quantity("m", 0.04, gt=0, le=0.05)
    """Largest offset of a foot forward and sideways [m]."""
    load_rate_m_s: float = quantity("m·s", 2e-4, ge=0)
    """Forward landing error λ that the shear does not show, over the rate of the load share [m·s].
    """
    return_load: float = quantity("1", 0.25, gt=0, le=1)
    """Share of the load on a foot that has landed at which its offset is gone [1]."""


FOOTHOLDS = record_type(
    place=(2, 2),  # of the feet against the plan, in the world [m]
    bias=(2, 2),  # error with which they land [m]
    landed=(2, 2),  # error of their last landings [m]
    landings=(2,),
    target=(2, 2),  # offset with which they land [m]
    offset=(2, 2),  # commanded now [m]
    total=(2,),  # of the errors e since the last landing [m]
    samples=(),
    swing=(),  # foot in the air, -1 for none
)
"""Memory of the foothold correction."""
OF_FEET: dict[str, Mirrored | None] = {
    f"{side}_{axis}": sign for side in "lr" for axis, sign in IN_PLANE.items()
}
"""Axes of vectors of both feet in the plane, and their signs in the mirror."""
# the mirror exchanges left and right: x of their difference changes its sign, and y does not
_DIFFERENCE: dict[str, Mirrored | None] = {"x": "opposite", "y": "same"}
_ESTIMATES = {
    name: SignalGroup.of(name, "m", meaning, parts, kind=None).signals
    for name, meaning, parts in (
        ("feet", "displacement {part} of a foot against the plan", OF_FEET),
        ("landing", "error {part} of a foot's last landing", OF_FEET),
        ("shear", "{part} of the landing error by the shear of both feet so far", _DIFFERENCE),
    )
}
"""Estimates in the plan's local frame; `shear` is zero before both feet carry."""


class FootholdCorrection(PolicyAround):
    """A policy of a walker whose feet land where the plan has them, see the module.

    Args:
        policy: Commands the robot.
        model: Assumed walker.
        gains: Gains.
    """

    memory_type = FOOTHOLDS

    def __init__(self, policy: Any, model: WalkerModel, gains: FootholdGains) -> None:
        super().__init__(policy, model)
        self._walk_view = WalkView(model.observation_table)
        self._stances = Stances.of(model)
        self._gains = record_row(period_s=model.control_period_s, **gains.model_dump())
        plan = model.plan
        rate = derivatives(plan.share, model.control_period_s)[0]
        self._plan = record_rows(heading=plan.heading, foot_yaw=plan.foot_yaw, share_dot=rate)
        self.estimates = {**self.policy.estimates, **_ESTIMATES}

    @override
    def begin(self, rows: Array) -> MemoryAround:
        memory = super().begin(rows)
        memory.own["swing"] = -1.0
        return memory

    @override
    def estimate(self, name: str, rows: Array, memory: MemoryAround) -> Array:
        footholds = memory.own
        if name == "feet":
            heading = self._plan["heading"].take(self.view.plan_row(rows), mode="clip")
            return turn(footholds["place"], -heading[:, None]).reshape(len(rows), 4)
        if name == "landing":
            return footholds["landed"].reshape(len(rows), 4)
        if name == "shear":
            return footholds["total"] / np.maximum(footholds["samples"], 1.0)[:, None]
        return super().estimate(name, rows, memory)

    @override
    def act(self, rows: Array, memory: MemoryAround, inputs: PolicyInputs) -> Step:
        action, inner = self.policy.act(rows, memory.inner, inputs)
        observations = self._walk_view.fields(rows)
        footholds = memory.own.copy()
        plan_rows: IntArray = np.empty(len(rows), dtype=np.int64)
        correct_footholds(self._gains, self._plan, observations, footholds, plan_rows)
        total = action.astype(np.float64)
        offset = np.ascontiguousarray(footholds["offset"])
        move_feet(*self._stances, plan_rows, offset, total)
        return total.astype(np.float32), MemoryAround(footholds, inner)


@compiled
def correct_footholds(
    settings: Any, plan: Any, observations: Any, memory: Any, plan_rows: IntArray
) -> None:
    """Update the offsets of the feet and the memory after a control step.

    Args:
        settings: Gains and the control period, a row, (1,).
        plan: Headings of the pelvis and of the feet [rad], rate of the load share [1/s], one row
            per control step.
        observations: Rows with fields, (n,).
        memory: Rows of `FOOTHOLDS`, to be updated, (n,).
        plan_rows: Numbers of the plan's rows at the end of the control period, to be filled, (n,).
    """
    gains = settings[0]
    for world in range(len(memory)):
        obs = observations[world]
        foothold = memory[world]
        row = min(int(np.rint(obs.clock[0] / gains.period_s)), len(plan) - 1)
        planned = plan[row]
        plan_rows[world] = row
        progress = obs.clock[1]
        support = int(obs.clock[2])
        # the foot that swings, and in double support the one that has landed last
        foot = support if progress <= 0.0 else 1 - support
        if 0.0 < progress < 1.0:
            if foothold.swing < 0.0:
                learn_landing(gains, planned, foothold, foot)
            set_target(gains, planned, foothold, foot)
            share = blend((progress - gains.begin) / (1.0 - 2.0 * gains.begin))
        else:
            foothold.swing = -1.0
            add_landing_error(gains, planned, obs, foothold)
            other_load = obs.load_share if foot == 0 else 1.0 - obs.load_share
            share = max((other_load - (1.0 - gains.return_load)) / gains.return_load, 0.0)
        for i in range(2):
            foothold.offset[1 - foot, i] = 0.0
            foothold.offset[foot, i] = share * foothold.target[foot, i]


@compiled_part
def add_landing_error(gains: Any, planned: Any, obs: Any, foothold: Any) -> None:
    """Add the present error of the feet's distance to the total, where both carry the robot."""
    if 0.25 < obs.load_share < 0.75:
        left = obs.wrench[0, 0]
        right = obs.wrench[1, 0]
        left_x, left_y = rotate(left[0], left[1], planned.foot_yaw[0] - planned.heading)
        right_x, right_y = rotate(right[0], right[1], planned.foot_yaw[1] - planned.heading)
        shear = (0.5 * (left_x - right_x), 0.5 * (left_y - right_y))
        foothold.total[0] -= gains.load_rate_m_s * planned.share_dot
        for i in range(2):
            commanded = foothold.offset[0, i] - foothold.offset[1, i]
            foothold.total[i] += gains.compliance_m_n * shear[i] + commanded
        foothold.samples += 1.0


@compiled_part
def learn_landing(gains: Any, planned: Any, foothold: Any, foot: int) -> None:
    """Learn from the landing of the standing foot, as the other one lifts off."""
    standing = 1 - foot
    sign = 1.0 if standing == 0 else -1.0
    foothold.swing = foot
    if foothold.samples > 0.0 and foothold.landings[0] + foothold.landings[1] > 0.0:
        gain = gains.gain if foothold.landings[standing] > 1.0 else gains.first_gain
        error_x = sign * foothold.total[0] / foothold.samples
        error_y = sign * foothold.total[1] / foothold.samples
        step = rotate(error_x, error_y, planned.heading)
        for i, error in enumerate((error_x, error_y)):
            foothold.place[standing, i] = foothold.place[foot, i] + step[i]
            foothold.landed[standing, i] = error
            missed = error - foothold.target[standing, i] - foothold.bias[standing, i]
            foothold.bias[standing, i] += gain * missed
    foothold.landings[foot] += 1.0
    foothold.samples = 0.0
    for i in range(2):
        foothold.total[i] = 0.0


@compiled_part
def set_target(gains: Any, planned: Any, foothold: Any, foot: int) -> None:
    """Set the offset with which the foot in the air is to land."""
    standing = foothold.place[1 - foot]
    back = rotate(-standing[0], -standing[1], -planned.heading)
    for i in range(2):
        wanted = back[i] - foothold.bias[foot, i]
        foothold.target[foot, i] = min(max(wanted, -gains.limit_m), gains.limit_m)


@compiled_part
def rotate(x: float, y: float, angle: float) -> tuple[float, float]:
    """Rotate a vector about the vertical, to the left [rad]."""
    cosine = math.cos(angle)
    sine = math.sin(angle)
    return cosine * x - sine * y, sine * x + cosine * y


@compiled_part
def blend(s: float) -> float:
    """Minimum-jerk blend from 0 to 1, s clipped to [0, 1]."""
    s = min(max(s, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
