"""What the walking task observes, commands and scores, by name; `elastic_env.robots.thormang.task` shows the table."""

from elastic_env.core.signals import Signal, SignalTable
from elastic_env.robots.thormang.model import LEG_JOINTS
from elastic_env.runtime.metrics import Metric

ACTION_BOUND_RAD = 0.3
"""Largest command offset [rad]."""


def _per_joint(name: str, unit: str, meaning: str) -> tuple[Signal, ...]:
    return tuple(Signal(f"{name}.{joint}", unit, f"{meaning}, {joint}") for joint in LEG_JOINTS)


def _wrench(side: str) -> tuple[Signal, ...]:
    return tuple(
        Signal(f"wrench.{side}_{kind}{axis}", unit, f"{what} of the {side} foot on its leg along {axis}, at the ankle")
        for kind, unit, what in (("f", "N", "force"), ("m", "N·m", "moment"))
        for axis in "xyz"
    )


ACTION = SignalTable(
    tuple(
        Signal(f"command_offset.{joint}", "rad", f"θ_cmd − q_ref of {joint}", -ACTION_BOUND_RAD, ACTION_BOUND_RAD)
        for joint in LEG_JOINTS
    )
)

OBSERVATION = SignalTable(
    (
        *_per_joint("encoder_angle", "rad", "motor encoder, θ in whole counts"),
        *_per_joint("encoder_rate", "rad/s", "change of the encoder over the last control period"),
        *(Signal(f"imu_attitude.{axis}", "rad", f"{axis} of the pelvis by its IMU") for axis in ("roll", "pitch")),
        *(Signal(f"imu_rate.{axis}", "rad/s", f"gyroscope of the pelvis about its {axis}") for axis in "xyz"),
        *_wrench("l"),
        *_wrench("r"),
        *_per_joint("reference_angle", "rad", "q_ref at the end of the coming control period"),
        *_per_joint("reference_rate", "rad/s", "its rate"),
        *_per_joint("reference_acceleration", "rad/s²", "its acceleration"),
        Signal("clock.time", "s", "end of the coming control period, from the start of the walk plan"),
        Signal("clock.swing", "1", "progress of the swing, 0 before lift-off, 1 after touch-down"),
        Signal("clock.support", "1", "support foot of the step, 0 left, 1 right"),
        Signal("load_share", "1", "share of the weight on the right foot"),
        Signal("zmp_reference.x", "m", "reference of the ZMP, forward"),
        Signal("zmp_reference.y", "m", "reference of the ZMP, to the left"),
        *_per_joint("last_command", "rad", "θ_cmd of the last control period"),
    )
)

FELL = "fell"

PHASES = ("double", "single", "transition")
"""Masks by which the scores are split: double support, single support, ±0.2 s around lift-off and touch-down."""

_PELVIS = ("pelvis_roll", "pelvis_pitch", "pelvis_error")
_ZMP = ("zmp_deviation", "zmp_deviation_x", "zmp_deviation_y")

METRICS = (
    *(Metric(f"{signal}_{s}_rad", signal, s) for signal in _PELVIS for s in ("rms", "peak")),
    *(Metric(f"{signal}_{s}_m", signal, s, over="loaded") for signal in _ZMP for s in ("rms", "peak")),
    *(Metric(f"{signal}_{phase}_rms_rad", signal, "rms", over=phase) for phase in PHASES for signal in _PELVIS),
    *(Metric(f"{signal}_{phase}_rms_m", signal, "rms", over=f"{phase}_loaded") for phase in PHASES for signal in _ZMP),
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
