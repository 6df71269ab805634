"""References of robots of several joints, and what compensators leave of the sag in them."""

import tracemalloc
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environment
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.motion.trajectory import Plan
from elastic_env.robots.robot.environment import EXAMPLE, configure_robot

ARM = EXAMPLE.read_text()
SAGGING = (
    ARM.replace('<body name="forearm"', '<body name="forearm" gravcomp="0.5"')
    .replace('<joint name="elbow"', '<joint name="elbow" stiffness="20" springref="0.3"')
    .replace(
        "<keyframe>",
        "<actuator>"
        + "".join(
            f'<position joint="{one}" kp="4000" kv="60"/>' for one in ("base", "shoulder", "elbow")
        )
        + "</actuator><keyframe>",
    )
)
"""The arm with gravcomp on a body, a spring on a joint, and servos without integral action,
which sag themselves."""


def planned(reference: Any, seed: int = 0, **arguments: Any) -> tuple[Any, Plan]:
    """The plant of the made-up arm, and a plan."""
    config = configure_robot(reference=reference, **arguments)
    plant = config.robot.plant(config)
    return plant, plant.motion.plan(np.random.default_rng(seed), 0.004)


def of_tool(q: Array) -> Array:
    """Places of the tool by MuJoCo's kinematics, (T, 3) [m]."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    places = []
    for angles in q:
        data.qpos[:4] = angles
        mujoco.mj_kinematics(model, data)
        places.append(data.site("tool").xpos.copy())
    return np.array(places)


@pytest.mark.parametrize("kind", ["poses", "moves", "line", "circle"])
def test_rates_are_derivatives_of_angles(kind: str) -> None:
    """Catches a chain rule that is left out, and a start in motion: finite differences are the
    judge."""
    _, plan = planned(kind)
    centered = (plan.q[2:] - plan.q[:-2]) / 0.008
    np.testing.assert_allclose(plan.q_dot[1:-1], centered, atol=2e-3 * np.abs(plan.q_dot).max())
    turned = (plan.q_dot[2:] - plan.q_dot[:-2]) / 0.008
    np.testing.assert_allclose(plan.q_ddot[1:-1], turned, atol=1e-2 * np.abs(plan.q_ddot).max())
    np.testing.assert_array_equal(plan.q[0], [0.0, 0.6, 0.9, 0.4])
    assert not plan.scored[:250].any()


def test_the_tool_goes_straight_and_round() -> None:
    """Catches inverse kinematics that end elsewhere: MuJoCo's forward kinematics are the judge."""
    line = of_tool(planned({"kind": "line", "by": [0.05, 0.0, -0.1]})[1].q[::25])
    along = line - line[0]
    way = along @ np.array([0.05, 0.0, -0.1]) / 0.0125
    np.testing.assert_allclose(along, way[:, None] * [0.05, 0.0, -0.1], atol=1e-7)
    assert (way.min(), way.max()) == (pytest.approx(0.0, abs=1e-6), pytest.approx(1.0, abs=1e-6))
    circle = of_tool(planned({"kind": "circle", "radius": 0.06})[1].q[::25])
    plane = circle[:, [0, 2]]
    fit = np.linalg.lstsq(
        np.c_[2.0 * plane, np.ones(len(plane))], (plane**2).sum(axis=1), rcond=None
    )[0]
    center = np.array([fit[0], 0.0, fit[1]])
    np.testing.assert_allclose(np.linalg.norm(circle - center, axis=1), 0.06, atol=1e-7)
    np.testing.assert_allclose(circle[-1], circle[0], atol=1e-7)
    np.testing.assert_allclose(circle[:, 1], 0.0, atol=1e-7)


def test_a_line_needs_memory_for_its_steps_alone() -> None:
    """Catches a table of all steps by all ways, which grows with the square of the ways."""
    once = planned({"kind": "line", "duration_s": 0.8})[1]
    config = configure_robot(reference={"kind": "line", "duration_s": 0.8, "repeats": 100})
    tracemalloc.start()
    plan = config.robot.plant(config).motion.plan(np.random.default_rng(0), 0.004)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 40 * plan.q.nbytes
    np.testing.assert_allclose(plan.q[-400:], once.q[-400:], atol=1e-9)


def test_poses_are_within_limits_and_at_rest_where_they_count() -> None:
    """Catches windows that begin before the robot stands, and poses that press a joint against
    its limit."""
    plant, plan = planned({"kind": "poses", "positions": 30, "settle_s": 0.2})
    assert set(plan.rest[plan.scored]) == set(range(30))
    assert (plan.q_dot[plan.scored] == 0.0).all()
    reached = np.array([plan.q[plan.rest == pose][0] for pose in range(30)])
    ranges = plant.true.rigid.jnt_range
    assert ((reached > ranges[:, 0]) & (reached < ranges[:, 1])).all()
    assert (np.ptp(reached, axis=0) > 1.0).all()
    drawn = {"kind": "poses", "seed": None}
    assert not np.array_equal(planned(drawn, seed=1)[1].q, planned(drawn, seed=2)[1].q)
    assert np.array_equal(planned("poses", seed=1)[1].q, planned("poses", seed=2)[1].q)


def test_a_file_is_played_through_its_rows(tmp_path: Path) -> None:
    """Catches columns that are mixed up, and a jump at the start or the end."""
    file = tmp_path / "angles.csv"
    file.write_text("time_s,elbow,base\n5,0.9,0\n6,1.2,0.3\n7,0.8,0.1\n")
    _, plan = planned({"kind": "csv", "file": str(file)})
    np.testing.assert_allclose(
        plan.q[[250, 500, 750]][:, [2, 0]], [[0.9, 0.0], [1.2, 0.3], [0.8, 0.1]], atol=1e-9
    )
    np.testing.assert_allclose(plan.q[:, 1], 0.6)
    assert not plan.q_dot[[0, 250, -1]].any()
    for text, message in (
        ("time_s,elbo\n0,1\n1,2\n", r"unknown column of .*'elbo'.*Did you mean 'elbow'"),
        ("t,elbow\n0,1\n1,2\n", r"first column of .* must be time_s, got 't'"),
        ("time_s,elbow\n1,1\n0,2\n", r"must increase"),
        ("time_s,elbow\n0,x\n1,2\n", r"rows of numbers"),
        ("time_s;elbow\n0;1\n1;2\n", r"separated by semicolons; use commas, and points in numbers"),
        ("time_s,elbow\n0,1\n", r"two rows or more"),
        ("time_s,elbow\n0,1\n1e-300,2\n", r"rows at least 1e-06 s apart, and angles within"),
        ("time_s,elbow\n0,1\n1,1e300\n", r"angles within ±10000 rad"),
    ):
        file.write_text(text)
        with pytest.raises(ConfigurationError, match=message):
            planned({"kind": "csv", "file": str(file)})


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        (
            {"kind": "line", "by": [2.0, 0.0, 0.0]},
            r"cannot follow the path beyond .* % of it.*out of reach",
        ),
        (
            {"kind": "circle", "normal": [0.0, 0.0, 0.0]},
            r"normal of a circle must have a length > 0",
        ),
        ({"kind": "csv", "file": "none.csv"}, r"no file of angles at none.csv"),
        ("pose", r"unknown reference 'pose'.*Did you mean 'poses'"),
        ({"kind": "moves", "move_s": 0.02}, r"'moves' can need .* make its moves slower"),
        ({"kind": "line", "repeats": 100, "duration_s": 600.0}, r"at most 7200 s, got 120000 s;"),
        ({"kind": "circle", "repeats": 13, "duration_s": 600.0}, r"at most 7200 s, got 7800 s; t"),
        ({"kind": "poses", "positions": 1000, "settle_s": 600.0}, r"at most 7200 s, got 602250 s"),
        ({"kind": "moves", "positions": 1000, "move_s": 600.0}, r"at most 7200 s, got 600000 s"),
        ({"kind": "hold", "rate": 1e-9}, r"at most 7200 s, got 7.07659e\+09 s; take fewer"),
        ({"kind": "steps", "moves": 1000, "move_s": 9.0}, r"at most 7200 s, got 10000 s; take few"),
    ],
)
def test_what_cannot_be_played_says_why(reference: Any, message: str) -> None:
    """Catches a motion of days, whose tables take all memory."""
    with pytest.raises(ConfigurationError, match=message):
        planned(reference)


def test_slower_moves_are_no_advice_where_the_weight_alone_is_too_much() -> None:
    """Catches advice that does not help: a move of a minute needs as much as one of two seconds."""
    joints = {"*": 1000.0, "shoulder": {"stiffness": 1000.0, "servo": {"torque_limit": 20.0}}}
    slow = {"kind": "poses", "move_s": 60.0}
    with (
        pytest.warns(UserWarning, match="assumed"),
        pytest.raises(ConfigurationError, match="the weight alone is too much: raise its torque_l"),
    ):
        planned(slow, model=EXAMPLE, joints=joints, home={"shoulder": 1.3, "elbow": 0.2})


def weak_arm(geom: str, torque: float, axis: str = "0 1 0", more: str = "") -> str:
    """An arm whose last joint has a motor of little torque [N·m]."""
    return (
        '<mujoco><compiler angle="radian"/><default><geom type="capsule" size="0.05" mass="1"/>'
        f"</default><worldbody><body name='upper'>{more}<body name='lower' pos='0 0 1'>"
        f"<joint name='last' axis='{axis}' range='-2.4 2.4'/><geom fromto='{geom}'/></body>"
        "</body></worldbody><actuator><motor joint='last' ctrlrange='-1 1'"
        f" gear='{torque}'/></actuator></mujoco>"
    )


UPRIGHT = weak_arm(
    "0 0 0 0 0 1",
    torque=2.0,
    more="<joint name='first' axis='0 1 0'/><geom fromto='0 0 0 0 0 1'/>",
)
"""Its servo holds some poses, and not what lies between them."""
LEVEL = weak_arm("0 0 0 1 0 0", torque=4.5)
"""Its servo does not hold it at home."""
VERTICAL = weak_arm("0 0 0 1 0 0", torque=0.25, axis="0 0 1")
"""Its servo holds every pose, and takes longer from one to the next."""


@pytest.mark.filterwarnings("ignore:assumed")
@pytest.mark.parametrize("kind", ["poses", "moves"])
@pytest.mark.parametrize("model", [UPRIGHT, LEVEL, VERTICAL])
def test_weak_servos_follow_the_poses_of_their_own_robot(model: str, kind: str) -> None:
    """Catches a robot that is refused for a motion that nobody chose. MuJoCo's inverse dynamics
    are the judge."""
    with pytest.warns(
        UserWarning, match=rf"too weak for the usual '{kind}'; .*(home is moved|drawn within)"
    ):
        plant, plan = planned(kind, model=model, joints={"*": 2000.0})
    rigid = mujoco.MjModel.from_xml_string(model)
    rigid.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data = mujoco.MjData(rigid)
    last = []
    for data.qpos[:], data.qvel[:], data.qacc[:] in zip(
        plan.q, plan.q_dot, plan.q_ddot, strict=True
    ):
        mujoco.mj_inverse(rigid, data)
        last.append(data.qfrc_inverse[-1] + plant.true.rotor_inertia[-1] * data.qacc[-1])
    assert np.abs(last).max() <= rigid.actuator_gear[0, 0]
    assert np.ptp(plan.q[:, -1]) > 0.005
    assert np.abs(plan.q[:, -1]).max() < 2.4


@pytest.mark.filterwarnings("ignore:assumed")
def test_what_is_chosen_for_weak_servos_is_not_changed() -> None:
    """Catches poses, moves and a home that are others than the user asked for."""
    level: dict[str, Any] = {"model": LEVEL, "joints": {"*": 2000.0}}
    vertical = {**level, "model": VERTICAL}
    for arguments, message in (
        ({**vertical, "reference": {"kind": "poses", "move_s": 1.9}}, "make its moves slower"),
        ({**vertical, "reference": {"kind": "poses", "within_rad": 1.0}}, "make its moves slower"),
        ({**level, "reference": "poses", "home": [0.0]}, "hold hardly any pose|weight alone"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            planned(**arguments)
    _, plan = planned({"kind": "poses", "within_rad": 0.1})
    assert np.abs(plan.q - plan.q[0]).max() <= 0.1


def test_servos_that_hold_no_pose_near_home_are_named() -> None:
    """Catches a refusal that says neither which servo is weak nor by how much."""
    message = r"takes 4\.90\d N·m of the servo of joint 'last', which is limited to 1 N·m"
    weak = LEVEL.replace("gear='4.5'", "gear='1'").replace("range='-2.4 2.4'", "range='-1 1'")
    with pytest.raises(ConfigurationError, match=message):
        planned("poses", model=weak, joints={"*": 2000.0})


def errors_at_poses(
    policy: str, model: str, positions: int, worlds: int, scenario: str
) -> dict[str, Array]:
    """End-effector and link errors at static poses, of worlds with poses of their own."""
    times = {"move_s": 1.0, "settle_s": 1.6, "measure_s": 0.05}
    reference = {"kind": "poses", "positions": positions, "seed": None, **times}
    servo = {} if model is SAGGING else {"position_gain": 4e4, "integral_gain": 2e5}
    joint = {
        "stiffness": 800.0,
        "damping": 30.0,
        "rotor_inertia": 0.2,
        "coulomb_friction": 1.0,
        "servo": servo,
    }
    env: Any = gymnasium.make_vec(
        "elastic_env/Robot-v0",
        num_envs=worlds,
        vectorization_mode="vector_entry_point",
        model=model,
        joints={"*": joint, "wrist": "held"},
        end_effector="tool",
        reference=reference,
        scenario=scenario,
        timestep_s=0.001,
    )
    player = baselines.make(policy, env)
    observation, _ = env.reset(seed=0)
    info = {}
    state = None
    start = np.ones(worlds, dtype=np.bool_)
    is_over = False
    while not is_over:
        action, state = player.predict(observation, state, start)
        observation, _, terminated, truncated, info = env.step(action)
        is_over = (terminated | truncated).any()
        start = np.zeros(worlds, dtype=np.bool_)
    metrics = info["episode_metrics"]
    return {
        name: np.asarray(metrics[name])
        for name in ("end_effector_error_rms_m", "link_error_peak_rad")
    }


@pytest.mark.parametrize(
    "model",
    [pytest.param(ARM, marks=pytest.mark.slow), SAGGING],
    ids=["holding", "sagging, gravcomp, springs"],
)
def test_static_poses_are_compensated_to_a_hundredth(model: str) -> None:
    """Catches a servo, a spring or a gravcomp that the compensator does not know, at 4 poses."""
    both = (errors_at_poses(policy, model, 2, 2, "ideal") for policy in ("uncompensated", "input"))
    without, compensated = (errors["end_effector_error_rms_m"] for errors in both)
    assert (without > 2e-3).all()
    assert np.sqrt(np.square(compensated).mean()) <= 0.01 * np.sqrt(np.square(without).mean())


def test_what_friction_leaves_is_within_its_bound() -> None:
    """Catches a compensator that adds to what friction leaves: F over K, less by how much
    gravity pulls on."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    data.qpos[:] = [
        0.0,
        np.pi / 2,
        0.0,
        0.0,
        0.02,
    ]  # stretched out, where its weight has the longest levers
    mujoco.mj_forward(model, data)
    steepest = np.abs(data.qfrc_bias[1:3]).sum()
    left = errors_at_poses("input", ARM, 2, 2, "nominal")["link_error_peak_rad"]
    assert (left > 1e-4).all()
    assert (left <= 1.0 / (800.0 - steepest)).all()
