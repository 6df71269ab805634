"""Options of the named policies."""

from pathlib import Path
from typing import Any

from baselines.adaptation.disturbance_observer import ObserverGains
from baselines.adaptation.learned_signals import LearningGains
from baselines.adaptation.online_stiffness import AdaptationGains
from baselines.compensation.compensators import OutputMethod
from baselines.compensation.gravity_torque import GravityMethod
from baselines.walking.controller import WalkingGains
from baselines.walking.dcm_observer import DcmObserverGains
from baselines.walking.foot_tare import FootTareGains
from baselines.walking.foothold import FootholdGains
from baselines.walking.posture import PostureGains
from baselines.walking.standing_estimate import StandingGains
from baselines.walking.talos import HipTorqueGains
from baselines.walking.thormang import FootBalanceGains, StanceRollGains
from baselines.walking.zmp_offset import ZmpOffsetGains
from elastic_env.core.config import Model, quantity
from elastic_env.motion.trajectory import STAND_S

ASSUMED_OPTIONS = ("stiffness", "stiffness_scale")
"""Options for the assumed stiffness of the joints."""


class PolicyOptions(Model):
    """Options of the named policies, as keyword arguments of `baselines.make`."""

    stiffness: Any = None
    """K that the compensator assumes: a number, a list of one per joint [N·m/rad], or the path of
    an identification; None for the environment's assumed model."""
    stiffness_scale: float = quantity("1", 1.0, gt=0)
    """Further factor on the assumed K [1]."""
    output: OutputMethod | None = None
    """Output compensator: "taylor" for Eq. 12, "newton" for Eq. 10, on the walker also "wrench" and
    "none"; None for the method of the named policy."""
    gravity: GravityMethod | None = None
    """Method for τ_g: on the testbed "hinge" or "tree", on the walker "com", "ankle" or
    "lumped"; None for the first of them."""
    com_feedback: bool = True
    """Walker: true to feed the center of mass back."""
    gains: WalkingGains | None = None
    """Walker: gains of the controller; fields that are set replace those of the named policy."""
    base: str | None = None
    """Walker: the compensated policy that a feedback builds on; None for `input_output`, and for
    `dynamic` where `foothold` builds on it."""
    adaptation: AdaptationGains = AdaptationGains()
    """Period, filter and limit of the adaptation of the stiffness."""
    posture: PostureGains = PostureGains()
    """Walker: gains of the posture feedback."""
    zmp_offset: ZmpOffsetGains | None = None
    """Walker: gains of the ZMP offset; None for no offset, and in `foothold` for its own
    time constant."""
    foothold: FootholdGains = FootholdGains()
    """Walker: gains of the foothold correction of `foothold`."""
    standing: StandingGains = StandingGains()
    """Walker: coefficients of the standing estimate of `foothold`."""
    foot_tare: FootTareGains = FootTareGains()
    """Walker: gains of the foot tare of `foothold`."""
    dcm_observer: DcmObserverGains = DcmObserverGains()
    """Walker: filters and bound of `disturbance_observer`."""
    phase_table: Path | None = None
    """Walker: file of the table of `phase_table`; None for the table that the package has."""
    stance_roll: StanceRollGains = StanceRollGains()
    """Walker: hip roll feedforward of `thormang`."""
    foot_balance: FootBalanceGains = FootBalanceGains()
    """Walker: gains of the stabiliser of `thormang`."""
    hip_torque: HipTorqueGains = HipTorqueGains()
    """Walker: filter, bound and rate limit of `talos`."""
    observer: ObserverGains = ObserverGains()
    """Testbed: filters and bound of `disturbance_observer`."""
    learned_base: str | None = None
    """Policy whose offsets `iterative` learns; None for `adaptive_posture` on the walker, else
    `input`."""
    learning: LearningGains = LearningGains()
    """Gains of `iterative`, and its number of trials."""
    ramp_s: float = quantity("s", STAND_S, gt=0, le=3600)
    """Time within which the compensation grows from zero [s]."""
