"""Choice of the hinges that are commanded: all but the fingers that a model couples."""

import warnings
from collections.abc import Collection, Iterable
from functools import partial

import mujoco
from mujoco import MjModel

from elastic_env.joint import affected_joints, model_joints
from elastic_env.joint.supported_models import require_robot


def commanded_hinges(model: MjModel, named: Collection[str] = ()) -> list[str]:
    """Return the hinges that are commanded by default: all but fingers that the model couples.

    Args:
        model: Compiled rigid model.
        named: Joints that the user names, which are commanded in any case.

    Raises:
        ConfigurationError: See `require_robot`; or a hinge has no name.

    Warns:
        UserWarning: Fingers are held.
    """
    require_robot(model)
    if model_joints.has_nameless_hinge(model):
        raise model_joints.nameless_hinge()
    return without_fingers(model, model_joints.hinges_of(model), named)


def without_fingers(model: MjModel, joints: Iterable[str], named: Collection[str]) -> list[str]:
    """Return the joints without the fingers that the model couples and that no user names.

    Arguments as in `commanded_hinges`.
    """
    joints = list(joints)
    coupled = [name for name in coupled_fingers(model) if name not in named]
    fingers = [name for name in coupled if name in joints]
    if fingers:
        reason = "are coupled in the model (mimic), and are held, unlike all others"
        warnings.warn(f"{model_joints.first_names(fingers)} {reason}", stacklevel=5)
    return [name for name in joints if name not in fingers]


def coupled_fingers(model: MjModel) -> list[str]:
    """Return the hinges of fingers: coupled by equalities, side by side at the end of the arm.

    Two fingers are on different branches, and carry no other joint. Loops may close within them.
    Coupled joints within the arm are no fingers. Neither are loops without coupled joints, such as
    a parallelogram.
    """
    groups: list[set[int]] = []
    coupled: set[int] = set()
    for e in affected_joints.active_equalities(model):
        affected, _ = affected_joints.equality_joints(model, e)
        if len(affected) > 1:
            joined = [group for group in groups if group & affected]
            apart = [group for group in groups if not group & affected]
            groups = [*apart, affected.union(*joined)]
        if len(affected) > 1 and model.eq_type[e] == mujoco.mjtEq.mjEQ_JOINT:
            coupled |= affected
    hands = [group for group in groups if group & coupled and _is_gripper(model, group)]
    fingers = set().union(*hands)
    names = [model.joint(j).name for j in model_joints.hinge_ids(model) if j in fingers]
    return [name for name in names if name]


def _is_gripper(model: MjModel, group: set[int]) -> bool:
    """Return True if coupled joints are fingers: on several branches, with no joint beyond them."""
    body_of = model.jnt_bodyid.tolist()
    parent_of = model.body_parentid.tolist()
    chain = partial(affected_joints.joints_to_world, model)
    carried = {j for j in range(model.njnt) if chain(body_of[j]) & group}
    bodies = {body_of[j] for j in group}
    first = [body for body in bodies if not chain(parent_of[body]) & group]
    return carried <= group and len(first) > 1 and len(group) < model.njnt
