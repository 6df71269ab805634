"""Dry friction that changes with load and speed, in MuJoCo.

MuJoCo's `frictionloss` of a joint is one number. Friction that grows with the load, or falls from
rest to motion, has to be set before every physics step. `make_elastic` stores the parameters in the
model, as numbers named `<joint>_dry_friction`. The environments of this project set the friction
from them. A program with its own loop does so in one line:

    friction = VaryingFriction(model)
    while running:
        friction.update(model, data)
        mujoco.mj_step(model, data)

Load and speed are those at the beginning of the step: friction lags by one physics step.
"""

from collections.abc import Callable
from typing import Self

import mujoco
import numpy as np

from elastic_env.core.signals import Array
from elastic_env.joint.elasticity import ElasticJoint, joint_torque
from elastic_env.joint.friction import dry_friction
from elastic_env.joint.joint_names import JointAddresses, friction_name, spring_name

_TERMS = 4
_Fields = Callable[[str], Array]


def varies(joint: ElasticJoint) -> bool:
    """Return True if a joint's dry friction changes with its load or speed."""
    return joint.load_friction > 0.0 or joint.static_friction > 0.0


def add_terms(spec: mujoco.MjSpec, hinge: mujoco.MjsJoint, joint: ElasticJoint) -> None:
    """Store the friction of a joint in the specification of an elastic model.

    Args:
        spec: Specification of the model, which is changed.
        hinge: Hinge of the link; its `frictionloss` is the constant term.
        joint: Joint with the other terms.
    """
    varying = (joint.load_friction, joint.static_friction, joint.stribeck_speed)
    terms = [hinge.frictionloss, *varying]
    spec.add_numeric(name=friction_name(hinge.name), size=_TERMS, data=terms)


class VaryingFriction:
    """Friction of the joints of an elastic model whose friction varies.

    Args:
        model: Model of `make_elastic`, compiled.

    Attributes:
        joints: Names of these joints; empty where no friction varies.
        links: Their degrees of freedom, (n,).
        numbers: Places of F₀, c, F_s and ω_s in `numeric_data`, (4, n).
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        names = {model.numeric(i).name for i in range(model.nnumeric)}
        hinges = [model.joint(j).name for j in range(model.njnt)]
        self.joints = [name for name in hinges if friction_name(name) in names]
        at = JointAddresses.of(model, self.joints)
        self.links = at.q_dot
        numerics = [model.numeric(friction_name(name)).id for name in self.joints]
        first = model.numeric_adr[numerics].astype(np.int64)
        self.numbers = first + np.arange(_TERMS)[:, None]
        has_spring = at.theta != at.q
        self._elastic = np.flatnonzero(has_spring)
        self._rigid = np.flatnonzero(~has_spring)
        springs = [model.tendon(spring_name(self.joints[i])).id for i in self._elastic]
        self._springs = np.array(springs, dtype=np.int64)
        self._at = at

    @classmethod
    def of(cls, model: mujoco.MjModel) -> Self | None:
        """Return the varying friction of a model; None where no friction varies."""
        if model.nnumeric == 0:
            return None
        friction = cls(model)
        return friction if friction.joints else None

    def update(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Set the friction for the coming physics step of one world.

        Args:
            model: Model whose `dof_frictionloss` is set.
            data: Its state.
        """
        limits = self.limits(lambda name: getattr(model, name)[None], _rows_of(data))
        model.dof_frictionloss[self.links] = limits[0]

    def limits(self, field: _Fields, state: _Fields) -> Array:
        """Return the friction F of worlds in their states, (num_worlds, n) [N·m].

        Args:
            field: Returns the rows of a named field of the models, one for each world or for all.
            state: Returns the rows of a named field of the states.
        """
        terms = field("numeric_data")[:, self.numbers]
        return dry_friction(
            speed=state("qvel")[:, self.links],
            load=self._load(field, state),
            coulomb=terms[:, 0],
            load_ratio=terms[:, 1],
            static=terms[:, 2],
            stribeck_speed=terms[:, 3],
        )

    def _load(self, field: _Fields, state: _Fields) -> Array:
        """τ_J, (num_worlds, n) [N·m].

        A joint without a spring passes the torque of its actuators, less that of its rotor's
        acceleration in the last physics step.
        """
        at = self._at
        qpos = state("qpos")
        qvel = state("qvel")
        load = np.zeros((len(qpos), len(self.joints)))
        if len(elastic := self._elastic):
            ends = field("tendon_lengthspring")[:, self._springs]
            load[:, elastic] = joint_torque(
                qpos[:, at.theta[elastic]] - qpos[:, at.q[elastic]],
                qvel[:, at.theta_dot[elastic]] - qvel[:, at.q_dot[elastic]],
                stiffness=field("tendon_stiffness")[:, self._springs],
                damping=field("tendon_damping")[:, self._springs],
                backlash=ends[..., 1] - ends[..., 0],
            )
        if len(rigid := self._rigid):
            links = self.links[rigid]
            rotor = field("dof_armature")[:, links] * state("qacc")[:, links]
            load[:, rigid] = state("qfrc_actuator")[:, links] - rotor
        return load


def _rows_of(data: mujoco.MjData) -> _Fields:
    return lambda name: getattr(data, name)[None]
