"""Signals and metrics of the walking task, by name."""

from collections.abc import Mapping

import numpy as np

from elastic_env.core.signals import Mirrored, Signal, SignalGroup, SignalTable
from elastic_env.robots.thormang.model import LEG_JOINTS, SIDES
from elastic_env.world.metrics import Metric
from elastic_env.world.scenario import Scenario
from elastic_env.world.task import joint_groups

JOINTS: Mapping[str, Mirrored] = {
    joint: "opposite" if joint.endswith(("_yaw", "_roll")) else "same" for joint in LEG_JOINTS
}
"""The joints in order, and what an angle of theirs is in the mirror."""


def _wrenches() -> tuple[Signal, ...]:
    of_force: dict[str, Mirrored] = {"x": "same", "y": "opposite", "z": "same"}
    of_moment: dict[str, Mirrored] = {"x": "opposite", "y": "same", "z": "opposite"}
    kinds = ("f", "N", "force", of_force), ("m", "N·m", "moment", of_moment)
    return tuple(
        Signal(
            f"wrench.{side}_{letter}{axis}",
            unit,
            f"{what} of the {foot} foot on its leg along {axis}, in the frame of the foot, at the"
            " ankle",
            kind="measured",
            mirrored=mirrored,
        )
        for side, foot in zip(SIDES, ("left", "right"), strict=True)
        for letter, unit, what, axes in kinds
        for axis, mirrored in axes.items()
    )


def _clock() -> tuple[Signal, ...]:
    parts: tuple[tuple[str, str, str, Mirrored], ...] = (
        ("time", "s", "end of the coming control period, from the start of the walk plan", "same"),
        ("swing", "1", "progress of the swing, 0 before lift-off, 1 after touch-down", "same"),
        ("support", "1", "support foot of the step, 0 left, 1 right", "complement"),
    )
    return tuple(
        Signal(f"clock.{part}", unit, meaning, kind="reference", mirrored=mirrored)
        for part, unit, meaning, mirrored in parts
    )


def _attitude_noise_rad(scenario: Scenario) -> float:
    """Of roll and pitch, in an inertial IMU before its filter."""
    imu = scenario.inertial
    return scenario.pelvis_imu.noise_rad if imu is None else imu.accelerometer_noise_rad


def _gyro_noise_rad_s(scenario: Scenario) -> float:
    imu = scenario.inertial
    return scenario.gyro_noise_rad_s if imu is None else imu.gyro_noise_rad_s


_TURNS: dict[str, Mirrored] = {"roll": "opposite", "pitch": "same"}
_RATES: dict[str, Mirrored] = {"x": "opposite", "y": "same", "z": "opposite"}
_of = SignalGroup.of

_of_joints = {group.name: group for group in joint_groups(JOINTS)}

GROUPS = (
    _of_joints["encoder_angle"],
    _of_joints["encoder_rate"],
    _of(
        "imu_attitude",
        "rad",
        "{part} of the pelvis by its IMU",
        _TURNS,
        "measured",
        noise=_attitude_noise_rad,
    ),
    _of(
        "imu_rate",
        "rad/s",
        "gyroscope of the pelvis about its {part}",
        _RATES,
        "measured",
        noise=_gyro_noise_rad_s,
    ),
    SignalGroup(
        "wrench",
        _wrenches(),
        shape=(2, 2, 3),
        noise=lambda scenario: np.array(
            [[scenario.force_noise_n] * 3, [scenario.moment_noise_nm] * 3]
        ),
    ),
    _of_joints["reference_angle"],
    _of_joints["reference_rate"],
    _of_joints["reference_acceleration"],
    SignalGroup("clock", _clock(), shape=(3,)),
    _of(
        "load_share",
        "1",
        "share of the weight on the right foot",
        {"right": "complement"},
        "reference",
        shape=(),
    ),
    _of(
        "zmp_reference",
        "m",
        "reference of the ZMP along {part}",
        {"x": "same", "y": "opposite"},
        "reference",
    ),
    _of_joints["last_command"],
)
"""The observation; what a sensor shows, its noise and its mirror image are said here alone."""

OBSERVATION = SignalTable.of(GROUPS)

FELL = "fell"

PHASES = ("double", "single", "transition")
"""Masks by which the scores are split: double support, single support, ±0.2 s around lift-off
and touch-down.
"""

_PELVIS = ("pelvis_roll", "pelvis_pitch", "pelvis_error")
_ZMP = ("zmp_deviation", "zmp_deviation_x", "zmp_deviation_y")

METRICS = (
    *(Metric(f"{signal}_{s}_rad", signal, s) for signal in _PELVIS for s in ("rms", "peak")),
    *(
        Metric(f"{signal}_{s}_m", signal, s, over="loaded")
        for signal in _ZMP
        for s in ("rms", "peak")
    ),
    *(
        Metric(f"{signal}_{phase}_rms_rad", signal, "rms", over=phase)
        for phase in PHASES
        for signal in _PELVIS
    ),
    *(
        Metric(f"{signal}_{phase}_rms_m", signal, "rms", over=f"{phase}_loaded")
        for phase in PHASES
        for signal in _ZMP
    ),
    Metric("unloaded_samples_count", "zmp_deviation", "count", over="unloaded"),
    Metric("link_error_rms_rad", "link_error", "rms"),
    Metric("link_error_min_rad", "link_error_lowest", "min"),
    Metric("link_error_max_rad", "link_error_highest", "max"),
    Metric("deflection_rms_rad", "deflection", "rms"),
    Metric("early_touchdown_mean_s", "early_touchdown", "mean", over="touchdown"),
    Metric("early_touchdown_max_s", "early_touchdown", "max", over="touchdown"),
    Metric("servo_torque_rms_nm", "servo_torque", "rms"),
    Metric("joint_torque_peak_nm", "joint_torque", "peak", over="all"),
    *(Metric(f"command_rate_{s}_rad_s", "command_rate", s, over="all") for s in ("rms", "peak")),
    Metric("clipped_share", "clipped", "mean", over="all"),
    Metric("duration_s", "time_s", "max", over="all"),
)
