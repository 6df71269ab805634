"""The baselines by name.

Compensation is a wrapper: `Compensated(policy, compensator)` adds the input compensation to whatever a policy commands
and shows it compensated encoder readings. The named policies are such compositions.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from baselines.compensated import Compensated
from baselines.compensators import DynamicCompensator, GravityCompensator, OutputMethod
from baselines.gravity_torque import GravityMethod
from baselines.oracle import Oracle
from baselines.policy import Policy, Zero
from elastic_env.config import Model, quantity
from elastic_env.errors import ConfigurationError, unknown_name
from elastic_env.plan import STAND_S
from elastic_env.robots.robot_model import RobotModel, read_stiffness


class PolicyOptions(Model):
    """Options of the named policies, as keyword arguments of `make`."""

    stiffness: Any = None
    """K that the compensator assumes: a number, a list of one per joint [N·m/rad], or the path of an identification;
    None for the environment's assumed model."""
    output: OutputMethod = "taylor"
    """Output compensator: "taylor" for Eq. 12, "newton" for Eq. 10."""
    gravity: GravityMethod = "pinocchio"
    """How τ_g is computed: "pinocchio" row by row, or "batched" in NumPy."""
    ramp_s: float = quantity("s", STAND_S, gt=0, description="time in which the compensation grows from zero")


def _zero(env: Any, options: PolicyOptions) -> Policy:  # noqa: ARG001  one signature for all
    return Zero(env.unwrapped.task.observation_table)


def _compensated(compensator: type[GravityCompensator] | type[DynamicCompensator]) -> Callable[..., Policy]:
    def build(env: Any, options: PolicyOptions) -> Policy:
        model, table = _assumed(env, options), env.unwrapped.task.observation_table
        return Compensated(Zero(table), compensator(model, options.output, options.gravity), ramp_s=options.ramp_s)

    return build


def _oracle(env: Any, options: PolicyOptions) -> Policy:
    if options.stiffness is not None:
        raise ConfigurationError(
            f"the oracle knows the true stiffness, got stiffness={options.stiffness!r}; leave it out"
        )
    return Oracle(env, options.ramp_s)


POLICIES: dict[str, Callable[[Any, PolicyOptions], Policy]] = {
    "zero": _zero,
    "uncompensated": _zero,
    "input": _compensated(GravityCompensator),
    "dynamic": _compensated(DynamicCompensator),
    "oracle": _oracle,
}
"""Named policies of the testbed; there `uncompensated` has no controller to add and equals `zero`."""


def policy_names() -> list[str]:
    """Names that `make` accepts."""
    return list(POLICIES)


def make(name: str, env: Any, **options: Any) -> Policy:
    """A named baseline for an environment.

    | name | what it does on the testbed |
    |---|---|
    | `zero`, `uncompensated` | plays the reference back |
    | `input` | Eq. 9 on the command, Eq. 12 (or Newton) on the encoder |
    | `dynamic` | deflection from the full joint torque, with D, B and the servo inverted |
    | `oracle` | true parameters, integral action on the true link error |

    Args:
        name: As in the table.
        env: The environment, scalar or vector, wrapped or not; it provides the assumed model.
        **options: Parameters of `PolicyOptions`: stiffness, output, gravity, ramp_s.

    Returns:
        An object with `predict`, usable on scalar and vector environments and in SB3's `evaluate_policy`.

    Raises:
        ConfigurationError: Unknown name or option, or an environment that is not ours.
    """
    if name not in POLICIES:
        raise unknown_name("policy", name, POLICIES)
    if not hasattr(env.unwrapped, "assumed_model"):
        raise ConfigurationError(
            f"a baseline needs an environment with an assumed model, got {type(env.unwrapped).__name__}; make one with "
            'gymnasium.make("elastic_env/Testbed-v0") and pass it here, also if the policy is to run on a wrapper of it'
        )
    return POLICIES[name](env, PolicyOptions(**options))


def _assumed(env: Any, options: PolicyOptions) -> RobotModel:
    model: RobotModel = env.unwrapped.assumed_model
    if options.stiffness is None:
        return model
    given = options.stiffness
    return model.with_stiffness(read_stiffness(given) if isinstance(given, int | float | str | Path) else given)
