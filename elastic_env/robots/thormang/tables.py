"""Signals and metrics of the walking task, by name."""

from collections.abc import Iterator, Mapping

import numpy as np

from elastic_env.core.signals import Mirrored, Parameter, Signal, SignalGroup, SignalTable
from elastic_env.robots.thormang.model import LEG_JOINTS, SIDES
from elastic_env.world.joint_signals import joint_groups
from elastic_env.world.metrics import Metric, metrics_of
from elastic_env.world.scenario import Scenario

JOINTS: Mapping[str, Mirrored] = {
    name: "opposite" if name.endswith(("_yaw", "_roll")) else "same" for name in LEG_JOINTS
}
"""The joints in order, and what an angle of theirs is in the mirror."""


_ALONG: Mapping[str, Mirrored] = {"x": "same", "y": "opposite", "z": "same"}
_ABOUT: Mapping[str, Mirrored] = {"x": "opposite", "y": "same", "z": "opposite"}
_TURNS: Mapping[str, Mirrored] = {"roll": "opposite", "pitch": "same"}
_WHERE = "in the frame of the foot, at the ankle"
_of = SignalGroup.of
_of_joints = joint_groups(JOINTS)
_wrenches = tuple(
    Signal(
        f"wrench.{side}_{what[0]}{axis}",
        unit,
        f"{what} of the {foot} foot on its leg along {axis}, {_WHERE}",
        kind="measured",
        mirrored=mirrored,
    )
    for side, foot in zip(SIDES, ("left", "right"), strict=True)
    for what, unit, axes in (("force", "N", _ALONG), ("moment", "N·m", _ABOUT))
    for axis, mirrored in axes.items()
)
_TIME = "end of the coming control period, from the start of the walk plan"
_SWING = "progress of the swing, 0 before lift-off, 1 after touch-down"
_CLOCK: Mapping[str, tuple[str, str, Mirrored]] = {
    "time": ("s", _TIME, "same"),
    "swing": ("1", _SWING, "same"),
    "support": ("1", "support foot of the step, 0 left, 1 right", "complement"),
}
_clock = tuple(
    Signal(f"clock.{part}", unit, meaning, kind="reference", mirrored=mirrored)
    for part, (unit, meaning, mirrored) in _CLOCK.items()
)
_attitude = "{part} of the pelvis by its IMU"
_rate = "gyroscope of the pelvis about its {part}"
_share = "share of the weight on the right foot"
_zmp = "reference of the ZMP along {part}"

GROUPS = (
    _of_joints["encoder_angle"],
    _of_joints["encoder_rate"],
    _of("imu_attitude", "rad", _attitude, _TURNS, "measured"),
    _of("imu_rate", "rad/s", _rate, _ABOUT, "measured"),
    SignalGroup("wrench", _wrenches, shape=(2, 2, 3)),
    _of_joints["reference_angle"],
    _of_joints["reference_rate"],
    _of_joints["reference_acceleration"],
    SignalGroup("clock", _clock, shape=(3,)),
    _of("load_share", "1", _share, {"right": "complement"}, "reference"),
    _of("zmp_reference", "m", _zmp, {"x": "same", "y": "opposite"}, "reference"),
    _of_joints["last_command"],
)
"""The observation; what a signal is in the mirror is said here alone."""

MEASURED = ("imu_attitude", "imu_rate", "wrench")
"""Groups with the noise of `sensor_noise`."""


def sensor_noise(scenario: Scenario, is_inertial: bool) -> dict[str, Parameter]:
    """Standard deviations of the groups in `MEASURED`; in an inertial IMU before its filter."""
    attitude_rad = scenario.pelvis_imu.noise_rad
    rate_rad_s = scenario.gyro_noise_rad_s
    if is_inertial:
        attitude_rad = scenario.inertial.accelerometer_noise_rad
        rate_rad_s = scenario.inertial.gyro_noise_rad_s
    wrench = np.array([[scenario.force_noise_n] * 3, [scenario.moment_noise_nm] * 3])
    return {"imu_attitude": attitude_rad, "imu_rate": rate_rad_s, "wrench": wrench}


OBSERVATION = SignalTable.of(GROUPS)

FELL = "fell"

PHASES = ("double", "single", "transition")
"""Masks by which the scores are split: double support, single support, ±0.2 s around lift-off
and touch-down.
"""

BLOCKS = ("first_steps", "last_steps")
"""Masks of the first and of the last `BLOCK_STEPS` scored steps of the walk."""
BLOCK_STEPS = 4

_PELVIS = ("pelvis_roll", "pelvis_pitch", "pelvis_error")
_ZMP = ("zmp_deviation", "zmp_deviation_x", "zmp_deviation_y")
_PARTS_OF_ZMP = (
    *("zmp_in_feet", "zmp_in_feet_x", "zmp_in_feet_y"),
    *("foot_drift", "foot_drift_x", "foot_drift_y"),
)


def _metrics_of_the_body() -> Iterator[Metric]:
    for signal in _PELVIS:
        yield from metrics_of(signal, "rad", "rms", "peak")
    for signal in (*_ZMP, *_PARTS_OF_ZMP):
        yield from metrics_of(signal, "m", "rms", "peak", over="loaded")
    yield Metric("foot_drift_end_m", "foot_drift", "last", over="loaded")
    for phase in PHASES:
        for signal in _PELVIS:
            yield Metric(f"{signal}_{phase}_rms_rad", signal, "rms", phase)
    for phase in PHASES:
        for signal in _ZMP:
            yield Metric(f"{signal}_{phase}_rms_m", signal, "rms", f"{phase}_loaded")
    for block in BLOCKS:
        yield Metric(f"pelvis_error_{block}_rms_rad", "pelvis_error", "rms", block)
        for signal in ("zmp_deviation", "zmp_in_feet", "foot_drift"):
            yield Metric(f"{signal}_{block}_rms_m", signal, "rms", f"{block}_loaded")


METRICS = (
    *_metrics_of_the_body(),
    Metric("unloaded_samples_count", "zmp_deviation", "count", over="unloaded"),
    *metrics_of("link_error", "rad", "rms"),
    Metric("link_error_min_rad", "link_error_lowest", "min"),
    Metric("link_error_max_rad", "link_error_highest", "max"),
    *metrics_of("deflection", "rad", "rms"),
    *metrics_of("early_touchdown", "s", "mean", "max", over="touchdown"),
    *metrics_of("servo_torque", "nm", "rms"),
    *metrics_of("joint_torque", "nm", "peak", over="all"),
    *metrics_of("command_rate", "rad_s", "rms", "peak", over="all"),
    Metric("end_position_error_m", "position_error", "mean", over="end"),
    Metric("end_heading_error_rad", "heading_error", "mean", over="end"),
    Metric("clipped_share", "clipped", "mean", over="all"),
    Metric("duration_s", "time_s", "max", over="all"),
)
