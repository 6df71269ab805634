"""Pelvis error and ZMP deviation over a step of the walk at 3 s, without and with compensation.

`python -m docs.pages.step [CHECKOUT]` writes docs/results/step.csv, and `python -m docs.pages`
draws it.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
from rich.console import Console

from docs.pages.step_picture import CHARTS, WITH, WITHOUT
from train.commands.play import episode
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.rollout import make_policy
from train.runs.escaping import write_records

BEGIN_S = 4.0
END_S = 7.0
EVERY = 5
"""The second step, and every how many control steps a row is written."""


def rows(console: Console) -> list[dict[str, Any]]:
    """Both policies side by side, a row per time."""
    found: dict[float, dict[str, Any]] = {}
    for policy in (WITHOUT, WITH):
        condition = Condition(env="walker", policy=PolicySpec(name=policy), reference=3)
        env: Any = gymnasium.make(condition.environment.id, **condition.arguments)
        period = env.unwrapped.task.assumed_model.control_period_s
        share = env.unwrapped.task.plan.share
        for step, info in episode(
            env, make_policy(condition.policy, env), condition, round(END_S / period), console
        ):
            time_s = (step + 1) * period
            if time_s >= BEGIN_S and (step + 1) % EVERY == 0:
                row = found.setdefault(time_s, {"time_s": f"{time_s - BEGIN_S:.2f}"})
                row["single_support"] = int(share[step + 1] in (0.0, 1.0))
                row |= {
                    f"{policy}_{c.signal}": f"{float(info[c.signal.rpartition('_')[0]]):.4g}"
                    for c in CHARTS
                }
        env.close()
    return list(found.values())


def main(arguments: Sequence[str]) -> None:
    """Write the table: [CHECKOUT], by default the working directory."""
    print(
        "wrote"
        f" {write_records(rows(Console()), Path(*arguments) / 'docs' / 'results' / 'step.csv')}"
    )


if __name__ == "__main__":
    main(sys.argv[1:])
