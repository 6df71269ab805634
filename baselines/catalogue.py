"""The named policies: how each is built, its options, and the sensors that it needs.

Compensation is a wrapper: `Compensated(policy, compensator)` adds the input compensation to the
command of a policy and shows it compensated encoder readings. The named policies are such
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
from baselines.compensation.compensated import Compensated
from baselines.compensation.compensators import GravityCompensator
from baselines.compensation.dynamic_compensator import DynamicCompensator
from baselines.compensation.measured import (
    LINK_ENCODER,
    TORQUE_SENSOR,
    DeflectionSensors,
    MeasuredCompensator,
)
from baselines.compensation.oracle import Oracle, TrueSensors
from baselines.compensation.policy import Policy, Zero
from baselines.policy_options import PolicyOptions
from baselines.walking.controller import WalkingController, WalkingGains
from baselines.walking.dcm_observer import DcmObserver
from baselines.walking.foot_tare import FootTare
from baselines.walking.foothold import FootholdCorrection
from baselines.walking.phase_table import PhaseFeedforward, load_phase_table
from baselines.walking.posture import PostureFeedback, PostureGains
from baselines.walking.refined_walk import RefinedWalk, refine_model
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
    """A policy that `baselines.make` knows by name.

    Attributes:
        build: Builds it.
        options: Names of the `PolicyOptions` that have an effect on it.
        track: What it needs.
        sensors: Sensors that it reads beyond the standard set, as `gymnasium.make(...,
            sensors=[...])` has them.
    """

    build: Builder
    options: tuple[str, ...] = ()
    track: Track = Track.STANDARD
    sensors: tuple[str, ...] = ()


def _zero(env: Any, model: RobotModel, options: PolicyOptions) -> Policy:  # noqa: ARG001
    return Zero(model)


def _around(core: Builder, compensator: Any, output: Any = "taylor") -> Builder:
    """A compensator around a policy."""

    def build(env: Any, model: RobotModel, options: PolicyOptions) -> Policy:
        made = compensator(model, options.output or output, options.gravity)
        return Compensated(core(env, model, options), made, ramp_s=options.ramp_s)

    return build


_friction = _around(_zero, partial(DynamicCompensator, friction=True))


def _observer(env: Any, model: RobotModel, options: PolicyOptions) -> Policy:
    gains = options.observer
    build = _friction if gains.friction else _around(_zero, DynamicCompensator)
    return DisturbanceObserver(build(env, model, options), model, gains, options.ramp_s)


def _controller(env: Any, model: WalkerModel, options: PolicyOptions) -> Policy:  # noqa: ARG001
    return WalkingController(model, options.com_feedback, options.gains, options.ramp_s)


def _open(build: Builder) -> Builder:
    """Without feedback of the center of mass."""

    def built(env: Any, model: RobotModel, options: PolicyOptions) -> Policy:
        return build(env, model, options.replace(com_feedback=False))

    return built


def _base(env: Any, model: WalkerModel, options: PolicyOptions) -> Any:
    """The compensated policy that a feedback is built on."""
    base = options.base or _BASE
    require_known("base of a feedback", [base], COMPENSATED)
    return COMPENSATED[base](env, model, options)


def _weighing(build: Builder) -> Builder:
    """With a controller that measures the robot's weight, unless the gains say otherwise."""

    def built(env: Any, model: WalkerModel, options: PolicyOptions) -> Any:
        gains = options.gains or WalkingGains()
        if "weight_filter_s" not in gains.model_fields_set:
            gains = gains.replace(weight_filter_s=_WEIGHT_FILTER_S)
        return build(env, model, options.replace(gains=gains))

    return built


def _adaptive(env: Any, model: WalkerModel, options: PolicyOptions) -> Any:
    base = _base(env, model, options)
    return OnlineStiffness(base, model, LegEstimator(model), options.adaptation)


def _with_posture(build: Builder) -> Builder:
    """With posture feedback, and the planned ZMP shifted against its mean error if asked for."""

    def built(env: Any, model: WalkerModel, options: PolicyOptions) -> Any:
        inner = build(env, model, options)
        policy = PostureFeedback(inner, model, options.posture, options.ramp_s)
        if options.zmp_offset is None:
            return policy
        return ZmpOffset(policy, model, options.zmp_offset)

    return built


_adaptive_posture = _weighing(_with_posture(_adaptive))


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
    further = refine_model(true_model)
    options = _with_quick_gains(options)
    inner = _controller(env, further, options)
    policy: Any = Oracle(env, inner, further, ramp_s, friction=False, integral_gain=0.0)
    # without friction nothing damps the springs: they ring under a feedback, which is not needed
    if model.coulomb_friction.any():
        policy = PostureFeedback(policy, further, options.posture, ramp_s)
        policy = _without_mean_error(policy, further, options)
        policy = TrueSensors(env, FootholdCorrection(policy, further, options.foothold))
    return RefinedWalk(policy, true_model, further)


def _on_refined_walk(build: Builder) -> Builder:
    """With feet that land as planned, along the refined plan, under its full joint torque."""

    def built(env: Any, model: WalkerModel, options: PolicyOptions) -> Any:
        further = refine_model(model)
        options = _with_quick_gains(options)
        if options.base in (None, "dynamic"):
            options = options.replace(base="dynamic", output=options.output or "taylor")
        policy = build(env, further, options)
        policy = FootholdCorrection(policy, further, options.foothold)
        return RefinedWalk(FootTare(policy, further, options.foot_tare), model, further)

    return built


@_on_refined_walk
def _foothold(env: Any, model: WalkerModel, options: PolicyOptions) -> Any:
    """`adaptive_posture` whose ZMP has no mean error."""
    policy = _adaptive_posture(env, model, options.replace(zmp_offset=None))
    return _without_mean_error(policy, model, options)


@_on_refined_walk
def _dcm_observer(env: Any, model: WalkerModel, options: PolicyOptions) -> Any:
    """`foothold` with an observer in the place of standing estimate and ZMP offset."""
    policy = _adaptive_posture(env, model, options.replace(zmp_offset=None))
    return DcmObserver(policy, model, options.dcm_observer, options.ramp_s)


def _phase_table(env: Any, model: WalkerModel, options: PolicyOptions) -> Any:
    """`foothold` with what its robots have in common fed forward."""
    table = load_phase_table(model.plan.gait.step_period_s, options.phase_table)
    return PhaseFeedforward(_foothold(env, model, options), model, table)


def _with_quick_gains(options: PolicyOptions) -> PolicyOptions:
    """With feedbacks that only feet held to their footholds bear."""
    posture = options.posture.model_dump(exclude_unset=True)
    walking = options.gains.model_dump(exclude_unset=True) if options.gains else {}
    return options.replace(
        posture=QUICK_POSTURE.replace(**posture), gains=QUICK_WALKING.replace(**walking)
    )


def _without_mean_error(policy: Any, model: WalkerModel, options: PolicyOptions) -> Any:
    """With a ZMP without a mean error."""
    gains = ZmpOffsetGains(time_constant_s=_ZMP_OFFSET_S)
    if options.zmp_offset is not None:
        gains = gains.replace(**options.zmp_offset.model_dump(exclude_unset=True))
    return StandingEstimate(ZmpOffset(policy, model, gains), model, options.standing)


_BASE = "input_output"
_ZMP_OFFSET_S = 23.0
"""Time constant of the ZMP offset of `foothold`, whose standing estimate leaves little [s]."""
QUICK_POSTURE = PostureGains(
    proportional=2.7, integral=16.0, derivative=0.09, leak_s=0.25, trim=4.0, filter_s=0.008
)
"""Found on robots of bank 1, with a test of the margin. Without footholds the feet drift more under
them than under the default."""
_WEIGHT_FILTER_S = 1.0
QUICK_WALKING = WalkingGains(
    dcm=0.5, velocity_filter_s=0.04, zmp_filter_s=0.02, weight_filter_s=_WEIGHT_FILTER_S
)
"""Found together with `QUICK_POSTURE`."""


def learned_base(options: PolicyOptions, is_walker: bool) -> str:
    """Name of the policy whose offsets `iterative` learns."""
    name = options.learned_base or ("adaptive_posture" if is_walker else "input")
    known = policies_of(is_walker).items()
    bases = [base for base, policy in known if policy.track is Track.STANDARD]
    require_known("base of iterative", [name], bases)
    return name


def _iterative(env: Any, model: RobotModel, options: PolicyOptions) -> Any:
    is_walker = isinstance(model, WalkerModel)
    # offsets that are learned turn both legs; a leg that keeps its own pitch lets the ZMP drift
    # away over the walks
    if "swing_s" not in options.posture.model_fields_set:
        given = options.posture.model_dump(exclude_unset=True)
        options = options.replace(posture=PostureGains(**given, swing_s=0.0))
    known = policies_of(is_walker)[learned_base(options, is_walker)]
    base = known.build(env, model, options)
    signals = learned_signals(model, options.learning)
    learner = IterativeLearner(base, model, signals, options.ramp_s)
    learner.trials = options.learning.trials
    return learner


def _measured(
    sensor: str, options: tuple[str, ...], joints: tuple[str, ...] = ("",)
) -> NamedPolicy:
    """`dynamic` with the deflections of some joints by sensors, which also adapt the stiffness."""

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

    return NamedPolicy(_weighing(build), options, TRACK_OF_SENSOR[sensor], (sensor,))


def _thormang(env: Any, model: WalkerModel, options: PolicyOptions) -> Policy:  # noqa: ARG001
    balance = FootBalance(model, options.foot_balance, options.ramp_s)
    return StanceRoll(balance, model, options.stance_roll)


def _talos(env: Any, model: WalkerModel, options: PolicyOptions) -> Policy:
    return HipTorque(_controller(env, model, options), model, options.hip_torque)


COMPENSATED: Mapping[str, Builder] = {
    "input": _around(_controller, GravityCompensator, "none"),
    "input_output": _around(_controller, GravityCompensator, "taylor"),
    "input_wrench": _around(_controller, GravityCompensator, "wrench"),
    "dynamic": _around(_controller, DynamicCompensator, "wrench"),
}
"""Compensated policies of a walker, which a feedback can build on."""
ASSUMED_OPTIONS = ("stiffness", "stiffness_scale")
"""Options that say what a policy assumes of the joints."""
_COMPENSATOR = (*ASSUMED_OPTIONS, "output", "gravity", "ramp_s")
_CONTROLLER = ("gains", "com_feedback", "ramp_s")
_COMPENSATED = (*_COMPENSATOR, "gains", "com_feedback")
_ADAPTIVE = (*_COMPENSATED, "base", "adaptation")
_POSTURE = ("posture", "zmp_offset")
_FOOTHOLD = ("foothold", "standing", "foot_tare")
_LEARNED = ("learned_base", "learning")
_PUBLISHED = ("stance_roll", "foot_balance", "ramp_s")
_TALOS = (*ASSUMED_OPTIONS, *_CONTROLLER, "hip_torque")
ON_JOINTS: Mapping[str, NamedPolicy] = {
    "zero": NamedPolicy(_zero),
    "uncompensated": NamedPolicy(_zero),
    "input": NamedPolicy(_around(_zero, GravityCompensator), _COMPENSATOR),
    "dynamic": NamedPolicy(_around(_zero, DynamicCompensator), _COMPENSATOR),
    "friction": NamedPolicy(_friction, _COMPENSATOR),
    "disturbance_observer": NamedPolicy(
        _observer, (*_COMPENSATOR, "observer"), TRACK_OF_SENSOR[LINK_IMU], (LINK_IMU,)
    ),
    "link_encoder": _measured(LINK_ENCODER, (*_COMPENSATOR, "adaptation")),
    "iterative": NamedPolicy(_iterative, (*_COMPENSATOR, *_LEARNED), Track.WALKS),
    "oracle": NamedPolicy(_oracle, ("ramp_s",), Track.TRUTH),
}
"""Policies of robots on a fixed base.

There `uncompensated` has no controller to add and equals `zero`.
"""
ON_THE_WALKER: Mapping[str, NamedPolicy] = {
    "zero": NamedPolicy(_zero),
    "uncompensated_open": NamedPolicy(_open(_controller), (*ASSUMED_OPTIONS, "gains", "ramp_s")),
    "uncompensated": NamedPolicy(_controller, (*ASSUMED_OPTIONS, *_CONTROLLER)),
    "input_open": NamedPolicy(_open(COMPENSATED["input"]), (*_COMPENSATOR, "gains")),
    **{name: NamedPolicy(build, _COMPENSATED) for name, build in COMPENSATED.items()},
    "adaptive": NamedPolicy(_weighing(_adaptive), _ADAPTIVE),
    "posture": NamedPolicy(_with_posture(_base), (*_COMPENSATED, "base", *_POSTURE)),
    "adaptive_posture": NamedPolicy(_adaptive_posture, (*_ADAPTIVE, *_POSTURE)),
    "foothold": NamedPolicy(_foothold, (*_ADAPTIVE, *_POSTURE, *_FOOTHOLD)),
    "disturbance_observer": NamedPolicy(
        _dcm_observer, (*_ADAPTIVE, "posture", "foothold", "foot_tare", "dcm_observer")
    ),
    "phase_table": NamedPolicy(
        _phase_table, (*_ADAPTIVE, *_POSTURE, *_FOOTHOLD, "phase_table"), Track.TRAINING
    ),
    "torque_sensor": _measured(TORQUE_SENSOR, (*_COMPENSATED, "adaptation")),
    "hip_sensor": _measured(LINK_ENCODER, (*_COMPENSATED, "adaptation"), ("hip",)),
    "link_encoder": _measured(LINK_ENCODER, (*_COMPENSATED, "adaptation")),
    "thormang": NamedPolicy(_thormang, _PUBLISHED),
    "talos": NamedPolicy(_talos, _TALOS, Track.TORQUE_SENSORS, (TORQUE_SENSOR,)),
    "iterative": NamedPolicy(_iterative, (*_ADAPTIVE, "posture", *_LEARNED), Track.WALKS),
    "oracle": NamedPolicy(_oracle, (*_CONTROLLER, *_POSTURE, "foothold", "standing"), Track.TRUTH),
}
"""Policies of the walker.

The controller alone assumes K too, for the ankles' offsets and the friction.
"""


def policies_of(is_walker: bool) -> Mapping[str, NamedPolicy]:
    """Policies of the walker, or of robots on a fixed base."""
    return ON_THE_WALKER if is_walker else ON_JOINTS


BEST_ON_THE_WALKER: str | None = "foothold"
"""Best policy of the walker that needs no training and reads the standard sensors; residuals are
compared with it.
"""
BEST_ON_JOINTS: str | None = "friction"
"""The same for robots on a fixed base."""
