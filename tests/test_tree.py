"""The compiled tree against Pinocchio and MuJoCo, and against its own Python code."""

from typing import Any

import mujoco
import numpy as np
import pinocchio
import pytest

from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array
from elastic_env.rigid.floating_body import pinocchio_model
from elastic_env.rigid.rigid_body import RigidBody
from elastic_env.rigid.tree import kernels
from tests.test_rigid_body import random_tree, shuffled_names


class ByPinocchio:
    """What Pinocchio says of a tree of hinges, row by row, in the order of some joints.

    Args:
        model: Compiled rigid model.
        joints: Order of the columns.
    """

    def __init__(self, model: mujoco.MjModel, joints: list[str]) -> None:
        self._model = pinocchio_model(model)
        self._data = self._model.createData()
        self._at = [self._model.joints[self._model.getJointId(name)].idx_v for name in joints]
        self._zero = model.qpos0[[model.joint(name).qposadr[0] for name in joints]]

    def gravity_torque(self, q: Array) -> Array:
        """(rows, n) [N·m]."""
        compute = pinocchio.computeGeneralizedGravity
        return np.array(
            [compute(self._model, self._data, row)[self._at] for row in self._full(q - self._zero)]
        )

    def gravity_gradient(self, q: Array) -> Array:
        """(rows, n, n) [N·m/rad]."""
        compute = pinocchio.computeGeneralizedGravityDerivatives
        square = np.ix_(self._at, self._at)
        return np.array(
            [compute(self._model, self._data, row)[square] for row in self._full(q - self._zero)]
        )

    def inverse_dynamics(self, q: Array, q_dot: Array, q_ddot: Array) -> Array:
        """(rows, n) [N·m]."""
        motion = zip(self._full(q - self._zero), self._full(q_dot), self._full(q_ddot), strict=True)
        return np.array([pinocchio.rnea(self._model, self._data, *row)[self._at] for row in motion])

    def _full(self, rows: Array) -> Array:
        full = np.empty_like(rows)
        full[:, self._at] = rows
        return full


def motions(model: mujoco.MjModel, rows: int) -> Array:
    """Random angles, rates and accelerations, (3, rows, n)."""
    return np.random.default_rng(5).uniform(-2.0, 2.0, (3, rows, model.nv))


@pytest.mark.parametrize("seed", range(4))
def test_a_tree_is_that_of_pinocchio(seed: int) -> None:
    """Catches a hinge turned the wrong way, a branch hung into another one, and a lost term of
    the dynamics."""
    model = random_tree(seed)
    names, _ = shuffled_names(model, seed)
    mine = RigidBody(model, names)
    reference = ByPinocchio(model, names)
    q, q_dot, q_ddot = motions(model, 30)
    for found, expected in (
        (mine.gravity_torque(q), reference.gravity_torque(q)),
        (mine.gravity_gradient(q), reference.gravity_gradient(q)),
        (mine.inverse_dynamics(q, q_dot, q_ddot), reference.inverse_dynamics(q, q_dot, q_ddot)),
    ):
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("rows", [1, kernels.BLOCK - 1, kernels.BLOCK, 2 * kernels.BLOCK + 5])
def test_a_row_does_not_depend_on_its_block(rows: int) -> None:
    """Catches rows that a block leaves out or that keep what the last one left, and sums in
    another order."""
    model = random_tree(2)
    names, _ = shuffled_names(model, 2)
    body = RigidBody(model, names)
    q, q_dot, q_ddot = motions(model, 2 * kernels.BLOCK + 5)[:, :rows]
    torque = body.gravity_torque(q)
    gradient = body.gravity_gradient(q)
    moved = body.inverse_dynamics(q, q_dot, q_ddot)
    for row in range(rows):
        np.testing.assert_array_equal(torque[row], body.gravity_torque(q[row]))
        np.testing.assert_array_equal(gradient[row], body.gravity_gradient(q[row]))
        np.testing.assert_array_equal(
            moved[row], body.inverse_dynamics(q[row], q_dot[row], q_ddot[row])
        )


def test_compiled_kernels_do_what_their_python_code_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches code that is compiled to something else, and a kernel that Numba alone can run."""
    model = random_tree(3)
    names, _ = shuffled_names(model, 3)
    body = RigidBody(model, names)
    q, q_dot, q_ddot = motions(model, 2)

    def results() -> list[Any]:
        return [
            body.gravity_torque(q),
            body.gravity_gradient(q),
            body.inverse_dynamics(q, q_dot, q_ddot),
        ]

    compiled = results()
    for name, function in vars(kernels).items():
        if hasattr(function, "py_func"):
            monkeypatch.setattr(kernels, name, function.py_func)
    for found, expected in zip(compiled, results(), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-13 * np.abs(expected).max())


def test_views_in_any_layout_are_taken() -> None:
    """Catches columns of an observation, float32 or Fortran order, that are read as if they lay
    in one piece."""
    model = random_tree(1)
    names, _ = shuffled_names(model, 1)
    body = RigidBody(model, names)
    q, q_dot, q_ddot = motions(model, 5)
    wide = np.hstack([q, q])[:, : q.shape[1]]
    np.testing.assert_array_equal(body.gravity_torque(wide), body.gravity_torque(q))
    np.testing.assert_array_equal(
        body.gravity_gradient(np.asfortranarray(q)), body.gravity_gradient(q)
    )
    np.testing.assert_array_equal(
        body.inverse_dynamics(wide, q_dot, q_ddot), body.inverse_dynamics(q, q_dot, q_ddot)
    )


def test_arrays_that_do_not_fit_are_an_error() -> None:
    """Catches compiled code that reads beyond the end of an array."""
    model = random_tree(1)
    body = RigidBody(model, shuffled_names(model, 1)[0])
    q, q_dot, q_ddot = motions(model, 5)
    for compute in (body.gravity_torque, body.gravity_gradient):
        with pytest.raises(
            ElasticError,
            match=rf"\(\.\.\., {model.nv}\), got an array of shape \(5, {model.nv - 1}\)",
        ):
            compute(q[:, 1:])
    with pytest.raises(
        ElasticError, match=rf"one shape, got \(5, {model.nv}\), \(4, {model.nv}\) and"
    ):
        body.inverse_dynamics(q, q_dot[1:], q_ddot)


@pytest.mark.parametrize("seed", range(4))
def test_held_joints_and_a_load_are_those_of_mujoco(seed: int) -> None:
    """Catches a held hinge or slide in the midst of a body's joints, and a load in the frame of
    the wrong link."""
    generator = np.random.default_rng(seed)
    spec = mujoco.MjSpec.from_string(HELD)
    model = spec.compile()
    held = {
        "bent": generator.uniform(-2.0, 2.0),
        "rail": generator.uniform(-0.3, 0.3),
        "grip": 0.05,
    }
    joints = ["wrist", "first", "second"]
    place = generator.uniform(-0.2, 0.2, 3)
    body = RigidBody(model, joints, held)
    body.set_load(model.body("hand").id, 1.3, place)
    loaded = mujoco.MjSpec.from_string(HELD)
    loaded.body("hand").add_body(
        pos=place, ipos=[0.0] * 3, mass=1.3, inertia=[1e-12] * 3, explicitinertial=True
    )
    compiled = loaded.compile()
    data = mujoco.MjData(compiled)
    at = [compiled.joint(name).dofadr[0] for name in joints]
    for q, q_dot, q_ddot in generator.uniform(-2.0, 2.0, (5, 3, 3)):
        for name, position in held.items():
            data.joint(name).qpos = position
        data.qpos[at] = q
        data.qvel[at] = q_dot
        data.qacc[at] = q_ddot
        mujoco.mj_inverse(compiled, data)
        torque = data.qfrc_inverse[at]
        np.testing.assert_allclose(
            body.inverse_dynamics(q, q_dot, q_ddot), torque, rtol=0.0, atol=1e-9
        )
    body.set_load(model.body("hand").id, 0.0, place)
    unloaded = RigidBody(model, joints, held)
    np.testing.assert_array_equal(body.gravity_torque(q), unloaded.gravity_torque(q))


HELD = """<mujoco>
  <option gravity="0.5 1 -9"/>
  <compiler angle="radian"/>
  <worldbody><body name="trunk" pos="0.1 0.2 0.3" euler="0.4 0.1 -0.3">
    <joint name="first" axis="0.2 1 0" pos="0.02 0.01 0.03"/>
    <joint name="bent" axis="1 0 0.4" pos="0.1 0 0.05" ref="0.3"/>
    <joint name="second" axis="0 0.3 1" ref="-0.2"/>
    <inertial mass="3" pos="0.1 0.05 0.2" quat="0.9 0.2 0.1 0.3" diaginertia="0.05 0.04 0.03"/>
    <body pos="0.3 0 0" gravcomp="0.6"><joint name="rail" type="slide" axis="1 1 0" ref="0.1"/>
      <inertial mass="1" pos="0 0.1 0" diaginertia="0.01 0.01 0.01"/>
      <body name="hand" pos="0.2 0.1 0" euler="0.3 0 0.2"><joint name="wrist" axis="1 0 0" pos="0 0.05 0"/>
        <inertial mass="0.7" pos="0.1 0 0.02" diaginertia="0.01 0.02 0.01"/>
        <body><joint name="grip" type="slide" axis="0 1 0"/>
          <inertial mass="0.2" pos="0 0 0.1" diaginertia="0.001 0.001 0.001"/></body>
      </body>
    </body>
  </body></worldbody>
</mujoco>"""
