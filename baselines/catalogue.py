"""The named policies: their builders, options and sensors.

Compensation is a wrapper: `Compensated(policy, compensator)` adds the input compensation to the
command of a policy and gives it compensated encoder readings. The named policies are such
compositions.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import Any

from baselines.adaptation.disturbance_observer import LINK_IMU, DisturbanceObserver
from baselines.adaptation.estimators import LegEstimator, make_estimator
from baselines.adaptation.iterative import IterativeLearner
from baselines.adaptation.learned_signals import learned_signals
from baselines.adaptation.online_stiffness import OnlineStiffness
from baselines.compensation.compensators import Compensated, GravityCompensator
from baselines.compensation.dynamic_compensator import DynamicCompensator
from baselines.compensation.measured import (
    LINK_ENCODER,
    TORQUE_SENSOR,
    DeflectionSensors,
    MeasuredCompensator,
)
from baselines.compensation.oracle import Oracle, TrueSensors
from baselines.compensation.policy import Policy, Zero
from baselines.policy_options import ASSUMED_OPTIONS, PolicyOptions
from baselines.walking.controller import WalkingController, WalkingGains
from baselines.walking.dcm_observer import DcmObserver
from baselines.walking.foot_tare import FootTare
from baselines.walking.foothold import FootholdCorrection
from baselines.walking.phase_table import PhaseFeedforward, load_phase_table
from baselines.walking.posture import PostureFeedback, PostureGains
from baselines.walking.refined_plan import RefinedWalk, refine_model
from baselines.walking.standing_estimate import StandingEstimate
from baselines.walking.talos import HipTorque
from baselines.walking.thormang import FootBalance, StanceRoll
from baselines.walking.zmp_offset import ZmpOffset, ZmpOffsetGains
from elastic_env.core.errors import ConfigurationError, require_known
from elastic_env.world.robot_model import RobotModel, WalkerModel

Builder = Callable[[Any, Any, PolicyOptions], Any]
"""Builds a policy for an environment, an assumed model and options."""


class Track(StrEnum):
    """Needs of a policy: a track of the leaderboard."""

    STANDARD = "encoders, foot sensors and IMU"
    TORQUE_SENSORS = "joint torque sensors"
    LINK_ENCODERS = "link encoders"
    WALKS = "walks on this robot"
    TRAINING = "training in simulation"
    TRUTH = "ground truth"


TRACK_OF_SENSOR = {
    TORQUE_SENSOR: Track.TORQUE_SENSORS,
    LINK_ENCODER: Track.LINK_ENCODERS,
    LINK_IMU: Track.LINK_ENCODERS,
}
"""Track of a policy that reads a sensor beyond the standard set."""


@dataclass(frozen=True)
class NamedPolicy:
    """A policy that `baselines.make` makes by name.

    Attributes:
        build: Builds it.
        options: Names of the `PolicyOptions` that have an effect on it.
        track: Its track of the leaderboard.
        sensors: Sensors that it reads beyond the standard set, by their names in
            `gymnasium.make(..., sensors=[...])`.
    """

    build: Builder
    options: tuple[str, ...] = ()
    track: Track = Track.STANDARD
    sensors: tuple[str, ...] = ()


def _zero(env: Any, model: RobotModel, options: PolicyOptions) -> Policy:  # noqa: ARG001
    return Zero(model)


def _compensate(core: Builder, compensator: Any, output: Any = "taylor") -> Builder:
    """Builder of a policy with a compensator around it."""

    def build(env: Any, model: RobotModel, options: PolicyOptions) -> Policy:
        around = compensator(model, options.output or output, options.gravity)
        return Compensated(core(env, model, options), around, ramp_s=options.ramp_s)

    return build


_friction = _compensate(_zero, partial(DynamicCompensator, friction=True))


def _joint_observer(env: Any, model: RobotModel, options: PolicyOptions) -> Policy:
    gains = options.observer
    build = _friction if gains.friction else _compensate(_zero, DynamicCompensator)
    return DisturbanceObserver(build(env, model, options), model, gains, options.ramp_s)


def _controller(env: Any, model: WalkerModel, options: PolicyOptions) -> Policy:  # noqa: ARG001
    return WalkingController(model, options.com_feedback, options.gains, options.ramp_s)


def _open_loop(build: Builder) -> Builder:
    """Builder of a policy without feedback of the center of mass."""

    def build_open(env: Any, model: RobotModel, options: PolicyOptions) -> Policy:
        return build(env, model, options.replace(com_feedback=False))

    return build_open


def _build_base(env: Any, model: WalkerModel, options: PolicyOptions) -> Any:
    """Build the compensated policy inside a feedback."""
    base = options.base or _DEFAULT_BASE
    require_known("base of a feedback", [base], COMPENSATED)
    return COMPENSATED[base](env, model, options)


def _weigh_robot(build: Builder) -> Builder:
    """Builder of a policy whose controller measures the weight, unless `gains` set the filter."""

    def build_weighing(env: Any, model: WalkerModel, options: PolicyOptions) -> Any:
        gains = options.gains or WalkingGains()
        if "weight_filter_s" not in gains.model_fields_set:
            gains = gains.replace(weight_filter_s=_WEIGHT_FILTER_S)
        return build(env, model, options.replace(gains=gains))

    return build_weighing


def _build_adaptive(env: Any, model: WalkerModel, options: PolicyOptions) -> Any:
    base = _build_base(env, model, options)
    return OnlineStiffness(base, model, LegEstimator(model), options.adaptation)


def _add_posture_feedback(build: Builder) -> Builder:
    """Builder of a policy with posture feedback, and with a ZMP offset where options ask for it."""

    def build_feedback(env: Any, model: WalkerModel, options: PolicyOptions) -> Any:
        inner = build(env, model, options)
        policy = PostureFeedback(inner, model, options.posture, options.ramp_s)
        if options.zmp_offset is None:
            return policy
        return ZmpOffset(policy, model, options.zmp_offset)

    return build_feedback


_build_adaptive_posture = _weigh_robot(_add_posture_feedback(_build_adaptive))


def _oracle(env: Any, model: RobotModel, options: PolicyOptions) -> Policy:
    if not hasattr(env.unwrapped, "truth"):
        raise ConfigurationError(
            "the oracle reads the truth, by a method truth() of the environment, which "
            f"{type(env.unwrapped).__name__} does not have"
        )
    ramp_s = options.ramp_s
    true_model = env.unwrapped.truth().model
    if not isinstance(true_model, WalkerModel):
        return Oracle(env, Zero(model), true_model, ramp_s)
    refined = refine_model(true_model)
    options = _quick_gains(options)
    inner = _controller(env, refined, options)
    policy: Any = Oracle(env, inner, refined, ramp_s, friction=False, integral_gain=0.0)
    # without friction nothing damps the springs: they ring under a feedback, which is not needed
    if model.coulomb_friction.any():
        policy = PostureFeedback(policy, refined, options.posture, ramp_s)
        policy = _add_zmp_offset(policy, refined, options)
        policy = TrueSensors(env, FootholdCorrection(policy, refined, options.foothold))
    return RefinedWalk(policy, true_model, refined)


def _refine_walk(build: Builder) -> Builder:
    """Builder of a policy with corrected footholds on the refined plan, by full joint torque."""

    def build_refined(env: Any, model: WalkerModel, options: PolicyOptions) -> Any:
        refined = refine_model(model)
        options = _quick_gains(options)
        if options.base in (None, "dynamic"):
            options = options.replace(base="dynamic", output=options.output or "taylor")
        policy = build(env, refined, options)
        policy = FootholdCorrection(policy, refined, options.foothold)
        return RefinedWalk(FootTare(policy, refined, options.foot_tare), model, refined)

    return build_refined


@_refine_walk
def _foothold(env: Any, model: WalkerModel, options: PolicyOptions) -> Any:
    """Build `adaptive_posture` whose ZMP has no mean error."""
    policy = _build_adaptive_posture(env, model, options.replace(zmp_offset=None))
    return _add_zmp_offset(policy, model, options)


@_refine_walk
def _dcm_observer(env: Any, model: WalkerModel, options: PolicyOptions) -> Any:
    """Build `foothold` with an observer instead of standing estimate and ZMP offset."""
    policy = _build_adaptive_posture(env, model, options.replace(zmp_offset=None))
    return DcmObserver(policy, model, options.dcm_observer, options.ramp_s)


def _phase_table(env: Any, model: WalkerModel, options: PolicyOptions) -> Any:
    """Build `foothold` with a feedforward over the phase of a step."""
    table = load_phase_table(model.plan.gait.step_period_s, options.phase_table)
    return PhaseFeedforward(_foothold(env, model, options), model, table)


def _quick_gains(options: PolicyOptions) -> PolicyOptions:
    """Options with quicker feedback, for feet that are held to their footholds."""
    posture = options.posture.model_dump(exclude_unset=True)
    walking = options.gains.model_dump(exclude_unset=True) if options.gains else {}
    return options.replace(
        posture=QUICK_POSTURE.replace(**posture), gains=QUICK_WALKING.replace(**walking)
    )


def _add_zmp_offset(policy: Any, model: WalkerModel, options: PolicyOptions) -> Any:
    """Add a ZMP offset and a standing estimate to a policy, against the mean error of the ZMP."""
    gains = ZmpOffsetGains(time_constant_s=_ZMP_OFFSET_S)
    if options.zmp_offset is not None:
        gains = gains.replace(**options.zmp_offset.model_dump(exclude_unset=True))
    return StandingEstimate(ZmpOffset(policy, model, gains), model, options.standing)


_DEFAULT_BASE = "input_output"
_ZMP_OFFSET_S = 23.0
"""Time constant of the ZMP offset of `foothold`; its standing estimate leaves a small error [s]."""
QUICK_POSTURE = PostureGains(
    proportional=2.7, integral=16.0, derivative=0.09, leak_s=0.25, trim=4.0, filter_s=0.008
)
"""Optimised on robots of bank 1, with a test of the margin. Without the foothold correction the
feet drift more with them than with the defaults."""
_WEIGHT_FILTER_S = 1.0
"""Time constant of the measured weight [s]."""
QUICK_WALKING = WalkingGains(
    dcm=0.5, velocity_filter_s=0.04, zmp_filter_s=0.02, weight_filter_s=_WEIGHT_FILTER_S
)
"""Optimised together with `QUICK_POSTURE`."""


def learned_base(options: PolicyOptions, is_walker: bool) -> str:
    """Name of the policy whose offsets `iterative` learns."""
    name = options.learned_base or ("adaptive_posture" if is_walker else "input")
    known = policies_of(is_walker).items()
    bases = [base for base, policy in known if policy.track is Track.STANDARD]
    require_known("base of iterative", [name], bases)
    return name


def _build_iterative(env: Any, model: RobotModel, options: PolicyOptions) -> Any:
    is_walker = isinstance(model, WalkerModel)
    # learned offsets turn both legs; if a leg keeps its own pitch, the ZMP drifts over the walks
    if "swing_s" not in options.posture.model_fields_set:
        given = options.posture.model_dump(exclude_unset=True)
        options = options.replace(posture=PostureGains(**given, swing_s=0.0))
    named = policies_of(is_walker)[learned_base(options, is_walker)]
    base = named.build(env, model, options)
    signals = learned_signals(model, options.learning)
    learner = IterativeLearner(base, model, signals, options.ramp_s)
    learner.trials = options.learning.trials
    return learner


def _sensor_policy(
    sensor: str, options: tuple[str, ...], joints: tuple[str, ...] = ("",)
) -> NamedPolicy:
    """Variant of `dynamic` with deflections by sensors of some joints, which also adapt K."""

    def build(env: Any, model: RobotModel, options: PolicyOptions) -> Any:
        is_walker = isinstance(model, WalkerModel)
        core: Any = _controller if is_walker else _zero
        sensors = DeflectionSensors(model, sensor, joints)
        output = options.output or ("wrench" if is_walker else "taylor")
        compensator = MeasuredCompensator(model, sensors, output, options.gravity)
        inner = core(env, model, options)
        policy = Compensated(inner, compensator, options.ramp_s, corrects_policy=True)
        estimator = make_estimator(model, sensors)
        return OnlineStiffness(policy, model, estimator, options.adaptation)

    return NamedPolicy(_weigh_robot(build), options, TRACK_OF_SENSOR[sensor], (sensor,))


def _thormang(env: Any, model: WalkerModel, options: PolicyOptions) -> Policy:  # noqa: ARG001
    balance = FootBalance(model, options.foot_balance, options.ramp_s)
    return StanceRoll(balance, model, options.stance_roll)


def _talos(env: Any, model: WalkerModel, options: PolicyOptions) -> Policy:
    return HipTorque(_controller(env, model, options), model, options.hip_torque)


COMPENSATED: Mapping[str, Builder] = {
    "input": _compensate(_controller, GravityCompensator, "none"),
    "input_output": _compensate(_controller, GravityCompensator, "taylor"),
    "input_wrench": _compensate(_controller, GravityCompensator, "wrench"),
    "dynamic": _compensate(_controller, DynamicCompensator, "wrench"),
}
"""Compensated policies of a walker, on which a feedback can build."""
_COMPENSATOR_OPTIONS = (*ASSUMED_OPTIONS, "output", "gravity", "ramp_s")
_CONTROLLER_OPTIONS = ("gains", "com_feedback", "ramp_s")
_COMPENSATED_OPTIONS = (*_COMPENSATOR_OPTIONS, "gains", "com_feedback")
_ADAPTIVE_OPTIONS = (*_COMPENSATED_OPTIONS, "base", "adaptation")
_POSTURE_OPTIONS = ("posture", "zmp_offset")
_ADAPTIVE_POSTURE_OPTIONS = (*_ADAPTIVE_OPTIONS, *_POSTURE_OPTIONS)
_FOOTHOLD_OPTIONS = (*_ADAPTIVE_POSTURE_OPTIONS, "foothold", "standing", "foot_tare")
_SENSOR_OPTIONS = (*_COMPENSATED_OPTIONS, "adaptation")
_LEARNING_OPTIONS = ("learned_base", "learning")
_THORMANG_OPTIONS = ("stance_roll", "foot_balance", "ramp_s")
_TALOS_OPTIONS = (*ASSUMED_OPTIONS, *_CONTROLLER_OPTIONS, "hip_torque")
ON_JOINTS: Mapping[str, NamedPolicy] = {
    "zero": NamedPolicy(_zero),
    "uncompensated": NamedPolicy(_zero),
    "input": NamedPolicy(_compensate(_zero, GravityCompensator), _COMPENSATOR_OPTIONS),
    "dynamic": NamedPolicy(_compensate(_zero, DynamicCompensator), _COMPENSATOR_OPTIONS),
    "friction": NamedPolicy(_friction, _COMPENSATOR_OPTIONS),
    "disturbance_observer": NamedPolicy(
        _joint_observer, (*_COMPENSATOR_OPTIONS, "observer"), TRACK_OF_SENSOR[LINK_IMU], (LINK_IMU,)
    ),
    "link_encoder": _sensor_policy(LINK_ENCODER, (*_COMPENSATOR_OPTIONS, "adaptation")),
    "iterative": NamedPolicy(
        _build_iterative, (*_COMPENSATOR_OPTIONS, *_LEARNING_OPTIONS), Track.WALKS
    ),
    "oracle": NamedPolicy(_oracle, ("ramp_s",), Track.TRUTH),
}
"""Policies of robots on a fixed base.

There is no controller, so that `uncompensated` equals `zero`.
"""
ON_THE_WALKER: Mapping[str, NamedPolicy] = {
    "zero": NamedPolicy(_zero),
    "uncompensated_open": NamedPolicy(
        _open_loop(_controller), (*ASSUMED_OPTIONS, "gains", "ramp_s")
    ),
    "uncompensated": NamedPolicy(_controller, (*ASSUMED_OPTIONS, *_CONTROLLER_OPTIONS)),
    "input_open": NamedPolicy(_open_loop(COMPENSATED["input"]), (*_COMPENSATOR_OPTIONS, "gains")),
    **{name: NamedPolicy(build, _COMPENSATED_OPTIONS) for name, build in COMPENSATED.items()},
    "adaptive": NamedPolicy(_weigh_robot(_build_adaptive), _ADAPTIVE_OPTIONS),
    "posture": NamedPolicy(
        _add_posture_feedback(_build_base), (*_COMPENSATED_OPTIONS, "base", *_POSTURE_OPTIONS)
    ),
    "adaptive_posture": NamedPolicy(_build_adaptive_posture, _ADAPTIVE_POSTURE_OPTIONS),
    "foothold": NamedPolicy(_foothold, _FOOTHOLD_OPTIONS),
    "disturbance_observer": NamedPolicy(
        _dcm_observer, (*_ADAPTIVE_OPTIONS, "posture", "foothold", "foot_tare", "dcm_observer")
    ),
    "phase_table": NamedPolicy(_phase_table, (*_FOOTHOLD_OPTIONS, "phase_table"), Track.TRAINING),
    "torque_sensor": _sensor_policy(TORQUE_SENSOR, _SENSOR_OPTIONS),
    "hip_sensor": _sensor_policy(LINK_ENCODER, _SENSOR_OPTIONS, ("hip",)),
    "link_encoder": _sensor_policy(LINK_ENCODER, _SENSOR_OPTIONS),
    "thormang": NamedPolicy(_thormang, _THORMANG_OPTIONS),
    "talos": NamedPolicy(_talos, _TALOS_OPTIONS, Track.TORQUE_SENSORS, (TORQUE_SENSOR,)),
    "iterative": NamedPolicy(
        _build_iterative, (*_ADAPTIVE_OPTIONS, "posture", *_LEARNING_OPTIONS), Track.WALKS
    ),
    "oracle": NamedPolicy(
        _oracle, (*_CONTROLLER_OPTIONS, *_POSTURE_OPTIONS, "foothold", "standing"), Track.TRUTH
    ),
}
"""Policies of the walker.

The controller assumes K too, for the ankles' offsets and the friction.
"""


def policies_of(is_walker: bool) -> Mapping[str, NamedPolicy]:
    """Policies of the walker, or of robots on a fixed base."""
    return ON_THE_WALKER if is_walker else ON_JOINTS


BEST_ON_THE_WALKER = "foothold"
"""Best policy of the walker without training and with the standard sensors; comparisons of
residuals use it.
"""
BEST_ON_JOINTS = "friction"
"""The same for robots on a fixed base."""
