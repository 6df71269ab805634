"""Marks of a paired change: how far training has seen the conditions that it is measured in."""

from collections.abc import Sequence
from typing import Any

from elastic_env.world.scenario import make_scenario
from train.evaluate.change_text import CEILING, HELD_OUT, PARTLY, SAME_ROBOT
from train.evaluate.conditions import Condition
from train.evaluate.environments import Environment
from train.evaluate.residual_seeds import Origin


def training_marks(origin: Origin | None, conditions: Sequence[Condition]) -> tuple[str, ...]:
    """Return the marks of a row: how far training has seen its conditions.

    Args:
        origin: Training of the residual; None for a baseline, which has no marks.
        conditions: Of the row, which share motion and swept values.
    """
    if origin is None:
        return ()
    if origin.scenarios is None:
        return ("training condition unknown",)
    environment = conditions[0].environment
    motion: Any = origin.reference
    if motion is None:
        motion = environment.default_reference
    played_motion = _motion_label(environment, conditions[0].reference)
    motion_is_known = _motion_label(environment, motion) == played_motion
    quantity = environment.quantity or "reference"
    scenarios = [_training_name(condition, origin) for condition in conditions]
    unseen = [scenario for scenario in scenarios if scenario not in origin.scenarios]
    if unseen:
        if len(unseen) == len(scenarios):
            return (HELD_OUT if motion_is_known else f"{HELD_OUT} scenario and {quantity}",)
        names = f": {', '.join(unseen)}"
        return (f"{PARTLY}{names}" if motion_is_known else f"{HELD_OUT}{names} and {quantity}",)
    if not motion_is_known:
        return (f"{HELD_OUT} {quantity}",)
    if conditions[0].swept:
        return ()
    if any(environment.is_deterministic(scenario, motion) for scenario in scenarios):
        return (CEILING,)
    same = [s for s in scenarios if environment.differs_by_noise_alone(s, motion)]
    names = f": {', '.join(same)}" if len(same) < len(scenarios) else ""
    return (f"{SAME_ROBOT}{names}",) if same else ()


def _training_name(condition: Condition, origin: Origin) -> str:
    """Return the name under which training has seen the scenario of a condition."""
    played = condition.scenario_played
    trained_names = origin.scenarios or ()
    if isinstance(played, str) and not origin.ranges:
        return played
    walks = condition.environment.walks
    played = make_scenario(played, walks).replace(name="")
    for name in trained_names:
        if make_scenario(name, walks, origin.ranges).replace(name="") == played:
            return name
    if condition.swept:
        return f"varied {condition.scenario}"
    is_other = condition.scenario in trained_names
    return f"{condition.scenario} of other ranges" if is_other else condition.scenario


def _motion_label(environment: Environment, reference: Any) -> str:
    """Label of the kind of a reference, or of its step period alone, whatever its other keys."""
    return environment.label(environment.arguments(reference)[environment.motion])
