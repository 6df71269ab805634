"""Pose of the end effector of a tree of hinges, for a batch of postures at once."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from mujoco import MjModel

from elastic_env.core.compiled import compile_now
from elastic_env.core.errors import ConfigurationError, require_known
from elastic_env.core.quaternions import matrix_of
from elastic_env.core.signals import Array
from elastic_env.rigid.tree import kernels
from elastic_env.rigid.tree.links import Held, Tree


class EndEffector:
    """Position and orientation of a site or body, on (..., n) joint angles.

    Args:
        model: Compiled rigid model on a fixed base.
        joints: Hinges that move, in the order of the last axis.
        name: Name of a site, or else of a body.
        held: Position of every other joint, a hinge [rad] or a slide [m].

    Raises:
        ConfigurationError: There is no such site or body, or no joint moves it.
    """

    def __init__(
        self, model: MjModel, joints: Sequence[str], name: str, held: Held | None = None
    ) -> None:
        self.body, self.place, R = site_or_body(model, name, "site or body for end_effector")
        tree = Tree.of(model, joints, held or {})
        self._chain = _chain(tree, self.body)
        if len(self._chain) < 2:
            raise ConfigurationError(
                f"end_effector {name!r} is on {model.body(self.body).name!r}, which no joint moves"
            )
        R_lb = tree.R[self.body]
        self._chain[-1]["R"] = R_lb @ R
        self._chain[-1]["anchor"] = tree.place[self.body] + R_lb @ self.place
        self._n = len(joints)
        compile_now(self.pose, np.zeros((1, self._n)))

    def pose(self, q: Array) -> tuple[Array, Array]:
        """Position (..., 3) [m] and orientation (..., 3, 3) in the world, from (..., n) [rad]."""
        position, R, *_ = self._chain_poses(q)
        return position.reshape(*q.shape[:-1], 3), R.reshape(*q.shape[:-1], 3, 3)

    def jacobian(self, q: Array) -> tuple[Array, Array]:
        """Derivative of position and turn in the world's axes, (..., 3, n) each [m/rad], [1]."""
        position, _, axes, anchors = self._chain_poses(q)
        J_position, J_rotation = np.zeros((2, len(position), 3, self._n))
        columns = self._chain["column"][:-1]
        levers = position[:, None] - anchors
        J_position[:, :, columns] = np.cross(axes, levers).swapaxes(1, 2)
        J_rotation[:, :, columns] = axes.swapaxes(1, 2)
        shape = (*q.shape[:-1], 3, self._n)
        return J_position.reshape(shape), J_rotation.reshape(shape)

    def errors(self, q_ref: Array, q: Array) -> tuple[Array, Array]:
        """Distance (...) [m] and angle (...) [rad] between the poses of reference and joints."""
        position_ref, R_ref = self.pose(q_ref)
        position, R = self.pose(q)
        # for small angles the sine of the half angle is exact, the cosine is not
        half = np.linalg.norm(R - R_ref, axis=(-2, -1)) / math.sqrt(8.0)
        angle = 2.0 * np.arcsin(np.minimum(half, 1.0))
        return np.linalg.norm(position - position_ref, axis=-1), angle

    def parts(self, q_ref: Array, q: Array) -> Array:
        r"""Error of the position by the deviation of each joint alone, to first order.

        .. math:: p(q) - p(q_{ref}) \approx \sum_j J_j(q_{ref}) (q_j - q_{ref,j})

        Args:
            q_ref: Reference angles, (..., n) [rad].
            q: Actual angles, (..., n) [rad].

        Returns:
            A term of the sum per joint, in the world's axes, (..., 3, n) [m].
        """
        return self.jacobian(q_ref)[0] * (q - q_ref)[..., None, :]

    def _chain_poses(self, q: Array) -> tuple[Array, ...]:
        """Pose of the end effector; axis and anchor of each hinge before it, a row per posture."""
        rows = np.ascontiguousarray(q, dtype=np.float64).reshape(-1, self._n)
        count = len(rows)
        hinges = len(self._chain) - 1
        shapes = ((3,), (3, 3), (hinges, 3), (hinges, 3))
        outputs = tuple(np.empty((count, *shape)) for shape in shapes)
        kernels.chain_poses(self._chain, rows, *outputs)
        return outputs


def outermost_body(model: MjModel) -> str:
    """Return the named body that is farthest from the base in the tree; the last of several.

    Bodies that no joint moves do not count.

    Raises:
        ConfigurationError: No body that a joint moves has a name.
    """
    depth = np.zeros(model.nbody, dtype=np.int64)
    moves = model.body_jntnum > 0
    for body in range(1, model.nbody):
        depth[body] = depth[model.body_parentid[body]] + 1
        moves[body] |= moves[model.body_parentid[body]]
    named = [body for body in np.flatnonzero(moves) if model.body(body).name]
    if not named:
        cure = "give one to the body that is the end effector"
        raise ConfigurationError(f"no body that the joints move has a name; {cure}")
    return str(model.body(max(named, key=lambda body: (depth[body], body))).name)


def site_or_body(model: MjModel, name: str, kind: str = "site or body") -> tuple[int, Array, Array]:
    """Return the body of a site or body, and place (3,) [m] and orientation (3, 3) in that body.

    Args:
        model: Compiled model.
        name: Name of the site, or else of the body.
        kind: Kind of thing that the name should refer to, for the error.

    Raises:
        ConfigurationError: There is none of that name.
    """
    sites = [model.site(i).name for i in range(model.nsite)]
    bodies = [model.body(i).name for i in range(1, model.nbody)]
    require_known(kind, [name], list(filter(None, (*sites, *bodies))))
    if name not in sites:
        return int(model.body(name).id), np.zeros(3), np.eye(3)
    site = model.site(name)
    return int(site.bodyid[0]), site.pos.copy(), matrix_of(site.quat)


def _chain(tree: Tree, body: int) -> Any:
    """Return the links from the base to the link of a body, and one more for its end effector."""
    path = []
    link = tree.carrier[body]
    while link > 0:
        path.insert(0, link)
        link = int(tree.links[link]["parent"])
    return np.concatenate([tree.links[path], np.zeros(1, kernels.LINK)])
