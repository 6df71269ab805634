"""The baselines by name; `baselines.catalogue` has their builders."""

from pathlib import Path
from typing import Any

from baselines.adaptation.iterative import LearnedOffsets
from baselines.adaptation.learned_signals import learned_signals
from baselines.adaptation.offset_folder import load_table
from baselines.catalogue import BEST_ON_JOINTS, BEST_ON_THE_WALKER, Track, policies_of
from baselines.compensation.policy import Policy
from baselines.policy_options import ASSUMED_OPTIONS, PolicyOptions
from baselines.residual.correction import Corrected
from baselines.residual.residual_folder import load_residual
from baselines.residual.residual_policy import ResidualPolicy
from baselines.residual.settings import RESIDUAL
from baselines.residual.true_robot import truth_of
from elastic_env.core.errors import ConfigurationError, choices_listed, quote, shorten, unknown_name
from elastic_env.world.robot_model import RobotModel, WalkerModel, read_stiffness

ITERATIVE = "iterative:"
"""Prefix of a folder of learned offsets, in names of policies."""


def is_saved(name: str) -> bool:
    """True for the name of a policy in a folder, such as residual:PATH."""
    return name.startswith((RESIDUAL, ITERATIVE))


def policy_names() -> list[str]:
    """Names that `make` accepts."""
    return list({**policies_of(is_walker=True), **policies_of(is_walker=False)})


def track(name: str, is_walker: bool = True) -> Track:
    """Track of a policy by its name; a user's own policy reads the standard sensors."""
    if name.startswith(RESIDUAL):
        return Track.TRAINING
    if name.startswith(ITERATIVE):
        return Track.WALKS
    named = policies_of(is_walker).get(name)
    return Track.STANDARD if named is None else named.track


def best_analytic(is_walker: bool = True) -> str:
    """Name of the best policy without learning and with the standard sensors."""
    return BEST_ON_THE_WALKER if is_walker else BEST_ON_JOINTS


def sensors_needed(name: str, is_walker: bool = True) -> tuple[str, ...]:
    """Sensors beyond the standard set that a policy reads, for the argument `sensors`."""
    named = policies_of(is_walker).get(name)
    return () if named is None else named.sensors


def make(name: str, env: Any, /, **options: Any) -> Policy:
    """Make a named baseline for an environment.

    | name | on the testbed | on the walker |
    |---|---|---|
    | `zero` | plays the reference back | the same |
    | `uncompensated` | the same | walking controller alone; it takes motors for links |
    | `input` | Eq. 9 on the command, Eq. 12 (or Newton) on the encoder | Eq. 9 around the controller |
    | `input_output` | – | and Eq. 12: the controller sees the estimated links |
    | `input_wrench` | – | the estimate uses the measured foot wrenches, not the planned share |
    | `dynamic` | full joint torque with D; servo with B inverted | the same, links as `input_wrench` |
    | `friction` | `dynamic`, and the model's Coulomb friction fed forward | – |
    | `disturbance_observer` | `friction`, and the torque that the model lacks, by the link's IMU | `foothold`, mean ZMP error by a DCM observer |
    | `adaptive` | – | `input_output`, stiffness of each leg and weight estimated online |
    | `posture` | – | `input_output` with the pelvis' attitude fed back to the hips |
    | `adaptive_posture` | – | both |
    | `foothold` | – | and feet that land as planned: the strongest with the standard sensors |
    | `phase_table` | – | `foothold`, and a feedforward over the phase of the step |
    | `torque_sensor` | – | deflections by joint torque sensors, K⁻¹ τ_J |
    | `link_encoder` | `dynamic`, K of each joint by link encoders | deflections by link encoders |
    | `hip_sensor` | – | the same at the hips alone |
    | `thormang` | – | this robot's published controller: hip roll, feet by IMU and wrench |
    | `talos` | – | hip rolls led by their measured torque, as TALOS' published controller does |
    | `iterative` | `input`, offsets learned in ten trials before | `adaptive_posture`, in ten walks |
    | `iterative:PATH` | offsets that `elastic iterate` has learned and saved | the same |
    | `oracle` | true parameters, integral action on the true link error | true K, links and sensors, `foothold` |
    | `uncompensated_open`, `input_open` | – | without feedback of the center of mass |
    | `residual:PATH` | a trained residual on its base: a folder, or a shipped name | the same |

    `iterative` has a method `rehearse(env, seed)`, which plays its trials, each world on its own
    robot. Before that it equals its base. Evaluations call it before they score.

    Args:
        name: Name in the table.
        env: The environment, scalar or vector, wrapped or not; it provides the assumed model.
        **options: Parameters of `PolicyOptions` that have an effect on this policy in this
            environment, such as stiffness, output, gravity, com_feedback, gains; None counts as not
            given.

    Returns:
        An object with `predict`, usable on scalar and vector environments and in SB3's
        `evaluate_policy`.

    Raises:
        ConfigurationError: Unknown name or option, one without effect, or an environment that is
            not ours.
    """  # noqa: E501
    inner = getattr(env, "unwrapped", env)
    if not hasattr(inner, "assumed_model"):
        raise ConfigurationError(
            "a baseline needs an environment with an assumed model, got"
            f" {type(inner).__name__}; make one with"
            ' gymnasium.make("elastic_env/Testbed-v0") and pass it here, also if the policy is to'
            " run on a wrapper of it"
        )
    if not isinstance(name, str):
        raise unknown_name("policy", name, policy_names())
    if name.startswith(RESIDUAL):
        return _residual_policy(Path(name.removeprefix(RESIDUAL)), env, options)
    if name.startswith(ITERATIVE):
        return _learned_policy(Path(name.removeprefix(ITERATIVE)), env, options)
    given = {option: value for option, value in options.items() if value is not None}
    is_walker = isinstance(env.unwrapped.assumed_model, WalkerModel)
    named = policies_of(is_walker).get(name)
    if named is None:
        names = [*policies_of(is_walker), f"{RESIDUAL}PATH", "module:function"]
        robot = env.unwrapped.task.name
        if name in policies_of(not is_walker):
            owner = "robots on a fixed base" if is_walker else "the walker"
            problem = f"{quote(name)} is a policy of {owner}, not of the {robot}"
            raise ConfigurationError(f"{problem}; {choices_listed('', names)}")
        raise unknown_name(f"policy of the {robot}", name, names)
    _require_effect(name, env, given, named.options)
    chosen = PolicyOptions(**given)
    return named.build(env, _assumed_model(env, chosen), chosen)


def _residual_policy(folder: Path, env: Any, options: dict[str, Any]) -> Policy:
    """Load a trained residual around its base; options replace those of the base."""
    description, network = load_residual(folder)
    task = env.unwrapped.task.name
    if description.robot != task:
        robot = f"the {description.robot}, the environment is the {task}"
        raise ConfigurationError(f"{shorten(folder)} is a residual for {robot}")
    model: RobotModel = env.unwrapped.assumed_model
    joints = model.joint_names
    if description.joints not in ([], joints):
        trained = f"a robot with the joints {', '.join(description.joints)}"
        has = f"the environment's has {', '.join(joints)}"
        raise ConfigurationError(f"{shorten(folder)} was trained on {trained}; {has}")
    base = make(description.base, env, **{**description.base_options, **options})
    corrected = Corrected(base, model, description.settings, truth_of(env))
    return ResidualPolicy(corrected, network)


def _learned_policy(folder: Path, env: Any, options: dict[str, Any]) -> Policy:
    """Load learned offsets around their base, with options for the base."""
    description, table = load_table(folder, env)
    model: RobotModel = env.unwrapped.assumed_model
    base = make(description.base, env, **options)
    signals = learned_signals(model, description.learning)
    policy = LearnedOffsets(base, model, signals, PolicyOptions().ramp_s)
    policy.play(table[None])
    return policy


def _require_effect(name: str, env: Any, given: Any, usable: tuple[str, ...]) -> None:
    """Refuse options that do not exist, or have no effect on a policy."""
    takes = f"its options are: {', '.join(usable)}" if usable else "it has no options"
    for option in given:
        if option not in usable:
            task = env.unwrapped.task.name
            if option not in PolicyOptions.model_fields:
                names = usable or PolicyOptions.model_fields
                raise unknown_name(f"option of {name!r} on the {task}", option, names)
            # of the policies with options only the oracle assumes no stiffness
            is_true = bool(usable) and option in ASSUMED_OPTIONS
            why = f"{option} but knows the true one" if is_true else option
            raise ConfigurationError(
                f"the policy {name!r} of the {task} does not use {why}; {takes}"
            )


def _assumed_model(env: Any, options: PolicyOptions) -> RobotModel:
    model: RobotModel = env.unwrapped.assumed_model
    if options.stiffness is not None:
        model = model.with_stiffness(read_stiffness(options.stiffness))
    return model.with_stiffness(options.stiffness_scale * model.stiffness)
