r"""Refined walk: the policy walks a plan of its own, whose ZMP is nearer to the reference.

The plan that the environment shows puts the center of mass of a cart-table under the reference p of
the ZMP. Legs that swing move the ZMP of the whole robot off it, which inverse dynamics tells. That
error passes the preview control once more [Kajita2003], and gives a plan with other joint angles
(`elastic_env.motion.walk_plan.refine_plan`),

.. math:: q_{ref}' = q_{ref} + \Delta q

The policy inside knows the refined plan alone: it sees q_ref' and its derivatives where the
observation has q_ref, and the action is Δq + a, with its own action a.

[Kajita2003] S. Kajita et al., "Biped Walking Pattern Generation by using Preview Control of
Zero-Moment Point", ICRA.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from typing_extensions import override

from baselines.compensation.policy import PassingMemory, PolicyInputs, Step
from elastic_env.core.signals import Array
from elastic_env.motion.walk_plan import refine_plan
from elastic_env.world.robot_model import WalkerModel


def refined(model: WalkerModel) -> WalkerModel:
    """The assumed walker with its plan refined.

    Raises:
        ElasticError: A foot is out of reach on the refined plan.
    """
    plan = refine_plan(model.plan, model.biped, model.control_period_s)
    return replace(model, plan=plan)


class RefinedWalk(PassingMemory):
    """A policy for the refined plan of a walker, on the plan that the environment shows.

    Args:
        policy: What commands the robot along the refined plan.
        model: Assumed walker, with the plan of the environment.
        further: The same with the plan that the policy knows.
    """

    def __init__(self, policy: Any, model: WalkerModel, further: WalkerModel) -> None:
        super().__init__(policy, model)
        table = model.observation_table
        # angles, rates and accelerations stand side by side
        first = table.group("reference_angle").start
        self._columns = slice(first, table.group("reference_acceleration").stop)
        motions = [np.hstack([p.q, p.q_dot, p.q_ddot]) for p in (model.plan, further.plan)]
        self._change = motions[1] - motions[0]

    @override
    def act(self, rows: Array, memory: Any, inputs: PolicyInputs) -> Step:
        """Its memory is that of the policy inside."""
        row = self.view.plan_row(rows)
        change = self._change.take(row, axis=0, mode="clip")
        seen = rows.copy()
        seen[:, self._columns] += change
        action, memory = self.policy.act(seen, memory, inputs)
        total = action + change[:, : self.view.num_joints]
        return total.astype(np.float32), memory
