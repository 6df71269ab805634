r"""Refined walk: the policy walks a plan of its own, whose ZMP is nearer to the reference.

The plan of the environment puts the center of mass of a cart-table under the reference p of the
ZMP. Swinging legs move the ZMP of the whole robot away from p, as inverse dynamics show. This error
passes the preview control once more [Kajita2003], and gives a plan with other joint angles
(`elastic_env.motion.walk_plan.refine_plan`),

.. math:: q_{ref}' = q_{ref} + \Delta q

The policy inside knows the refined plan only: it sees q_ref' and its derivatives instead of q_ref.
The action is Δq + a, with the action a of the policy inside.

[Kajita2003] S. Kajita et al., "Biped Walking Pattern Generation by using Preview Control of
Zero-Moment Point", ICRA.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from typing_extensions import override

from baselines.compensation.policy import PolicyInputs, Step
from baselines.compensation.policy_around import PassingMemory
from elastic_env.core.signals import Array
from elastic_env.motion.walk_plan import refine_plan
from elastic_env.world.robot_model import WalkerModel


def refine_model(model: WalkerModel) -> WalkerModel:
    """The assumed walker with its plan refined.

    Raises:
        ElasticError: A foot is out of reach on the refined plan.
    """
    plan = refine_plan(model.plan, model.biped, model.control_period_s)
    return replace(model, plan=plan)


class RefinedWalk(PassingMemory):
    """A policy for the refined plan of a walker, on the plan of the environment.

    Args:
        policy: Commands the robot along the refined plan.
        model: Assumed walker, with the plan of the environment.
        refined: The same with the plan that the policy knows.
    """

    def __init__(self, policy: Any, model: WalkerModel, refined: WalkerModel) -> None:
        super().__init__(policy, model)
        table = model.observation_table
        # angles, rates and accelerations are adjacent columns
        first = table.group("reference_angle").start
        self._columns = slice(first, table.group("reference_acceleration").stop)
        motions = [np.hstack([p.q, p.q_dot, p.q_ddot]) for p in (model.plan, refined.plan)]
        self._change = motions[1] - motions[0]

    @override
    def act(self, rows: Array, memory: Any, inputs: PolicyInputs) -> Step:
        change = self._change.take(self.view.plan_row(rows), axis=0, mode="clip")
        refined_rows = rows.copy()
        refined_rows[:, self._columns] += change
        action, memory = self.policy.act(refined_rows, memory, inputs)
        return (action + change[:, : self.view.num_joints]).astype(np.float32), memory
