"""The baselines by name.

Compensation is a wrapper: `Compensated(policy, compensator)` adds the input compensation to whatever a policy commands
and shows it compensated encoder readings. The named policies are such compositions.
"""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from baselines.compensation.compensated import Compensated
from baselines.compensation.compensators import DynamicCompensator, GravityCompensator, OutputMethod
from baselines.compensation.gravity_torque import GravityMethod
from baselines.compensation.oracle import Oracle
from baselines.compensation.policy import Policy, Zero
from baselines.residual.residual import RESIDUAL, read_description, residual_policy
from baselines.walking.controller import WalkingController, WalkingGains
from elastic_env.core.config import Model, quantity
from elastic_env.core.errors import ConfigurationError, unknown_name
from elastic_env.motion.trajectory import STAND_S
from elastic_env.runtime.robot_model import RobotModel, WalkerModel, read_stiffness


class PolicyOptions(Model):
    """Options of the named policies, as keyword arguments of `make`."""

    stiffness: Any = None
    """K that the compensator assumes: a number, a list of one per joint [N·m/rad], or the path of an identification;
    None for the environment's assumed model."""
    stiffness_scale: float = quantity("1", 1.0, gt=0, description="further factor on the K that is assumed")
    output: OutputMethod | None = None
    """Output compensator: "taylor" for Eq. 12, "newton" for Eq. 10, on the walker also "wrench" and "none"; None for
    what the policy's name says."""
    gravity: GravityMethod | None = None
    """How τ_g is computed: on the testbed "hinge", "pinocchio" or "batched", on the walker "com", "ankle" or "lumped";
    None for the first of them."""
    com_feedback: bool = True
    """Walker: whether the controller feeds the center of mass back."""
    gains: WalkingGains = WalkingGains()
    """Walker: gains of the controller."""
    ramp_s: float = quantity("s", STAND_S, gt=0, description="time in which the compensation grows from zero")


Builder = Callable[[Any, RobotModel, PolicyOptions], Policy]
Compensating = type[GravityCompensator] | type[DynamicCompensator]


def _zero(env: Any, model: RobotModel, options: PolicyOptions) -> Policy:  # noqa: ARG001  one signature for all
    return Zero(model.observation_table)


def _around_zero(compensator: Compensating) -> Builder:
    def build(env: Any, model: RobotModel, options: PolicyOptions) -> Policy:
        made = compensator(model, options.output or "taylor", options.gravity)
        return Compensated(_zero(env, model, options), made, ramp_s=options.ramp_s)

    return build


def _controller(env: Any, model: RobotModel, options: PolicyOptions) -> Policy:  # noqa: ARG001
    return WalkingController(model, options.com_feedback, options.gains, options.ramp_s)  # type: ignore[arg-type]


def _around_controller(compensator: Compensating, output: OutputMethod) -> Builder:
    def build(env: Any, model: RobotModel, options: PolicyOptions) -> Policy:
        made = compensator(model, options.output or output, options.gravity)
        return Compensated(_controller(env, model, options), made, ramp_s=options.ramp_s)

    return build


def _open(build: Builder) -> Builder:
    return lambda env, model, options: build(env, model, options.replace(com_feedback=False))


def _oracle(env: Any, model: RobotModel, options: PolicyOptions) -> Policy:
    if not hasattr(env.unwrapped, "truth"):
        raise ConfigurationError(
            "the oracle reads the truth, by a method truth() of the environment, which "
            f"{type(env.unwrapped).__name__} does not have"
        )
    if isinstance(model, WalkerModel):
        controller = _controller(env, env.unwrapped.truth().model, options)
        return Oracle(env, controller, options.ramp_s, friction=False, integral_gain=0.0)
    return Oracle(env, _zero(env, model, options), options.ramp_s)


_ASSUMED = ("stiffness", "stiffness_scale")
_COMPENSATOR = (*_ASSUMED, "output", "gravity", "ramp_s")
_CONTROLLER = ("gains", "com_feedback")

_ON_THE_TESTBED: dict[str, tuple[Builder, tuple[str, ...]]] = {
    "zero": (_zero, ()),
    "uncompensated": (_zero, ()),
    "input": (_around_zero(GravityCompensator), _COMPENSATOR),
    "dynamic": (_around_zero(DynamicCompensator), _COMPENSATOR),
    "oracle": (_oracle, ("ramp_s",)),
}
"""How each is built, and its options. On the testbed `uncompensated` has no controller to add and equals `zero`."""

_ON_THE_WALKER: dict[str, tuple[Builder, tuple[str, ...]]] = {
    "zero": (_zero, ()),
    "uncompensated_open": (_open(_controller), (*_ASSUMED, "gains", "ramp_s")),
    "uncompensated": (_controller, (*_ASSUMED, *_CONTROLLER, "ramp_s")),
    "input_open": (_open(_around_controller(GravityCompensator, "none")), (*_COMPENSATOR, "gains")),
    "input": (_around_controller(GravityCompensator, "none"), (*_COMPENSATOR, *_CONTROLLER)),
    "input_output": (_around_controller(GravityCompensator, "taylor"), (*_COMPENSATOR, *_CONTROLLER)),
    "input_wrench": (_around_controller(GravityCompensator, "wrench"), (*_COMPENSATOR, *_CONTROLLER)),
    "dynamic": (_around_controller(DynamicCompensator, "wrench"), (*_COMPENSATOR, *_CONTROLLER)),
    "oracle": (_oracle, (*_CONTROLLER, "ramp_s")),
}
"""The same. The controller alone assumes K too, for the ankles' offsets and the friction."""


def policy_names() -> list[str]:
    """Names that `make` accepts."""
    return list(_ON_THE_WALKER | _ON_THE_TESTBED)


def make(name: str, env: Any, /, **options: Any) -> Policy:
    """A named baseline for an environment.

    | name | on the testbed | on the walker |
    |---|---|---|
    | `zero` | plays the reference back | the same |
    | `uncompensated` | the same | walking controller alone, which takes motors for links |
    | `input` | Eq. 9 on the command, Eq. 12 (or Newton) on the encoder | Eq. 9 around the controller |
    | `input_output` | - | also Eq. 12: the controller sees the estimated links |
    | `input_wrench` | - | the estimate takes the measured foot wrenches instead of the planned load share |
    | `dynamic` | deflection from the full joint torque, D, B and servo inverted | the same, estimate as before |
    | `oracle` | true parameters, integral action on the true link error | true parameters, true links |
    | `uncompensated_open`, `input_open` | - | without feedback of the center of mass |
    | `residual:PATH` | a trained residual from its folder, or by the name of a shipped one | the same |

    Args:
        name: As in the table.
        env: The environment, scalar or vector, wrapped or not; it provides the assumed model.
        **options: Parameters of `PolicyOptions`, such as stiffness, output, gravity, com_feedback, gains, those that
            have an effect on this policy in this environment; None is as if it were not given.

    Returns:
        An object with `predict`, usable on scalar and vector environments and in SB3's `evaluate_policy`.

    Raises:
        ConfigurationError: Unknown name or option, one without effect, or an environment that is not ours.
    """
    if name.startswith(RESIDUAL):
        return _residual(Path(name.removeprefix(RESIDUAL)), env, options)
    if not hasattr(env.unwrapped, "assumed_model"):
        raise ConfigurationError(
            f"a baseline needs an environment with an assumed model, got {type(env.unwrapped).__name__}; make one with "
            'gymnasium.make("elastic_env/Testbed-v0") and pass it here, also if the policy is to run on a wrapper of it'
        )
    given = {option: value for option, value in options.items() if value is not None}
    chosen = PolicyOptions(**given)
    known = _ON_THE_WALKER if isinstance(env.unwrapped.assumed_model, WalkerModel) else _ON_THE_TESTBED
    if name not in known:
        raise unknown_name(f"policy of the {env.unwrapped.task.name}", name, [*known, f"{RESIDUAL}PATH"])
    build, usable = known[name]
    _require_effect(name, env, given, usable)
    return build(env, _assumed(env, chosen), chosen)


def _residual(folder: Path, env: Any, options: dict[str, Any]) -> Policy:
    """A trained residual around its base, whose options may be given anew."""
    description = read_description(folder)
    task = env.unwrapped.task.name
    if description.robot != task:
        raise ConfigurationError(f"{folder} is a residual for the {description.robot}, the environment is the {task}")
    base = make(description.base, env, **{**description.base_options, **options})
    return residual_policy(folder, base, env.unwrapped.assumed_model)


def _require_effect(name: str, env: Any, given: Iterable[str], usable: Sequence[str]) -> None:
    for option in given:
        if option not in usable:
            takes = f"its options are: {', '.join(usable)}" if usable else "it has no options"
            # of those with options the oracle alone assumes no stiffness
            why = " but knows the true one" if option in _ASSUMED and usable else ""
            task = env.unwrapped.task.name
            raise ConfigurationError(f"the policy {name!r} of the {task} does not use {option}{why}; {takes}")


def _assumed(env: Any, options: PolicyOptions) -> RobotModel:
    model: RobotModel = env.unwrapped.assumed_model
    if options.stiffness is not None:
        model = model.with_stiffness(read_stiffness(options.stiffness))
    return model if options.stiffness_scale == 1.0 else model.with_stiffness(options.stiffness_scale * model.stiffness)
