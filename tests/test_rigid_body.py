"""Robots on a fixed base against MuJoCo, robots on a free base by Pinocchio against it: no two
of them share code."""

import mujoco
import numpy as np
import pytest

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.rigid.floating_body import FloatingBody
from elastic_env.rigid.leg_kinematics import rotation_z
from elastic_env.rigid.rigid_body import RigidBody
from elastic_env.robots.testbed.model import JOINT, Pendulum, rigid_spec

PENDULUM = Pendulum()
BODIES = 6


def random_tree(seed: int, floating: bool = False) -> mujoco.MjModel:
    """A tree with one to three hinges a body, anchors off the origin, references, tilted inertias.

    Args:
        seed: Of its lengths, masses and axes.
        floating: A base with a mass and a free joint, and hinges without references.
    """
    generator = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.gravity = generator.uniform(-5.0, 5.0, 3) - [0.0, 0.0, 8.0]
    bodies = [
        spec.worldbody.add_body(
            name="base", pos=generator.uniform(-1, 1, 3), quat=generator.normal(size=4)
        )
    ]
    if floating:
        bodies[0].add_freejoint(name="free")
        bodies[0].mass = 4.0
        bodies[0].ipos = [0.1, -0.2, 0.3]
        bodies[0].iquat = generator.normal(size=4)
        bodies[0].inertia = [0.4, 0.3, 0.5]
        bodies[0].explicitinertial = True
    for b in range(BODIES):
        parent = bodies[generator.integers(len(bodies))]
        principal = generator.uniform(0.02, 0.03, 3)
        body = parent.add_body(
            name=f"body{b}",
            pos=generator.uniform(-0.5, 0.5, 3),
            quat=generator.normal(size=4),
            mass=generator.uniform(0.5, 3.0),
            ipos=generator.uniform(-0.2, 0.2, 3),
            iquat=generator.normal(size=4),
            inertia=principal,
            explicitinertial=True,
        )
        for j in range(generator.integers(1, 4)):
            body.add_joint(
                name=f"hinge{b}_{j}",
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=generator.normal(size=3),
                pos=generator.uniform(-0.1, 0.1, 3),
                ref=0.0 if floating else generator.uniform(-1.0, 1.0),
            )
        welded = body.add_body(  # a part without joints, as sensors and covers are
            pos=generator.uniform(-0.1, 0.1, 3),
            quat=generator.normal(size=4),
            mass=0.3,
            inertia=[0.001] * 3,
            ipos=generator.uniform(-0.1, 0.1, 3),
            explicitinertial=True,
        )
        bodies += [body, welded]
    return spec.compile()


def shuffled_names(model: mujoco.MjModel, seed: int) -> tuple[list[str], list[int]]:
    """All joints in another order than the model's, and their columns."""
    order = np.random.default_rng(seed).permutation(model.njnt)
    return [model.joint(int(i)).name for i in order], [int(i) for i in order]


def mujoco_bias(model: mujoco.MjModel, q: Array, q_dot: Array) -> Array:
    """Gravity, Coriolis and centrifugal torque by MuJoCo."""
    data = mujoco.MjData(model)
    data.qpos[:] = q
    data.qvel[:] = q_dot
    mujoco.mj_forward(model, data)
    return data.qfrc_bias.copy()


@pytest.mark.parametrize("seed", range(6))
def test_gravity_torque_of_random_trees_is_mujocos(seed: int) -> None:
    """Catches joints that share a body and are chained in the wrong order, anchors, refs and
    tilted inertias."""
    model = random_tree(seed)
    names, columns = shuffled_names(model, seed)
    assert model.njnt > BODIES
    q = np.random.default_rng(seed).uniform(-3.0, 3.0, (4, model.nq))
    expected = np.array([mujoco_bias(model, row, np.zeros(model.nv)) for row in q])
    torque = RigidBody(model, names).gravity_torque(q[:, columns])
    assert np.abs(expected).max() > 5.0
    np.testing.assert_allclose(torque, expected[:, columns], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_inverse_dynamics_of_random_trees_is_mujocos(seed: int) -> None:
    """Catches a lost Coriolis term, rates in the wrong order and inertia about the wrong point."""
    model = random_tree(seed)
    names, columns = shuffled_names(model, seed)
    generator = np.random.default_rng(seed)
    q, q_dot, q_ddot = generator.uniform(-2.0, 2.0, (3, 4, model.nv))
    expected = np.empty_like(q)
    for row in range(4):
        data = mujoco.MjData(model)
        data.qpos[:] = q[row]
        data.qvel[:] = q_dot[row]
        data.qacc[:] = q_ddot[row]
        mujoco.mj_inverse(model, data)
        expected[row] = data.qfrc_inverse
    body = RigidBody(model, names)
    torque = body.inverse_dynamics(q[:, columns], q_dot[:, columns], q_ddot[:, columns])
    np.testing.assert_allclose(torque, expected[:, columns], rtol=0.0, atol=1e-9)
    still = np.zeros_like(q)
    at_rest = body.inverse_dynamics(q[:, columns], still, still)
    np.testing.assert_allclose(at_rest, body.gravity_torque(q[:, columns]), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_gravity_gradient_is_the_derivative_of_mujocos_gravity_torque(seed: int) -> None:
    """Catches a gradient that is transposed or permuted with the joints (differences of the
    other engine's torque)."""
    model = random_tree(seed)
    names, columns = shuffled_names(model, seed)
    q = np.random.default_rng(seed).uniform(-2.0, 2.0, model.nq)
    h = 1e-5
    still = np.zeros(model.nv)
    expected = np.empty((model.nv, model.nv))
    for j in range(model.nv):
        step = h * np.eye(model.nv)[j]
        expected[:, j] = (
            mujoco_bias(model, q + step, still) - mujoco_bias(model, q - step, still)
        ) / (2.0 * h)
    gradient = RigidBody(model, names).gravity_gradient(q[columns])
    np.testing.assert_allclose(gradient, expected[np.ix_(columns, columns)], rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(gradient, gradient.T, rtol=0.0, atol=1e-9)  # gravity has a potential


def test_gravity_torque_of_the_testbed_is_that_of_mujoco_and_of_its_formula() -> None:
    """Catches a formula of the pendulum that is not the model's: below 1e-9 N·m over random
    postures."""
    model = rigid_spec(PENDULUM).compile()
    body = RigidBody(model, [JOINT])
    q = np.random.default_rng(0).uniform(-4.0, 4.0, (200, 1))
    expected = np.array([mujoco_bias(model, row, np.zeros(1)) for row in q])
    np.testing.assert_allclose(body.gravity_torque(q), expected, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(PENDULUM.torque(q), expected, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(
        PENDULUM.torque_gradient(q), body.gravity_gradient(q), rtol=0.0, atol=1e-9
    )


def test_inverse_dynamics_of_the_testbed_is_newtons_second_law() -> None:
    """Catches an inertia about the center of mass in place of the axis: τ = I q̈ + m g d sin q."""
    body = RigidBody(rigid_spec(PENDULUM).compile(), [JOINT])
    q, q_dot, q_ddot = np.random.default_rng(1).uniform(-3.0, 3.0, (3, 50, 1))
    expected = PENDULUM.inertia * q_ddot + PENDULUM.torque(q)
    np.testing.assert_allclose(
        body.inverse_dynamics(q, q_dot, q_ddot), expected, rtol=0.0, atol=1e-9
    )


def test_the_pendulum_is_what_its_parameters_say() -> None:
    """Catches 60 N·m at another angle than the horizontal, and mass that does not scale the
    torque."""
    assert PENDULUM.torque(np.array(np.pi / 2)) == pytest.approx(60.0)
    model = rigid_spec(PENDULUM.with_mass_scaled(1.2)).compile()
    np.testing.assert_allclose(
        mujoco_bias(model, np.array([np.pi / 2]), np.zeros(1)), 72.0, rtol=1e-12
    )
    assert model.body_mass.sum() == pytest.approx(12.0)
    data = mujoco.MjData(model)
    data.qpos[0] = 0.5
    mujoco.mj_forward(model, data)
    assert data.xipos[1][0] > 0.2  # positive q carries the pendulum towards +x
    assert PENDULUM.with_mass_scaled(1.2).com_distance == pytest.approx(PENDULUM.com_distance)


@pytest.mark.parametrize("shape", [(), (1,), (3,), (2, 3), (0,)])
def test_leading_axes_are_free(shape: tuple[int, ...]) -> None:
    """Catches a batch whose rows are mixed up, and a single posture that needs a batch axis."""
    model = random_tree(1)
    names, _ = shuffled_names(model, 1)
    body = RigidBody(model, names)
    n = model.nv
    q, q_dot, q_ddot = np.random.default_rng(2).uniform(-1.0, 1.0, (3, *shape, n))
    results = (
        body.gravity_torque(q),
        body.gravity_gradient(q),
        body.inverse_dynamics(q, q_dot, q_ddot),
    )
    assert [result.shape for result in results] == [(*shape, n), (*shape, n, n), (*shape, n)]
    for row in np.ndindex(shape):
        np.testing.assert_array_equal(results[0][row], body.gravity_torque(q[row]))
        np.testing.assert_array_equal(results[1][row], body.gravity_gradient(q[row]))
        np.testing.assert_array_equal(
            results[2][row], body.inverse_dynamics(q[row], q_dot[row], q_ddot[row])
        )


def test_results_are_fresh() -> None:
    """Catches views of buffers, which the next call overwrites."""
    body = RigidBody(rigid_spec(PENDULUM).compile(), [JOINT])
    first = body.gravity_torque(np.array([1.0])), body.gravity_gradient(np.array([1.0]))
    copies = [array.copy() for array in first]
    body.gravity_torque(np.array([0.2]))
    body.gravity_gradient(np.array([0.2]))
    for array, copy in zip(first, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_errors_name_the_joint_and_what_exists() -> None:
    """Catches joints that are dropped silently, and joints of other types taken for hinges."""
    model = random_tree(0)
    names, _ = shuffled_names(model, 0)
    with pytest.raises(
        ConfigurationError,
        match=r"unknown joint of the rigid model 'knee'; choose one of: hinge0_0",
    ):
        RigidBody(model, ["knee", *names[1:]])
    with pytest.raises(
        ConfigurationError, match=rf"all {model.njnt} joints must be named .*got {model.njnt - 1}"
    ):
        RigidBody(model, names[1:])
    with pytest.raises(ConfigurationError):
        RigidBody(model, [names[0], *names[:-1]])  # one twice, one not at all
    slide = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="rail" type="slide"/><geom'
        ' size="0.1"/></body></worldbody></mujoco>'
    )
    with pytest.raises(
        ConfigurationError,
        match="'rail' of the rigid model is no hinge; trees of hinges are needed",
    ):
        RigidBody(slide, ["rail"])


# --------------------------------------------------------------------------------------------------
# A free base
# --------------------------------------------------------------------------------------------------


def floating_tree(seed: int) -> tuple[mujoco.MjModel, list[str], Array]:
    """A tree on a free base, its hinges in another order than the model's, and their columns in
    qvel."""
    model = random_tree(seed, floating=True)
    order = 1 + np.random.default_rng(seed).permutation(model.njnt - 1)
    names = [model.joint(int(j)).name for j in order]
    return model, names, model.jnt_dofadr[order]


@pytest.mark.parametrize("seed", range(4))
def test_inverse_dynamics_on_a_level_base_is_mujocos(seed: int) -> None:
    """Catches base and hinges that are mixed up, the base's acceleration without its mass, a
    moment elsewhere, and a base that turns without Coriolis forces."""
    model, names, columns = floating_tree(seed)
    model.opt.gravity[:2] = 0.0
    generator = np.random.default_rng(seed)
    q, q_dot, q_ddot = generator.uniform(-2.0, 2.0, (3, 4, len(names)))
    base, base_dot, base_ddot = generator.uniform(-2.0, 2.0, (3, 4, 4))
    wrench, torque = FloatingBody(model, names).inverse_dynamics(
        q, base_dot, q_dot, base_ddot, q_ddot
    )
    for row in range(4):
        data = mujoco.MjData(model)
        heading = base[row, 3]
        R = rotation_z(heading)
        data.qpos[:3] = base[row, :3]
        data.qpos[3:7] = [np.cos(heading / 2.0), 0.0, 0.0, np.sin(heading / 2.0)]
        data.qpos[columns + 1] = q[row]
        data.qvel[:3] = R @ base_dot[row, :3]
        data.qvel[5] = base_dot[row, 3]
        data.qvel[columns] = q_dot[row]
        data.qacc[:3] = R @ base_ddot[row, :3]
        data.qacc[5] = base_ddot[row, 3]
        data.qacc[columns] = q_ddot[row]
        mujoco.mj_inverse(model, data)
        needed = data.qfrc_inverse
        np.testing.assert_allclose(wrench[row, :3], R.T @ needed[:3], rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(wrench[row, 3:], needed[3:6], rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(torque[row], data.qfrc_inverse[columns], rtol=0.0, atol=1e-9)
    assert np.abs(wrench).min(axis=0).max() > 1.0


@pytest.mark.parametrize("seed", range(4))
def test_mass_matrix_of_a_floating_tree_is_mujocos(seed: int) -> None:
    """Catches the lower triangle left empty, rows and columns in different orders, and rotation
    before translation."""
    model, names, columns = floating_tree(seed)
    q = np.random.default_rng(seed).uniform(-2.0, 2.0, len(names))
    data = mujoco.MjData(model)
    data.qpos[3:7] = [1.0, 0.0, 0.0, 0.0]
    data.qpos[columns + 1] = q
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    order = np.concatenate([np.arange(6), columns])
    mass = FloatingBody(model, names).mass_matrix(q)
    np.testing.assert_allclose(mass, full[np.ix_(order, order)], rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(
        mass[:3, :3], model.body_mass.sum() * np.eye(3), rtol=0.0, atol=1e-11
    )


def test_center_of_mass_of_a_floating_tree_is_mujocos() -> None:
    """Catches a center of mass in the world or without the base, and rows that are all the last
    one."""
    model, names, columns = floating_tree(0)
    generator = np.random.default_rng(0)
    q = generator.uniform(-2.0, 2.0, (5, len(names)))
    com = FloatingBody(model, names).center_of_mass(q)
    assert com.shape == (5, 3)
    for row in range(5):
        data = mujoco.MjData(model)
        data.qpos[:7] = generator.normal(size=7)
        data.qpos[columns + 1] = q[row]
        mujoco.mj_forward(model, data)
        R = data.body("base").xmat.reshape(3, 3)
        expected = (data.body("base").subtree_com - data.body("base").xpos) @ R
        np.testing.assert_allclose(com[row], expected, rtol=0.0, atol=1e-12)


def test_a_base_that_is_not_free_is_an_error() -> None:
    """Catches a fixed robot that is taken for a floating one, and hinges that are left out of
    it."""
    fixed = random_tree(0)
    with pytest.raises(
        ConfigurationError, match=r"^a floating robot needs one free joint, this model has 0$"
    ):
        FloatingBody(fixed, shuffled_names(fixed, 0)[0])
    model, names, _ = floating_tree(0)
    with pytest.raises(
        ConfigurationError, match=rf"all {len(names)} joints must be named .*got {len(names) - 1}"
    ):
        FloatingBody(model, names[1:])
    with pytest.raises(
        ConfigurationError,
        match=r"unknown joint of the rigid model 'free'; choose one of: hinge0_0",
    ):
        FloatingBody(model, ["free", *names[1:]])
