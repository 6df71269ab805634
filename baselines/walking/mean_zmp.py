r"""Mean error of the ZMP: how the feet show it, and two policies that take it off.

The ZMP is that of the foot sensors, as if the feet lay flat where the plan has them. It is known
against the feet alone: feet that have drifted from their footholds are not seen.

**ZMP offset**: the plan's ZMP is shifted against the mean error of the measured one.

A slope, or a load in a place that nobody knows, moves the center of mass for as long as the robot
walks, and the ZMP with it. On a slope α that is h α, with the height h of the center of mass. The
foot sensors show it, and an integral takes it off:

.. math:: \dot s = -\frac{1}{T} (p - p_{ref}), \quad |s_x|, |s_y| \le s_{max}

s is the shift of the planned ZMP (input `zmp` of the policy inside), p the ZMP by the foot sensors
of flat feet, all in the plan's local frame. T is several steps long: within a step the ZMP is the
controller's matter.

**Standing estimate**: what the robot shows at rest before a walk tells the walk's mean ZMP error.

An episode begins at rest on both feet, uncompensated. There the ZMP is under the center of mass. A
load in a place that nobody knows, a slope and homing errors move it, and they go on to do so in the
walk. What the springs bend goes, as compensation and posture feedback level the pelvis: its pitch
β and roll α move the center of mass by h β and −h α. So the mean error of the ZMP in the walk is

.. math:: \bar e_x = a_x e_x + b_x \beta + d, \qquad \bar e_y = a_y e_y + b_y \alpha

with the means e, α and β over the first moments, in which the policy has hardly moved. Before the
walk begins the planned ZMP is shifted by −ē (input `zmp` of the policy inside). The five numbers
were fitted to robots of bank 1 in `drawn`, at 3, 1.6 and 1.1 s. They hardly depend on the gait.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from typing_extensions import override

from baselines.compensation.policy import (
    MemoryAround,
    PolicyAround,
    PolicyInputs,
    Step,
    WalkView,
    record_row,
    record_rows,
)
from elastic_env.core.compiled import compiled
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, IntArray, Mirrored, Signal, SignalGroup
from elastic_env.motion.trajectory import STAND_S, minimum_jerk
from elastic_env.world.foot_sensors import FootSensors
from elastic_env.world.robot_model import WalkerModel

LEAST_LOAD = 0.05
"""Share of the weight below which the feet show no ZMP to a slow feedback."""


class FlatFeet:
    """Feet that lie flat on their footholds, see the module.

    Args:
        model: Assumed walker.
        least_n: Vertical force below which there is no ZMP [N].
    """

    def __init__(self, model: WalkerModel, least_n: float) -> None:
        self._view = WalkView(model.observation_table)
        self._wrench = model.observation_table.group("wrench")
        sensors = FootSensors.of_biped(model.biped)
        self._feet = record_row(
            com=sensors.com,  # of the feet from their ankles [m]
            weight=sensors.weight,  # of the feet [N]
            least_n=least_n,
            ankle_height=model.biped.ankle_height,  # of feet on the ground [m]
            period_s=model.control_period_s,
        )
        plan = model.plan
        self._plan = record_rows(
            ankles=plan.ankles[..., :2],  # [m]
            yaw=plan.foot_yaw,  # [rad]
            heading=plan.heading,  # of the pelvis [rad]
        )

    def zmp_error(self, rows: Array, wrench: Array | None = None) -> Array:
        """ZMP of wrenches less the planned one, in the plan's local frame, (num_worlds, 2) [m].

        Args:
            rows: Observations whose reference is meant, (num_worlds, m).
            wrench: Force and moment at the ankles in the frames of the feet, (num_worlds, 12) [N],
                [N·m]; None for those of the observations.

        Returns:
            nan where the feet carry too little.
        """
        return self.ground(rows, rows[:, self._wrench] if wrench is None else wrench)[1]

    def ground(self, rows: Array, wrench: Array) -> tuple[Array, Array]:
        """Force of the ground on the feet in the world, (num_worlds, 2, 3) [N], and `zmp_error`."""
        force = np.empty((len(rows), 2, 3))
        error = np.empty((len(rows), 2))
        seen = np.ascontiguousarray(wrench).reshape(-1, 2, 2, 3)
        find_ground(self._feet, self._plan, self._view.fields(rows), seen, force, error)
        return force, error


@compiled
def find_ground(
    feet: Any, plan: Any, observed: Any, wrench: Array, force: Array, error: Array
) -> None:
    """`FlatFeet.ground`, by the equation of `compute_zmp` in the control kernels.

    Args:
        feet: Feet of the walker, a row, (1,).
        plan: Feet where they are planned, one row per control step.
        observed: Observations, rows with fields, (n,).
        wrench: Force and moment at the ankles, (n, 2, 2, 3) [N], [N·m].
        force: To be filled, (n, 2, 3) [N].
        error: To be filled, (n, 2) [m].
    """
    own = feet[0]
    for world in range(len(error)):
        shown = observed[world]
        row = int(np.rint(shown.clock[0] / own.period_s))
        planned = plan[min(max(row, 0), len(plan) - 1)]
        about_x = about_y = vertical = 0.0
        for foot in range(2):
            sine = math.sin(planned.yaw[foot])
            cosine = math.cos(planned.yaw[foot])
            f = wrench[world, foot, 0]
            n = wrench[world, foot, 1]
            c = own.com[foot]
            w = own.weight[foot]
            p = planned.ankles[foot]
            x = cosine * f[0] - sine * f[1] - w[0]
            y = sine * f[0] + cosine * f[1] - w[1]
            z = f[2] - w[2]
            c_x = cosine * c[0] - sine * c[1]
            c_y = sine * c[0] + cosine * c[1]
            moment_x = cosine * n[0] - sine * n[1] - (c_y * w[2] - c[2] * w[1])
            moment_y = sine * n[0] + cosine * n[1] - (c[2] * w[0] - c_x * w[2])
            about_x += p[1] * z - own.ankle_height * y + moment_x
            about_y += own.ankle_height * x - p[0] * z + moment_y
            vertical += z
            force[world, foot] = (x, y, z)
        scale = vertical if vertical >= own.least_n else np.nan
        x = -about_y / scale - shown.zmp_reference[0]
        y = about_x / scale - shown.zmp_reference[1]
        sine = math.sin(planned.heading)
        cosine = math.cos(planned.heading)
        error[world, 0] = cosine * x + sine * y
        error[world, 1] = cosine * y - sine * x


class ZmpOffsetGains(Model):
    """How fast and how far the planned ZMP is shifted."""

    time_constant_s: float = quantity("s", 6.0, gt=0)
    """Time constant T of the integral [s]."""
    limit_m: float = quantity("m", 0.03, gt=0, lt=0.05)
    """Largest shift forward and sideways [m]."""


IN_PLANE: dict[str, Mirrored | None] = {"x": "same", "y": "opposite"}
_SHIFT = SignalGroup.of(
    "zmp_offset",
    "m",
    "shift of the planned ZMP along {part} against its mean error",
    IN_PLANE,
    None,
).signals


class ZmpOffset(PolicyAround):
    """A policy of a walker with its planned ZMP shifted against the mean error, see the module.

    Args:
        policy: What commands the robot; it has the input `zmp`.
        model: Assumed walker.
        gains: Gains.
    """

    memory_type = (np.float64, 2)
    """Shift of the ZMP forward and left [m]."""

    def __init__(self, policy: Any, model: WalkerModel, gains: ZmpOffsetGains) -> None:
        super().__init__(policy, model)
        self._feet = FlatFeet(model, LEAST_LOAD * model.biped.weight)
        self._rate = model.control_period_s / gains.time_constant_s
        self._limit = gains.limit_m
        self.estimates = {**self.policy.estimates, "zmp_offset": _SHIFT}

    @override
    def estimate(self, name: str, rows: Array, memory: MemoryAround) -> Array:
        if name == "zmp_offset":
            return memory.own
        return super().estimate(name, rows, memory)

    @override
    def act(self, rows: Array, memory: MemoryAround, inputs: PolicyInputs) -> Step:
        """Its shift adds to the input `zmp`."""
        shift = memory.own.copy()
        zmp = np.zeros_like(shift) if inputs.zmp is None else inputs.zmp.copy()
        integrate(self._feet.zmp_error(rows), self._rate, self._limit, shift, zmp)
        action, inner = self.policy.act(rows, memory.inner, inputs._replace(zmp=zmp))
        return action, MemoryAround(shift, inner)


@compiled
def integrate(error: Array, rate: float, limit: float, shift: Array, zmp: Array) -> None:
    """Integrate ZMP errors into the shifts, in place, and add these to the planned ZMP.

    Args:
        error: Measured less planned ZMP, (n, 2) [m]; nan where the feet carry too little.
        rate: Share of the error that is taken off in a control period [1].
        limit: Largest shift forward and sideways [m].
        shift: Of the planned ZMP, (n, 2) [m].
        zmp: To be added to, (n, 2) [m].
    """
    for world in range(len(shift)):
        for axis in range(2):
            missed = error[world, axis]
            if not np.isnan(missed):
                moved = shift[world, axis] - rate * missed
                shift[world, axis] = min(max(moved, -limit), limit)
            zmp[world, axis] += shift[world, axis]


class StandingGains(Model):
    """How the mean ZMP error of a walk follows from what the robot shows at rest."""

    duration_s: float = quantity("s", 0.06, gt=0, lt=STAND_S)
    """Time of the mean at rest [s]."""
    zmp_x: float = quantity("1", 1.17)
    """Error of the walk per error at rest, forward [1]."""
    zmp_y: float = quantity("1", 1.21)
    """The same to the left [1]."""
    pitch_m_rad: float = quantity("m/rad", -0.38)
    """Forward error of the walk per pitch at rest [m/rad]."""
    roll_m_rad: float = quantity("m/rad", 0.285)
    """Error of the walk to the left per roll at rest [m/rad]."""
    constant_m: float = quantity("m", 0.0055)
    """Forward error of the walk of a robot that rests level under its ZMP [m]."""
    limit_m: float = quantity("m", 0.03, gt=0, lt=0.05)
    """Largest shift forward and sideways [m]."""


class StandingMemory(NamedTuple):
    """Memory of a policy with a standing estimate.

    Attributes:
        steps: Control steps since the start of the episode, (num_worlds,).
        total: Sum of the errors of the ZMP, and of roll and pitch at rest, (num_worlds, 4) [m],
            [rad].
        load: Sum of the excess of the load over the assumed weight, (num_worlds,) [1].
        inner: Memory of the policy.
    """

    steps: IntArray
    total: Array
    load: Array
    inner: Any


_RESTED = (
    Signal("standing.x", "m", "ZMP at rest less the planned one, forward", mirrored="same"),
    Signal("standing.y", "m", "the same to the left", mirrored="opposite"),
    Signal("standing.roll", "rad", "roll at rest by the IMU", mirrored="opposite"),
    Signal("standing.pitch", "rad", "pitch at rest by the IMU", mirrored="same"),
    Signal("standing.load", "1", "load at rest over the assumed weight, less 1", mirrored="same"),
)


class StandingEstimate(PolicyAround):
    """A policy of a walker whose planned ZMP is shifted by what standing tells, see the module.

    Args:
        policy: What commands the robot; it has the input `zmp`.
        model: Assumed walker.
        gains: Gains.
    """

    def __init__(self, policy: Any, model: WalkerModel, gains: StandingGains) -> None:
        super().__init__(policy, model)
        table = model.observation_table
        self._feet = FlatFeet(model, LEAST_LOAD * model.biped.weight)
        self._attitude = table.group("imu_attitude")
        self._samples = max(round(gains.duration_s / model.control_period_s), 1)
        steps = round(STAND_S / model.control_period_s) - self._samples
        growing = minimum_jerk(np.arange(steps + 1) / steps)
        self._ramp = np.concatenate([np.zeros(self._samples), growing])
        of_walk = [gains.zmp_x, gains.pitch_m_rad, gains.zmp_y, gains.roll_m_rad]
        self._per_total = np.reshape(of_walk, (2, 2)) / self._samples
        self._constant = np.array([gains.constant_m, 0.0])
        self._limit = gains.limit_m
        self._wrench = table.group("wrench")
        self._weight = model.biped.weight
        self.estimates = {**self.policy.estimates, "standing": _RESTED}

    @override
    def begin(self, rows: Array) -> StandingMemory:
        n = len(rows)
        sums = (np.zeros((n, 4)), np.zeros(n))
        return StandingMemory(np.zeros(n, np.int64), *sums, self.policy.begin(rows))

    @override
    def estimate(self, name: str, rows: Array, memory: StandingMemory) -> Array:
        if name != "standing":
            return super().estimate(name, rows, memory)
        number = np.clip(memory.steps, 1, self._samples)
        return np.column_stack([memory.total, memory.load]) / number[:, None]

    @override
    def act(self, rows: Array, memory: StandingMemory, inputs: PolicyInputs) -> Step:
        """Its shift adds to the input `zmp`."""
        total = memory.total
        load = memory.load
        steps = memory.steps + 1
        rests = steps <= self._samples
        if np.count_nonzero(rests) > 0:
            force, error = self._feet.ground(rows, rows[:, self._wrench])
            shown = np.hstack([np.nan_to_num(error, nan=0.0), rows[:, self._attitude]])
            total = total + rests[:, None] * shown
            vertical = force[:, 0, 2] + force[:, 1, 2]
            load = load + rests * (vertical / self._weight - 1.0)
        zmp = np.zeros((len(rows), 2)) if inputs.zmp is None else inputs.zmp.copy()
        gains = (self._per_total, self._constant, self._limit)
        shift_for_walk(gains, self._ramp, steps, total, zmp)
        action, inner = self.policy.act(rows, memory.inner, inputs._replace(zmp=zmp))
        return action, StandingMemory(steps, total, load, inner)


@compiled
def shift_for_walk(gains: Any, ramp: Array, steps: IntArray, total: Array, zmp: Array) -> None:
    """Add the shift of the planned ZMP by what the robots showed at rest.

    Args:
        gains: Error of the walk per sum of ZMP errors and of tilts, forward and to the left, (2, 2)
            [1], [m/rad]; its constant part, (2,) [m]; largest shift [m].
        ramp: Share of the shift after 0, 1, ... control steps, up to the last one [1].
        steps: Control steps since the start of the episode, (n,).
        total: Sums of `StandingMemory`, (n, 4).
        zmp: To be added to, (n, 2) [m].
    """
    per_total, constant, limit = gains
    for world in range(len(zmp)):
        share = ramp[min(steps[world], len(ramp) - 1)]
        for axis in range(2):
            tilt = total[world, 3 - axis]  # pitch forward, roll to the left
            error = total[world, axis] * per_total[axis, 0] + tilt * per_total[axis, 1]
            error += constant[axis]
            zmp[world, axis] += share * min(max(-error, -limit), limit)
