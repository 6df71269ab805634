"""Search for the largest gravity torque of a robot."""

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.rigid.rigid_body import RigidBody

_POSES = 500
"""Random poses of the search for the largest gravity torque."""
_TRIES = 33
"""Angles that the search tries for each joint of the best of them."""


def largest_gravity_torque(body: RigidBody, lowest: Array, highest: Array) -> Array:
    """Largest gravity torques over the joint ranges, at most a turn wide, (n,) [N·m].

    Args:
        body: The robot.
        lowest: Lower ends of the joint ranges, infinite without one, (n,) [rad].
        highest: Upper ends, likewise.
    """
    lowest = np.where(np.isfinite(lowest), lowest, -np.pi)
    highest = np.where(np.isfinite(highest), highest, np.pi)
    poses = np.random.default_rng(0).uniform(lowest, highest, (_POSES, len(lowest)))
    torque = np.abs(body.gravity_torque(poses))
    largest = torque.max(axis=0)
    for joint, pose in enumerate(poses[torque.argmax(axis=0)]):
        for i in range(len(pose)):  # coordinate ascent
            candidates = np.repeat(pose[None], _TRIES, axis=0)
            candidates[:, i] = np.linspace(lowest[i], highest[i], _TRIES)
            torques = np.abs(body.gravity_torque(candidates)[:, joint])
            if torques.max() > largest[joint]:
                largest[joint] = torques.max()
                pose = candidates[torques.argmax()]
    return largest
