"""The spring, its inverse and Eq. 10, against MuJoCo's passive forces, closed forms and SciPy."""

import re
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import optimize

from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array
from elastic_env.joint.elastic_joint import ElasticJoint
from elastic_env.joint.elasticity import joint_torque, solve_stiffness, static_deflection
from elastic_env.joint.static_equilibrium import static_link_angle
from elastic_env.robots.testbed.model import Pendulum

PENDULUM = Pendulum()

SPRING = """<mujoco><worldbody>
  <body><joint name="theta"/><geom size="0.05"/></body>
  <body><joint name="q"/><geom size="0.05"/></body></worldbody>
  <tendon><fixed stiffness="{K}" damping="{D}" springlength="{low} {high}">
    <joint joint="theta" coef="1"/><joint joint="q" coef="-1"/></fixed></tendon>
</mujoco>"""

angles = st.floats(-3.0, 3.0, allow_subnormal=False)
stiffnesses = st.floats(100.0, 1e4)
shapes = hnp.array_shapes(min_dims=1, max_dims=3, max_side=4)
angle_arrays = shapes.flatmap(lambda shape: hnp.arrays(np.float64, shape, elements=angles))


def two_link_torque(q: Array) -> Array:
    """Gravity torque of a double pendulum, (..., 2): coupled, unlike that of the testbed."""
    lower = 12.0 * np.sin(q[..., 0] + q[..., 1])
    return np.stack([40.0 * np.sin(q[..., 0]) + lower, lower], axis=-1)


def two_link_gradient(q: Array) -> Array:
    """Its gradient, (..., 2, 2)."""
    lower = 12.0 * np.cos(q[..., 0] + q[..., 1])
    rows = [[40.0 * np.cos(q[..., 0]) + lower, lower], [lower, lower]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


@pytest.mark.parametrize("backlash", [0.0, 0.02])
def test_joint_torque_agrees_with_the_spring_and_damper_of_mujoco(backlash: float) -> None:
    """Catches a wrong sign, a dead band of twice its width, and damping that stops inside the
    dead band."""
    xml = SPRING.format(K=120.0, D=0.4, low=-backlash / 2, high=backlash / 2)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    generator = np.random.default_rng(1)
    for _ in range(50):
        data.qpos[:] = generator.uniform(-0.03, 0.03, 2)
        data.qvel[:] = generator.uniform(-1.0, 1.0, 2)
        mujoco.mj_forward(model, data)
        deflection = data.qpos[0] - data.qpos[1]
        rate = data.qvel[0] - data.qvel[1]
        tau_J = joint_torque(np.array([deflection]), np.array([rate]), 120.0, 0.4, backlash)
        np.testing.assert_allclose(tau_J, data.qfrc_passive[1], rtol=0.0, atol=1e-13)
        np.testing.assert_allclose(tau_J, -data.qfrc_passive[0], rtol=0.0, atol=1e-13)


def test_dead_band_passes_no_torque_and_has_no_step_at_its_edges() -> None:
    """Catches a spring that jumps to K b/2 where the gear engages."""
    inside = np.linspace(-0.01, 0.01, 101)
    np.testing.assert_array_equal(joint_torque(inside, np.zeros(101), 1001.0, 10.0, 0.02), 0.0)
    np.testing.assert_allclose(
        joint_torque(inside, np.ones(101), 1001.0, 10.0, 0.02), 10.0, rtol=0.0, atol=0.0
    )
    beyond = np.array([-0.012, 0.012])
    np.testing.assert_allclose(
        joint_torque(beyond, np.zeros(2), 1001.0, 0.0, 0.02), [-2.002, 2.002], rtol=1e-13
    )


@given(torque=angle_arrays, stiffness=stiffnesses, backlash=st.floats(0.0, 0.1))
def test_static_deflection_is_the_inverse_of_the_spring(
    torque: Array, stiffness: float, backlash: float
) -> None:
    """Catches a dead band that is added on the wrong side of the load, or in full instead of by
    half."""
    deflection = static_deflection(torque, stiffness, backlash)
    recovered = joint_torque(deflection, np.zeros_like(torque), stiffness, 0.0, backlash)
    np.testing.assert_allclose(recovered, torque, rtol=0.0, atol=1e-15 * stiffness)


def test_static_deflection_without_load_is_zero_even_with_backlash() -> None:
    """Catches half a dead band of deflection where nothing pushes the gear to either side."""
    np.testing.assert_array_equal(static_deflection(np.zeros(3), 1001.0, 0.02), 0.0)


@pytest.mark.parametrize("stiffness", [300.0, 1001.0, 3000.0])
def test_static_link_angle_solves_equation_10(stiffness: float) -> None:
    """Catches a Newton step with a wrong gradient or sign, which shows first at the soft joint,
    K = 300."""
    theta = np.linspace(-3.0, 3.0, 121)[:, None]
    q = static_link_angle(theta, stiffness, PENDULUM.torque, PENDULUM.torque_gradient)
    residual = q - theta + PENDULUM.torque(q) / stiffness
    assert np.abs(residual).max() < 1e-10
    assert np.abs(residual).max() < 2e-12  # the tolerance that the function promises, and rounding


@pytest.mark.parametrize("theta", [-1.4, -0.3, 0.7, 1.6])
def test_static_link_angle_agrees_with_bisection(theta: float) -> None:
    """Catches convergence to a point that only the residual's own code takes for a root."""
    expected = optimize.brentq(
        lambda q: q - theta + 60.0 * np.sin(q) / 300.0, theta - 0.3, theta + 0.3, xtol=1e-14
    )
    q = static_link_angle(np.array([theta]), 300.0, PENDULUM.torque, PENDULUM.torque_gradient)
    np.testing.assert_allclose(q, expected, rtol=0.0, atol=5e-13)


def test_static_link_angle_of_coupled_joints() -> None:
    """Catches a matrix equation that is solved joint by joint, or with the gradient transposed
    or misplaced."""
    theta = np.random.default_rng(3).uniform(-1.5, 1.5, (40, 2))
    K = np.array([300.0, 90.0])
    q = static_link_angle(theta, K, two_link_torque, two_link_gradient)
    np.testing.assert_allclose(q + two_link_torque(q) / K, theta, rtol=0.0, atol=2e-12)


def test_static_link_angle_is_a_stable_rest_of_the_simulated_joint() -> None:
    """Catches an angle that satisfies our equation but not MuJoCo's: there the whole plant must
    be in balance."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint name="theta" axis="0 -1 0"/><inertial pos="0 0 0" mass="1"
             diaginertia="1 1 1"/></body>
           <body><joint name="q" axis="0 -1 0"/><inertial pos="0 0 -0.6" mass="10" diaginertia="1 1 1"/></body>
           </worldbody><tendon><fixed stiffness="300"><joint joint="theta" coef="1"/><joint joint="q" coef="-1"/>
           </fixed></tendon></mujoco>"""
    )
    load = Pendulum(gravity_torque=10.0 * 9.81 * 0.6)
    data = mujoco.MjData(model)
    data.qpos[0] = 1.1
    data.qpos[1] = static_link_angle(data.qpos[:1], 300.0, load.torque, load.torque_gradient)[0]
    mujoco.mj_forward(model, data)
    assert abs(data.qfrc_passive[1] - data.qfrc_bias[1]) < 1e-9


def test_singular_stiffness_is_an_error_that_says_what_to_change() -> None:
    """Catches a division by zero where gravity cancels the spring exactly."""
    balanced = np.array([[[-1001.0]]])
    with pytest.raises(ElasticError, match=r"singular.*K 1001 N·m/rad.*stiffer joint"):
        solve_stiffness(np.array([[1001.0]]), balanced, np.array([[1.0]]))
    coupled = np.array([[-1.0, 2.0], [2.0, -3.0]])  # with K on its diagonal [[1, 2], [2, 4]]
    with pytest.raises(ElasticError, match="singular"):
        solve_stiffness(np.array([2.0, 7.0]), coupled, np.ones(2))
    with pytest.raises(ElasticError, match="singular"):
        static_link_angle(
            np.array([0.4]), 50.0, lambda q: 1.0 - 50.0 * q, lambda q: np.full((1, 1), -50.0)
        )


def test_no_equilibrium_is_an_error_with_the_stiffness() -> None:
    """Catches a Newton iteration that returns its last guess where Eq. 10 has no solution."""
    with pytest.raises(
        ElasticError,
        match=r"not clear, Eq\. 10: .*\(0\.5 N·m/rad\).* % of the load .* pose .* is not known",
    ):
        static_link_angle(
            np.array([0.3]),
            0.5,
            lambda q: 1.0 + q**2 - 0.5 * q,
            lambda q: (2.0 * q - 0.5)[..., None],
        )


def test_solve_stiffness_agrees_with_a_general_solver() -> None:
    """Catches K added to whole rows instead of to the diagonal."""
    generator = np.random.default_rng(5)
    K = generator.uniform(300.0, 3000.0, (20, 12))
    gradient = generator.uniform(-20.0, 20.0, (20, 12, 12))
    torque = generator.uniform(-60.0, 60.0, (20, 12))
    x = solve_stiffness(K, gradient, torque)
    for row in range(20):
        expected = np.linalg.solve(np.diag(K[row]) + gradient[row], torque[row])
        np.testing.assert_allclose(x[row], expected, rtol=0.0, atol=1e-14)


def test_joints_of_very_different_stiffness_are_not_taken_for_singular() -> None:
    """Catches a test for singularity by the size of the determinant: 12 joints of 10 to 10,000
    N·m/rad are harmless."""
    K = np.logspace(1.0, 4.0, 12)
    np.testing.assert_allclose(solve_stiffness(K, np.zeros((12, 12)), K), 1.0, rtol=1e-14)
    batch = np.array([[1e-3], [1e15]])  # every row has its own scale
    np.testing.assert_allclose(solve_stiffness(batch, np.zeros((2, 1, 1)), batch), 1.0, rtol=1e-14)


@given(deflection=angle_arrays, rate=angles, backlash=st.floats(0.0, 0.1), stiffness=stiffnesses)
def test_spring_of_a_batch_is_that_of_its_elements(
    deflection: Array, rate: float, backlash: float, stiffness: float
) -> None:
    """Catches any formula in which one joint or world sees another, or the shape of the batch."""
    rates = np.full_like(deflection, rate)
    torque = joint_torque(deflection, rates, stiffness, 3.0, backlash)
    inverse = static_deflection(deflection, stiffness, backlash)
    assert torque.shape == inverse.shape == deflection.shape
    for index in np.ndindex(deflection.shape):
        assert torque[index] == joint_torque(
            deflection[index], rates[index], stiffness, 3.0, backlash
        )
        assert inverse[index] == static_deflection(deflection[index], stiffness, backlash)


@given(
    theta=hnp.arrays(np.float64, st.tuples(st.integers(1, 8), st.just(1)), elements=angles),
    stiffness=st.floats(200.0, 4000.0),
)
def test_rest_angle_of_a_batch_is_that_of_its_rows(theta: Array, stiffness: float) -> None:
    """Catches a Newton iteration whose number of steps in one world depends on the others, to
    the last bit."""
    q = static_link_angle(theta, stiffness, PENDULUM.torque, PENDULUM.torque_gradient)
    for row in range(len(theta)):
        alone = static_link_angle(theta[row], stiffness, PENDULUM.torque, PENDULUM.torque_gradient)
        np.testing.assert_array_equal(q[row], alone)


def test_coupled_rest_angles_of_a_batch_are_those_of_its_rows() -> None:
    """Catches the same where the step is a matrix equation, and leading axes of any number."""
    theta = np.random.default_rng(8).uniform(-1.5, 1.5, (3, 5, 2))
    K = np.array([300.0, 90.0])
    q = static_link_angle(theta, K, two_link_torque, two_link_gradient)
    assert q.shape == theta.shape
    for row in np.ndindex(3, 5):
        np.testing.assert_array_equal(
            q[row], static_link_angle(theta[row], K, two_link_torque, two_link_gradient)
        )


@pytest.mark.parametrize(
    ("parameter", "value", "requirement"),
    [
        ("stiffness", -5.0, r"a finite number > 0 \[N·m/rad\], got -5\.0"),
        ("stiffness", 0.0, r"a finite number > 0 \[N·m/rad\], got 0\.0"),
        ("damping", -1.0, r"a finite number >= 0 \[N·m·s/rad\], got -1\.0"),
        ("rotor_inertia", 0.0, r"a finite number > 0 \[kg·m²\], got 0\.0"),
        ("coulomb_friction", -0.1, r"a finite number >= 0 \[N·m\], got -0\.1"),
        ("viscous_friction", -0.1, r"a finite number >= 0 \[N·m·s/rad\], got -0\.1"),
        ("backlash", -1e-3, r"a finite number >= 0 and < 3\.14159 \[rad\], got -0\.001"),
        ("encoder_counts_per_turn", 0, r"a whole number > 0, got 0"),
    ],
)
def test_a_parameter_out_of_bounds_names_itself_its_unit_and_bound(
    parameter: str, value: float, requirement: str
) -> None:
    """Catches a bound that is missing, and an error that leaves the reader to guess."""
    values = {"stiffness": 1001.0, "rotor_inertia": 0.8, parameter: value}
    with pytest.raises(
        ConfigurationError, match=rf"ElasticJoint\.{parameter} must be {requirement}"
    ):
        ElasticJoint(**values)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    ("parameter", "requirement"),
    [("stiffness", r"> 0 \[N·m/rad\]"), ("damping", r">= 0 \[N·m·s/rad\]")],
)
def test_a_parameter_that_is_not_finite_names_itself_its_unit_and_bound(
    parameter: str, requirement: str, value: float
) -> None:
    """Catches NaN, for which every comparison with a bound is false, and an error without the
    bound."""
    values = {"stiffness": 1001.0, "rotor_inertia": 0.8, parameter: value}
    with pytest.raises(
        ConfigurationError,
        match=rf"ElasticJoint\.{parameter} must be a finite number {requirement}, got {value}",
    ):
        ElasticJoint(**values)


def test_backlash_of_half_a_turn_is_refused() -> None:
    """Catches a dead band wider than any gear, which is most likely given in degrees."""
    with pytest.raises(
        ConfigurationError, match=r"backlash must be .* >= 0 and < 3\.14159 \[rad\], got 5\.0"
    ):
        ElasticJoint(stiffness=1001.0, rotor_inertia=0.8, backlash=5.0)


def pendulum(load: float) -> tuple[Any, Any]:
    """Torque of a hanging pendulum that bends a spring of 1 N·m/rad by `load`, and its gradient."""
    return lambda q: load * np.sin(q), lambda q: (load * np.cos(q))[..., None]


@settings(max_examples=60)
@given(theta=st.floats(-np.pi, np.pi), load=st.floats(-6.0, 6.0))
def test_soft_springs_are_solved_wherever_one_equilibrium_exists(theta: float, load: float) -> None:
    """Catches Newton steps that fail, or end at an unstable pose, on soft springs; all roots are
    the judge."""
    grid = np.linspace(theta - 7.0, theta + 7.0, 20_001)
    values = grid - theta + load * np.sin(grid)
    roots = grid[np.flatnonzero((values[:-1] < 0.0) & (values[1:] >= 0.0))]
    assume(np.abs(1.0 + load * np.cos(roots)).min() > 0.02)  # neither do they begin to exist here
    assume(np.abs(np.abs(roots - theta) - np.pi).min() > 1e-3)
    near = roots[np.abs(roots - theta) < np.pi]
    if len(near) > 1:
        with pytest.raises(
            ElasticError, match=r"joint 1 of 1 \(1 N·m/rad\) too low.*(bistable|tips over)"
        ):
            static_link_angle(np.array([theta]), 1.0, *pendulum(load))
    elif len(near) == 1:
        q = static_link_angle(np.array([theta]), 1.0, *pendulum(load))
        assert q[0] == pytest.approx(near[0], abs=1e-3)


def test_of_several_equilibria_a_growing_load_leads_to_one() -> None:
    """Catches the wrong side of an inverted pendulum, to which the first Newton step leads."""
    q = static_link_angle(np.array([0.1]), 1.0, *pendulum(-1.1), unique=False)[0]
    assert q > 0.5
    assert q - 0.1 == pytest.approx(1.1 * np.sin(q), abs=1e-12)
    with pytest.raises(
        ElasticError, match=r"At 90\.9 % of the load .* singular: the link tips over"
    ):
        static_link_angle(np.array([0.0]), 1.0, *pendulum(-1.1), unique=False)


@pytest.mark.parametrize("load", [-2.0, -1.2, 0.7, 2.0])
def test_any_pose_of_a_soft_servo_is_solved_or_its_two_rests_are_named(load: float) -> None:
    """Catches a message that contradicts itself, and a pose without a name: m g l/k_p up to 2."""
    for theta in np.linspace(-np.pi, np.pi, 19):
        grid = np.linspace(theta - 7.0, theta + 7.0, 20_001)
        values = grid - theta + load * np.sin(grid)
        roots = grid[np.flatnonzero((values[:-1] < 0.0) & (values[1:] >= 0.0))]
        near = roots[np.abs(roots - theta) < np.pi]
        try:
            q = static_link_angle(np.array([theta]), 1.0, *pendulum(load))
            assert np.abs(near - q).min() < 1e-3
        except ElasticError as error:
            rests = [float(angle) for angle in re.findall(r"at (-?[\d.]+) rad", str(error))]
            np.testing.assert_allclose(sorted(rests), near, atol=2e-3)
            assert len(rests) == 2


def test_soft_and_stiff_rows_of_a_batch_are_those_alone() -> None:
    """Catches a row whose steps depend on whether another one needs the load to grow, to the
    last bit."""
    theta = np.random.default_rng(8).uniform(-1.0, 1.0, (12, 2))
    K = np.where(np.arange(12)[:, None] % 2, [300.0, 90.0], [4.0, 3.0])
    q = static_link_angle(theta, K, two_link_torque, two_link_gradient, unique=False)
    np.testing.assert_allclose(K * (theta - q), two_link_torque(q), atol=1e-10)
    for row in range(12):
        alone = static_link_angle(
            theta[row], K[row], two_link_torque, two_link_gradient, unique=False
        )
        np.testing.assert_array_equal(q[row], alone)
    assert np.isnan(static_link_angle(np.array([[np.nan], [0.1]]), 1.0, *pendulum(0.5))[0, 0])
