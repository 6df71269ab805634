"""The transform to elastic joints: closed forms, energy, MuJoCo's own rigid model, and models
that are not ours."""

from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import numpy.typing as npt
import pytest

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.dynamixel import H54_200_S500_R
from elastic_env.joint.elastic_joint import ElasticJoint, Servo
from elastic_env.joint.joint_names import (
    JointAddresses,
    motor_name,
    servo_name,
    spring_name,
)
from elastic_env.joint.make_elastic import Form, make_elastic
from elastic_env.robots.testbed.model import JOINT, Pendulum, elastic_spec, rigid_spec
from tests.foreign import ARM, FOUR_BAR, MODELS, QUADRUPED, ROVER

PENDULUM = Pendulum()
STEP_S = 5e-4
FRICTIONLESS = H54_200_S500_R.replace(coulomb_friction=0.0)
CONSERVATIVE = FRICTIONLESS.replace(damping=0.0, servo=None)
FOREIGN = ElasticJoint(stiffness=800.0, damping=3.0, rotor_inertia=0.07)
HOLDING = Servo(
    position_gain=3000.0,
    velocity_gain=60.0,
    integral_gain=20_000.0,
    torque_limit=200.0,
    speed_limit=4.0,
)
ASSETS = sorted((Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets").glob("*.xml"))


def hinges(spec: mujoco.MjSpec) -> list[str]:
    """Names of all named hinges."""
    return [
        joint.name
        for joint in spec.joints
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE and joint.name
    ]


# --------------------------------------------------------------------------------------------------
# Motion of the testbed
# --------------------------------------------------------------------------------------------------


def series_model(joint: ElasticJoint) -> mujoco.MjModel:
    """The testbed with two hinges in series on the link: θ, and the deflection q − θ.

    The link angle q is the length of a tendon, which has the friction.
    """
    spec = rigid_spec(PENDULUM)
    spec.option.timestep = STEP_S
    (link,) = spec.worldbody.bodies
    hinge = spec.joint(JOINT)
    hinge.name = "theta"
    hinge.armature = joint.rotor_inertia
    deflection = link.add_joint(name="deflection", axis=hinge.axis)
    deflection.stiffness = [joint.stiffness, 0.0, 0.0]
    deflection.damping = [joint.damping, 0.0, 0.0]
    q = spec.add_tendon(
        name="q",
        damping=[joint.viscous_friction, 0.0, 0.0],
        frictionloss=joint.coulomb_friction,
        solref_friction=[0.001, 1.0],
        solimp_friction=[0.9999, 0.9999, 0.001, 0.5, 2.0],
    )
    q.wrap_joint("theta", 1.0)
    q.wrap_joint("deflection", 1.0)
    servo = joint.servo
    if servo is not None:
        actuator = spec.add_actuator(target="theta", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_pid(
            kp=servo.position_gain,
            kv=servo.velocity_gain,
            ki=servo.integral_gain,
            imax=servo.integral_limit,
            ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_POS),
        )
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        actuator.forcerange = [-servo.torque_limit, servo.torque_limit]
    return spec.compile()


def link_motion(model: mujoco.MjModel, is_series: bool, duration_s: float) -> Array:
    """Link angle of the testbed, released with a deflection, under a moving servo reference."""
    data = mujoco.MjData(model)
    data.qpos[:] = [0.3, -0.02] if is_series else [0.28, 0.3]
    q = []
    for k in range(round(duration_s / (8 * STEP_S))):
        data.ctrl[:] = 0.3 + 0.5 * np.sin(3.0 * k * 8 * STEP_S)
        mujoco.mj_step(model, data, 8)
        q.append(data.qpos.sum() if is_series else data.joint(JOINT).qpos[0])
    return np.array(q)


@pytest.mark.parametrize(
    ("joint", "bound"),
    [
        (FRICTIONLESS, 1e-12),
        (FRICTIONLESS.replace(damping=0.0), 1e-9),
        (FRICTIONLESS.replace(viscous_friction=2.0), 1e-12),
        (H54_200_S500_R, 1e-9),
    ],
    ids=["damped", "undamped", "viscous", "coulomb"],
)
def test_tendon_and_series_form_move_alike(joint: ElasticJoint, bound: float) -> None:
    """Catches a spring, damper, friction or servo that acts on the wrong side in one of the
    forms (3 s of motion)."""
    tendon = link_motion(elastic_spec(PENDULUM, joint, "tendon", STEP_S).compile(), False, 3.0)
    series = link_motion(series_model(joint), True, 3.0)
    assert np.ptp(tendon) > 0.9  # it did move
    assert np.abs(tendon - series).max() < bound


def test_free_motion_keeps_its_energy() -> None:
    """Catches hidden damping or friction, and a spring force that is not the gradient of ½ K δ²
    (10 s of swinging)."""
    spec = elastic_spec(PENDULUM, CONSERVATIVE, "tendon", STEP_S)
    spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = [1.0, 0.95]
    energies = []
    for _ in range(6):
        mujoco.mj_forward(model, data)  # the energy of a step belongs to its beginning
        energies.append(
            data.energy.sum() + PENDULUM.gravity_torque
        )  # counted from the hanging position
        mujoco.mj_step(model, data, round(2.0 / STEP_S))
    np.testing.assert_allclose(energies, energies[0], rtol=1e-6)
    assert energies[0] > 20.0


@pytest.mark.parametrize("stiffness", [300.0, 1001.0, 3000.0])
@pytest.mark.parametrize(
    "rotor_inertia", [H54_200_S500_R.rotor_inertia, 1e9], ids=["free", "locked"]
)
def test_vibration_has_the_frequency_of_the_closed_form(
    stiffness: float, rotor_inertia: float
) -> None:
    """Catches a wrong K, B or I: δ = δ₀ cos ωt, ω = √(K(1/B + 1/I)), and √(K/I) behind a rotor
    that cannot move."""
    joint = CONSERVATIVE.replace(stiffness=stiffness, rotor_inertia=rotor_inertia)
    spec = elastic_spec(PENDULUM, joint, "tendon", STEP_S, gravity=0.0)
    model = spec.compile()
    data = mujoco.MjData(model)
    motor, hinge = (model.joint(name).qposadr[0] for name in (motor_name(JOINT), JOINT))
    data.qpos[hinge] = -0.01
    omega = np.sqrt(stiffness * (1.0 / rotor_inertia + 1.0 / PENDULUM.inertia))
    t = (
        np.arange(1, 401) * 10 * STEP_S
    )  # 2 s: a frequency off by 0.1 % ends 0.05 to 0.2 rad out of phase
    deflection = np.empty(len(t))
    for k in range(len(t)):
        mujoco.mj_step(model, data, 10)
        deflection[k] = data.qpos[motor] - data.qpos[hinge]
    np.testing.assert_allclose(deflection, 0.01 * np.cos(omega * t), rtol=0.0, atol=1e-7)


def test_dead_band_passes_no_torque_and_then_the_spring_of_the_rest() -> None:
    """Catches a dead band of the wrong width, and one that shifts instead of opening the spring."""
    joint = CONSERVATIVE.replace(backlash=0.02)
    model = elastic_spec(PENDULUM, joint).compile()
    data = mujoco.MjData(model)
    at = JointAddresses.of(model, [JOINT])
    for deflection, torque in [
        (-0.012, -2.002),
        (-0.0099, 0.0),
        (0.0, 0.0),
        (0.0099, 0.0),
        (0.012, 2.002),
    ]:
        data.qpos[at.q] = 0.4
        data.qpos[at.theta] = 0.4 + deflection
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.qfrc_passive[at.q_dot], torque, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(data.qfrc_passive[at.theta_dot], -torque, rtol=0.0, atol=1e-12)


def test_friction_holds_the_link_without_creeping() -> None:
    """Catches friction on the rotor or the tendon, and MuJoCo's default constraint, which lets
    go in seconds."""
    model = elastic_spec(PENDULUM, H54_200_S500_R).compile()
    data = mujoco.MjData(model)
    at = JointAddresses.of(model, [JOINT])
    deflection = 4.5 / H54_200_S500_R.stiffness  # within the friction of 5.4 N·m
    data.qpos[at.theta] = data.ctrl[:] = deflection
    data.act[:] = 4.5 / H54_200_S500_R.servo.integral_gain
    mujoco.mj_step(model, data, round(5.0 / STEP_S))
    torque = H54_200_S500_R.stiffness * (data.qpos[at.theta] - data.qpos[at.q])
    np.testing.assert_allclose(torque, 4.5, rtol=0.0, atol=2e-3)


def test_friction_lets_go_where_the_torque_exceeds_it() -> None:
    """Catches friction that sticks to any load: pushed from zero g beyond 5.4 N·m, the link
    slides on."""
    model = elastic_spec(PENDULUM, H54_200_S500_R, gravity=0.0).compile()
    data = mujoco.MjData(model)
    at = JointAddresses.of(model, [JOINT])
    data.qpos[at.theta] = data.ctrl[:] = 0.05
    mujoco.mj_step(model, data, round(2.0 / STEP_S))
    torque = H54_200_S500_R.stiffness * (data.qpos[at.theta] - data.qpos[at.q])
    assert data.qpos[at.q][0] > 0.04
    assert abs(torque[0]) < 5.4


def test_rigid_form_is_the_plain_hinge_with_armature() -> None:
    """Catches all that the rigid form changes beside the rotor's inertia: the motion is MuJoCo's
    to the last bit."""
    spec = rigid_spec(PENDULUM)
    spec.option.timestep = STEP_S
    spec.joint(JOINT).armature = CONSERVATIVE.rotor_inertia
    plain = spec.compile()
    rigid = elastic_spec(PENDULUM, CONSERVATIVE, "rigid", STEP_S).compile()
    expected = mujoco.MjData(plain)
    data = mujoco.MjData(rigid)
    for world in (expected, data):
        world.qpos[0] = 1.2
    mujoco.mj_step(plain, expected, 2000)
    mujoco.mj_step(rigid, data, 2000)
    np.testing.assert_array_equal(data.qpos, expected.qpos)
    np.testing.assert_array_equal(data.qvel, expected.qvel)


def test_a_stiff_joint_moves_like_the_rigid_one() -> None:
    """Catches a joint torque that reaches the link in another size than it leaves the rotor."""
    stiff = FRICTIONLESS.replace(stiffness=1e7, damping=1e3, servo=None)
    q = {}
    for form in ("tendon", "rigid"):
        model = elastic_spec(PENDULUM, stiff, form, 1e-4).compile()
        data = mujoco.MjData(model)
        data.qpos[:] = 1.0
        mujoco.mj_step(model, data, 10_000)
        q[form] = data.joint(JOINT).qpos[0]
    assert abs(q["tendon"] - q["rigid"]) < 1e-5


def test_the_servo_saturates_at_its_torque_limit() -> None:
    """Catches a limit that is not enforced, or an integrator that winds up far beyond it."""
    servo = Servo(
        position_gain=500.0,
        velocity_gain=20.0,
        integral_gain=5000.0,
        torque_limit=30.0,
        speed_limit=2.0,
    )
    model = elastic_spec(PENDULUM, FRICTIONLESS.replace(servo=servo)).compile()
    data = mujoco.MjData(model)
    data.ctrl[:] = 1.5  # needs 60 N·m
    mujoco.mj_step(model, data, round(3.0 / STEP_S))
    np.testing.assert_allclose(data.actuator_force, 30.0, rtol=1e-12)
    assert servo.integral_gain * servo.integral_limit == pytest.approx(30.0 + 20.0 * 2.0)
    error = (
        data.ctrl[0] - data.joint(motor_name(JOINT)).qpos[0]
    )  # MuJoCo stops after the step that passes the limit
    assert servo.integral_limit <= data.act[0] <= servo.integral_limit + 1.5 * error * STEP_S


def test_the_servo_is_a_pid_on_the_rotor() -> None:
    """Catches a gain in the wrong slot, and feedback from the link angle, which no servo sees."""
    servo = Servo(
        position_gain=500.0,
        velocity_gain=20.0,
        integral_gain=70.0,
        torque_limit=1000.0,
        speed_limit=2.0,
    )
    model = elastic_spec(PENDULUM, FRICTIONLESS.replace(servo=servo)).compile()
    data = mujoco.MjData(model)
    at = JointAddresses.of(model, [JOINT])
    data.qpos[at.theta] = 0.2
    data.qpos[at.q] = 0.9
    data.qvel[at.theta_dot] = 0.5
    data.qvel[at.q_dot] = -3.0
    data.ctrl[:] = 0.3
    data.act[:] = 0.4
    mujoco.mj_forward(model, data)
    expected = 500.0 * (0.3 - 0.2) - 20.0 * 0.5 + 70.0 * 0.4
    np.testing.assert_allclose(data.qfrc_actuator[at.theta_dot], expected, rtol=1e-13)
    np.testing.assert_array_equal(data.qfrc_actuator[at.q_dot], 0.0)
    np.testing.assert_allclose(data.act_dot, 0.1, rtol=1e-12)


# --------------------------------------------------------------------------------------------------
# Models that are not ours
# --------------------------------------------------------------------------------------------------


def foreign_cases() -> list[Any]:
    """All models with the hinges that become elastic; Gymnasium's with every hinge they have."""
    cases = [pytest.param(xml, tuple(names), id=name) for name, (xml, names) in MODELS.items()]
    return cases + [pytest.param(path, None, id=path.stem) for path in ASSETS]


def load(source: str | Path) -> mujoco.MjSpec:
    """A specification from MJCF text or from a file."""
    return (
        mujoco.MjSpec.from_string(source)
        if isinstance(source, str)
        else mujoco.MjSpec.from_file(str(source))
    )


def correspondence(rigid: mujoco.MjModel, elastic: mujoco.MjModel) -> tuple[Array, Array]:
    """T_q and T_v with which undeflected states of the elastic model are T_q qpos and T_v qvel of
    the rigid one.

    Every old joint stands for itself, every rotor for the hinge that it drives.
    """
    names = [rigid.joint(i).name for i in range(rigid.njnt)]
    driver = {motor_name(name): i for i, name in enumerate(names) if name}
    new = [elastic.joint(j).name for j in range(elastic.njnt)]
    old = iter(range(rigid.njnt))
    T_q = np.zeros((elastic.nq, rigid.nq))
    T_v = np.zeros((elastic.nv, rigid.nv))
    for j, name in enumerate(new):
        i = driver[name] if name in driver else next(old)
        for T, kind in ((T_q, "qpos"), (T_v, "dof")):
            rows, columns = (
                _columns(model, index, kind) for model, index in ((elastic, j), (rigid, i))
            )
            T[rows, columns] = 1.0
    assert next(old, None) is None
    return T_q, T_v


def _columns(model: mujoco.MjModel, joint: int, kind: str) -> npt.NDArray[np.int64]:
    starts, total = (
        (model.jnt_qposadr, model.nq) if kind == "qpos" else (model.jnt_dofadr, model.nv)
    )
    return np.arange(starts[joint], starts[joint + 1] if joint + 1 < model.njnt else total)


def mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """M, (nv, nv)."""
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    return M


def random_states(
    rigid: mujoco.MjModel, elastic: mujoco.MjModel, count: int = 4
) -> list[tuple[mujoco.MjData, mujoco.MjData, Array]]:
    """The same random undeflected states in both models, forwarded, and the map T_v of their
    velocities."""
    T_q, T_v = correspondence(rigid, elastic)
    generator = np.random.default_rng(7)
    states = []
    for _ in range(count):
        expected = mujoco.MjData(rigid)
        data = mujoco.MjData(elastic)
        mujoco.mj_integratePos(rigid, expected.qpos, generator.uniform(-0.5, 0.5, rigid.nv), 1.0)
        expected.qvel[:] = generator.uniform(-2.0, 2.0, rigid.nv)
        expected.ctrl[:] = generator.uniform(-1, 1, rigid.nu)
        expected.act[:] = generator.uniform(-1, 1, rigid.na)
        data.qpos[:] = T_q @ expected.qpos
        data.qvel[:] = T_v @ expected.qvel
        data.ctrl[: rigid.nu] = expected.ctrl
        data.act[: rigid.na] = expected.act
        mujoco.mj_forward(rigid, expected)
        mujoco.mj_forward(elastic, data)
        states.append((expected, data, T_v))
    return states


@cache
def elastic_from(
    source: str | Path,
    names: tuple[str, ...] | None,
    joint: ElasticJoint = FOREIGN,
    form: Form = "tendon",
) -> tuple[mujoco.MjModel, mujoco.MjModel, list[str]]:
    """Rigid and elastic model, at a step that follows the springs, and the names of the elastic
    hinges."""
    spec = load(source)
    spec.option.timestep = STEP_S
    chosen = list(names) if names is not None else hinges(spec)
    return spec.compile(), make_elastic(spec, dict.fromkeys(chosen, joint), form).compile(), chosen


EVERY_FORM = [
    pytest.param(
        *case.values,
        form,
        id=f"{case.id}-{form}",
        marks=[pytest.mark.slow] * (form == "rigid" and isinstance(case.values[0], Path)),
    )
    for form in ("tendon", "rigid")
    for case in foreign_cases()
]
"""Gymnasium's with rigid rotors at night: what a rotor may bring along is in the others."""


@pytest.mark.parametrize(("source", "names", "form"), EVERY_FORM)
@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated")
def test_total_mass_and_names_are_kept(
    source: str | Path, names: tuple[str, ...] | None, form: Form
) -> None:
    """Catches rotors that weigh something, bodies that vanish and elements that change their
    order."""
    rigid, elastic, _ = elastic_from(source, names, form=form)
    assert elastic.body_mass.sum() == pytest.approx(rigid.body_mass.sum(), rel=0.0, abs=1e-9)
    kinds = [
        "body",
        "joint",
        "geom",
        "site",
        "camera",
        "light",
        "actuator",
        "sensor",
        "equality",
        "tendon",
        "key",
    ]
    for kind in kinds:
        old, new = (_element_names(model, kind) for model in (rigid, elastic))
        assert [name for name in new if name in old and name] == [name for name in old if name], (
            kind
        )
        assert new.count("") >= old.count(""), kind


def _element_names(model: mujoco.MjModel, kind: str) -> list[str]:
    counts = {
        "joint": model.njnt,
        "camera": model.ncam,
        "actuator": model.nactuator,
        "equality": model.neq,
    }
    count = counts.get(kind, getattr(model, f"n{kind}", 0))
    return [getattr(model, kind)(i).name for i in range(count)]


@pytest.mark.parametrize(("source", "names", "form"), EVERY_FORM)
@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated")
def test_undeflected_dynamics_are_those_of_the_rigid_model(
    source: str | Path, names: tuple[str, ...] | None, form: Form
) -> None:
    """Catches all that a rotor may bring along: weight, drag in air or water, defaults of its
    class, lost actuators.

    Where θ = q, the elastic model is the rigid one with B for the armature: Tᵀ M T, Tᵀ c, Tᵀ
    (passive forces) and Tᵀ (actuator forces) must be MuJoCo's for the model as it was.
    """
    rigid, elastic, chosen = elastic_from(source, names, form=form)
    added = np.zeros(rigid.nv)
    for name in chosen:
        added[rigid.joint(name).dofadr[0]] = FOREIGN.rotor_inertia - rigid.joint(name).armature[0]
    for expected, data, T in random_states(rigid, elastic):
        M = mass_matrix(rigid, expected) + np.diag(added)
        np.testing.assert_allclose(T.T @ mass_matrix(elastic, data) @ T, M, rtol=1e-10, atol=1e-9)
        for force in ("qfrc_bias", "qfrc_passive", "qfrc_actuator"):
            projected = T.T @ getattr(data, force)
            np.testing.assert_allclose(
                projected, getattr(expected, force), rtol=1e-9, atol=1e-8, err_msg=force
            )


@pytest.mark.parametrize(("source", "names"), foreign_cases())
@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated")
def test_sensors_contacts_and_limits_are_those_of_the_rigid_model(
    source: str | Path, names: tuple[str, ...] | None
) -> None:
    """Catches sensors that read the rotor, limits that moved or lost their unit, and collisions
    of rotors."""
    rigid, elastic, chosen = elastic_from(source, names)
    by_acceleration = mujoco.mjtStage.mjSTAGE_ACC
    for expected, data, _ in random_states(rigid, elastic):
        assert data.ncon == expected.ncon
        for sensor in range(rigid.nsensor):
            if rigid.sensor_needstage[sensor] != by_acceleration:
                first = rigid.sensor_adr[sensor]
                columns = slice(first, first + rigid.sensor_dim[sensor])
                np.testing.assert_allclose(
                    data.sensordata[columns], expected.sensordata[columns], rtol=0.0, atol=1e-9
                )
    for name in chosen:
        assert elastic.joint(name).limited[0] == rigid.joint(name).limited[0]
        np.testing.assert_array_equal(elastic.joint(name).range, rigid.joint(name).range)
        assert not elastic.joint(motor_name(name)).limited[0]
    np.testing.assert_array_equal(elastic.actuator_ctrlrange[: rigid.nu], rigid.actuator_ctrlrange)
    np.testing.assert_array_equal(
        elastic.actuator_forcerange[: rigid.nactuator], rigid.actuator_forcerange
    )


@pytest.mark.parametrize(
    ("source", "names"),
    [  # test_time_step.py moves Gymnasium's
        pytest.param(
            *case.values, id=case.id, marks=[pytest.mark.slow] * isinstance(case.values[0], Path)
        )
        for case in foreign_cases()
    ],
)
@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated")
def test_foreign_models_run(source: str | Path, names: tuple[str, ...] | None) -> None:
    """Catches models that compile and then blow up."""
    _, model, _ = elastic_from(
        source, names, ElasticJoint(stiffness=2000.0, damping=5.0, rotor_inertia=0.05)
    )
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.2
    mujoco.mj_step(model, data, 100)
    assert np.isfinite(data.qpos).all()
    assert np.isfinite(data.qvel).all()
    assert data.warning.number.sum() == 0
    assert data.time == pytest.approx(0.05)


@pytest.mark.parametrize(("xml", "names"), list(MODELS.values()), ids=list(MODELS))
def test_the_given_specification_is_not_changed(xml: str, names: list[str]) -> None:
    """Catches a transform that works on its argument, or that steals its keyframes."""
    spec = mujoco.MjSpec.from_string(xml)
    before = spec.to_xml()
    make_elastic(spec, dict.fromkeys(names, H54_200_S500_R), actuators="replace")
    assert spec.to_xml() == before


@pytest.mark.parametrize("form", ["tendon", "rigid"])
@pytest.mark.parametrize(("xml", "names"), list(MODELS.values()), ids=list(MODELS))
def test_the_elastic_specification_survives_saving(xml: str, names: list[str], form: Form) -> None:
    """Catches a model that compiles here and not from its own MJCF, the form in which robots are
    passed on.

    Bounds of masses aside: in a file they hold for rotors too.
    """
    spec = mujoco.MjSpec.from_string(xml.replace('boundmass="0.001" boundinertia="1e-5"', ""))
    elastic = make_elastic(spec, dict.fromkeys(names, FOREIGN.replace(servo=HOLDING)), form)
    model = elastic.compile()
    loaded = mujoco.MjModel.from_xml_string(elastic.to_xml())
    assert (loaded.nq, loaded.nv, loaded.nu, loaded.na) == (model.nq, model.nv, model.nu, model.na)
    assert loaded.body_mass.sum() == pytest.approx(model.body_mass.sum(), rel=1e-5)
    forces = []
    for each in (model, loaded):
        data = mujoco.MjData(each)
        data.qpos[:] = model.qpos0
        data.qvel[:] = 0.3
        data.ctrl[:] = 0.2
        mujoco.mj_forward(each, data)
        forces.append(data.qfrc_smooth.copy())
    np.testing.assert_allclose(
        forces[1], forces[0], rtol=1e-4, atol=1e-4
    )  # the text has six digits


@pytest.mark.parametrize("rule", ["keep", "replace"])
@pytest.mark.parametrize("form", ["tendon", "rigid"])
@pytest.mark.parametrize("name", ["quadruped", "arm", "four_bar"])
def test_keyframes_keep_the_links_and_start_without_deflection(
    name: str, form: Form, rule: str
) -> None:
    """Catches keyframe vectors that are shifted by the new joints, rotors left at zero, and lost
    controls."""
    xml, chosen = MODELS[name]
    spec = mujoco.MjSpec.from_string(xml)
    rigid = spec.compile()
    joint = FOREIGN.replace(servo=HOLDING)
    model = make_elastic(spec, dict.fromkeys(chosen, joint), form, rule).compile()
    assert model.nkey == rigid.nkey
    T_q, T_v = correspondence(rigid, model)
    old = [a for a in range(rigid.nactuator) if _survives(rigid, a, chosen, rule)]
    for k in range(rigid.nkey):
        assert model.key(k).name == rigid.key(k).name
        assert model.key_time[k] == rigid.key_time[k]
        np.testing.assert_array_equal(model.key_qpos[k], T_q @ rigid.key_qpos[k])
        np.testing.assert_array_equal(model.key_qvel[k], T_v @ rigid.key_qvel[k])
        np.testing.assert_array_equal(model.key_mpos[k], rigid.key_mpos[k])
        np.testing.assert_array_equal(model.key_mquat[k], rigid.key_mquat[k])
        kept = [rigid.key_ctrl[k, rigid.actuator_ctrladr[a]] for a in old]
        np.testing.assert_array_equal(model.key_ctrl[k, : len(kept)], kept)
        kept = [rigid.key_act[k, rigid.actuator_actadr[a]] for a in old if rigid.actuator_actnum[a]]
        np.testing.assert_array_equal(model.key_act[k, : len(kept)], kept)
        servos = {model.actuator(a).name: a for a in range(model.nactuator)}
        for joint_name in chosen:
            if servo_name(joint_name) in servos:
                command = model.key_ctrl[k, model.actuator_ctrladr[servos[servo_name(joint_name)]]]
                assert command == rigid.key_qpos[k, rigid.joint(joint_name).qposadr[0]]


def _survives(model: mujoco.MjModel, actuator: int, replaced: list[str], rule: str) -> bool:
    return rule == "keep" or model.joint(model.actuator_trnid[actuator, 0]).name not in replaced


@pytest.mark.parametrize("form", ["tendon", "rigid"])
def test_replaced_actuators_make_room_for_the_servo(form: Form) -> None:
    """Catches two actuators on one joint, a servo added uninvited, and sensors of the deleted
    actuator left hanging."""
    spec = mujoco.MjSpec.from_string(QUADRUPED)
    joint = FOREIGN.replace(servo=HOLDING)
    kept = make_elastic(spec, {"front_hip": joint}, form).compile()
    assert kept.nu == 4
    model = make_elastic(spec, {"front_knee": joint, "rear_hip": joint}, form, "replace").compile()
    names = [model.actuator(i).name for i in range(model.nactuator)]
    assert names == ["front_hip", "rear_knee", servo_name("front_knee"), servo_name("rear_hip")]
    assert model.sensor("front_knee_force").objid[0] == model.actuator(servo_name("front_knee")).id


NASTY = """<mujoco><compiler angle="degree"/><option timestep="0.001"/>
  <default>
    <joint damping="3 1 2" stiffness="7 1 1" springref="20" springyield="1" frictionloss="2" armature="4" margin="0.1"
      limited="true" range="-5 5" solreflimit="0.5 0.3" solimplimit="0.1 0.2 0.3" solreffriction="0.4 0.4"
      actuatorfrcrange="-1 1" actuatorgravcomp="true" ref="11" pos="1 2 3" axis="1 1 1"/>
    <tendon damping="3 1 1" stiffness="7 1 1" springlength="0.1 0.4" springyield="0.005" frictionloss="2" armature="4"
      margin="0.1" limited="true" range="-0.01 0.01" solreflimit="0.5 0.3" solreffriction="0.4 0.4"
      actuatorfrcrange="-1 1"/>
    <general damping="3 1 1" armature="4" gear="9 8 7 6 5 4" forcerange="-1 1" delay="0.01" nsample="10"
      interp="linear" gainprm="3 4 5" biasprm="6 7 8" dynprm="9 9" cranklength="2" {actuator}/>
    <default class="child"><joint damping="9" springyield="2"/></default>
  </default>
  <worldbody><body name="base" childclass="child"><body name="b"><joint name="h" {hinge}/>{inertial}</body></body>
  </worldbody></mujoco>"""
PLAIN = """<mujoco><compiler angle="degree"/><option timestep="0.001"/>
  <worldbody><body name="base"><body name="b"><joint name="h" {hinge}/>{inertial}</body></body></worldbody></mujoco>"""
GIVEN = {
    "hinge": (
        """pos="0 0 0" axis="0 1 0" ref="0" limited="false" margin="0" actuatorfrcrange="-25 25"
        actuatorgravcomp="false" armature="0" damping="0 0 0" stiffness="0 0 0" springref="0" springyield="0"
        frictionloss="0" """
    ),
    "inertial": '<inertial pos="0 0 -0.3" mass="2" diaginertia="0.1 0.1 0.1"/>',
}


@pytest.mark.parametrize("integral_gain", [0.0, 2000.0], ids=["pd", "pid"])
@pytest.mark.parametrize(
    "actuator",
    [
        "",
        'ctrlrange="-0.1 0.1"',
        'inheritrange="1"',
        'actlimited="true" actrange="-0.001 0.001" dyntype="filter" actearly="true"',
    ],
    ids=["gains", "ctrlrange", "inheritrange", "activation"],
)
def test_defaults_of_the_model_do_not_leak(actuator: str, integral_gain: float) -> None:
    """Catches any attribute of rotor, spring or servo that is left to the model's default class,
    down to plasticity.

    All attributes of the hinge are given, so with and without defaults the joint must move alike,
    bit for bit.
    """
    servo = Servo(
        position_gain=500.0,
        velocity_gain=20.0,
        integral_gain=integral_gain,
        torque_limit=30.0,
        speed_limit=3.0,
    )
    joint = FOREIGN.replace(servo=servo, backlash=0.01, viscous_friction=0.1)
    nasty, plain = (
        make_elastic(
            mujoco.MjSpec.from_string(xml.format(actuator=actuator, **GIVEN)), {"h": joint}
        ).compile()
        for xml in (NASTY, PLAIN)
    )
    worlds = [mujoco.MjData(model) for model in (nasty, plain)]
    for model, data in zip((nasty, plain), worlds, strict=True):
        data.ctrl[:] = 0.7
        mujoco.mj_step(model, data, 300)
    assert worlds[1].qpos.max() > 0.3
    suspects = "\n".join(_suspects(nasty, plain))
    np.testing.assert_array_equal(worlds[0].qpos, worlds[1].qpos, err_msg=suspects)


def _suspects(nasty: mujoco.MjModel, plain: mujoco.MjModel) -> list[str]:
    """Fields of the elements we made that differ between two models, appearance and addresses
    aside."""
    elements = [
        ("jnt", "joint", motor_name("h")),
        ("tendon", "tendon", spring_name("h")),
        ("actuator", "actuator", "h_servo"),
    ]
    irrelevant = ("adr", "id", "group", "rgba", "width", "user", "num", "signature")
    suspects = []
    for prefix, kind, name in elements:
        fields = [
            f for f in dir(plain) if f.startswith(f"{prefix}_") and not f.endswith(irrelevant)
        ]
        a, b = (getattr(model, kind)(name).id for model in (nasty, plain))
        values = [(f, getattr(nasty, f)[a], getattr(plain, f)[b]) for f in fields]
        suspects += [f"{f}: {x} instead of {y}" for f, x, y in values if not np.array_equal(x, y)]
    return suspects


@pytest.mark.parametrize("child_in_degrees", [True, False])
def test_angles_of_an_attached_model_keep_their_unit(child_in_degrees: bool) -> None:
    """Catches a rotor whose ref is read in the parent's unit: an arm written in radians on a
    base in degrees."""
    unit = "degree" if child_in_degrees else "radian"
    value = {"degree": "30", "radian": str(np.deg2rad(30.0))}[unit]
    child = mujoco.MjSpec.from_string(
        f"""<mujoco><compiler angle="{unit}"/><worldbody><body name="b"><joint name="h" axis="0 1 0" ref="{value}"
        range="0 {value}"/><geom size="0.1" pos="0 0 0.2"/></body></worldbody>
        <actuator><position name="p" joint="h" inheritrange="1"/></actuator></mujoco>"""
    )
    parent = mujoco.MjSpec()
    parent.compiler.degree = not child_in_degrees
    parent.attach(child, frame=parent.worldbody.add_frame(), prefix="arm_")
    model = make_elastic(parent, {"arm_h": FOREIGN}).compile()
    np.testing.assert_allclose(model.qpos0, np.deg2rad(30.0), rtol=1e-14)
    np.testing.assert_allclose(model.joint("arm_h").range, [0.0, np.deg2rad(30.0)], rtol=1e-14)
    np.testing.assert_allclose(
        model.actuator("arm_p").ctrlrange, [0.0, np.deg2rad(30.0)], rtol=1e-14
    )


def test_at_rest_the_springs_carry_what_the_rigid_robot_needs() -> None:
    """Catches a deflection that is not τ/K: the arm settles where MuJoCo's inverse dynamics says
    so."""
    spec = mujoco.MjSpec.from_string(ARM)
    rigid = spec.compile()
    names = ["yaw", "pitch", "roll", "elbow"]
    joint = ElasticJoint(stiffness=800.0, damping=20.0, rotor_inertia=0.1, servo=HOLDING)
    model = make_elastic(spec, dict.fromkeys(names, joint), actuators="replace").compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_step(model, data, 6000)
    assert np.abs(data.qvel).max() < 1e-4
    at = JointAddresses.of(model, names)
    links = np.array([model.joint(rigid.joint(i).name).qposadr[0] for i in range(rigid.njnt)])
    held = mujoco.MjData(rigid)
    held.qpos[:] = data.qpos[links]
    mujoco.mj_inverse(rigid, held)
    torque = 800.0 * (data.qpos[at.theta] - data.qpos[at.q])
    needed = held.qfrc_inverse[at_rigid(rigid, names)]
    assert np.abs(needed).max() > 5.0
    np.testing.assert_allclose(torque[:3], needed[:3], rtol=0.0, atol=0.01)
    assert abs(torque[3] - needed[3]) < 0.5  # the elbow has dry friction, and keeps it


def at_rigid(model: mujoco.MjModel, names: list[str]) -> list[int]:
    """Columns of hinges in qvel."""
    return [int(model.joint(name).dofadr[0]) for name in names]


def test_legs_of_a_floating_robot_conserve_its_momentum() -> None:
    """Catches rotors that push against the world: motors of a free base can move its legs, not
    its center of mass."""
    spec = mujoco.MjSpec.from_string(QUADRUPED)
    spec.option.gravity = np.zeros(3)
    joints = dict.fromkeys(MODELS["quadruped"][1], FOREIGN.replace(rotor_inertia=0.02))
    model = make_elastic(spec, joints).compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[2] = 3.0
    start = data.qpos.copy()
    data.ctrl[:] = [0.2, -0.9, 0.8, -1.8]
    for _ in range(10):
        mujoco.mj_step(model, data, 40)
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        np.testing.assert_allclose(
            model.body_subtreemass[0] * data.subtree_linvel[0], 0.0, atol=1e-5
        )
        np.testing.assert_allclose(data.subtree_angmom[0], 0.0, atol=1e-5)
    assert np.abs(data.qpos - start)[7:].max() > 0.3
    assert data.ncon == 0


def test_a_position_actuator_moves_the_rotor_and_the_link_follows() -> None:
    """Catches an actuator that was left on the link, where it would bypass the spring."""
    spec = mujoco.MjSpec.from_string(FOUR_BAR)
    model = make_elastic(spec, dict.fromkeys(["crank", "rocker"], FOREIGN)).compile()
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.2
    mujoco.mj_forward(model, data)
    at = JointAddresses.of(model, ["crank"])
    np.testing.assert_allclose(data.qfrc_actuator[at.theta_dot], 30.0 * 0.2, rtol=1e-12)
    np.testing.assert_array_equal(data.qfrc_actuator[at.q_dot], 0.0)
    mujoco.mj_step(model, data, 6000)
    torque = FOREIGN.stiffness * (data.qpos[at.theta] - data.qpos[at.q])
    np.testing.assert_allclose(torque, data.actuator_force, rtol=0.0, atol=0.02)
    assert data.qpos[at.q][0] > 0.05


def test_a_closed_loop_stays_closed() -> None:
    """Catches equalities that hold rotors together in place of links."""
    spec = mujoco.MjSpec.from_string(FOUR_BAR)
    model = make_elastic(spec, dict.fromkeys(["crank", "rocker"], FOREIGN)).compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("straight").id)
    data.ctrl[:] = 0.5
    for _ in range(20):
        mujoco.mj_step(model, data, 100)
        pin = data.body("coupler").xpos + data.body("coupler").xmat.reshape(3, 3) @ [0.5, 0.0, 0.1]
        np.testing.assert_allclose(pin, data.site("tip").xpos, rtol=0.0, atol=1e-3)
    assert data.joint("rocker").qpos[0] > 0.1


def test_a_mimic_equality_still_couples_the_links() -> None:
    """Catches an equality that compares a link with a rotor: the finger follows the link, not
    the motor."""
    spec = mujoco.MjSpec.from_string(ARM)
    soft = ElasticJoint(stiffness=0.2, damping=0.01, rotor_inertia=0.001)
    model = make_elastic(spec, {"left_finger": soft}).compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.ctrl[model.actuator("grip").id] = 0.6
    mujoco.mj_step(model, data, 200)
    left = data.joint("left_finger").qpos[0]
    right = data.joint("right_finger").qpos[0]
    rotor = data.joint(motor_name("left_finger")).qpos[0]
    assert abs(rotor - left) > 0.01
    assert right == pytest.approx(0.1 - 0.8 * left + 0.05 * left**2, abs=2e-3)


def test_limits_stop_the_link_and_the_rotor_winds_the_spring() -> None:
    """Catches a limit on the rotor: at the stop the spring takes what the servo has."""
    servo = Servo(position_gain=500.0, velocity_gain=20.0, torque_limit=40.0, speed_limit=2.0)
    spec = rigid_spec(PENDULUM, gravity=0.0)
    spec.joint(JOINT).range = [-0.2, 0.2]
    spec.joint(JOINT).limited = mujoco.mjtLimited.mjLIMITED_TRUE
    model = make_elastic(spec, {JOINT: FRICTIONLESS.replace(servo=servo)}).compile()
    data = mujoco.MjData(model)
    at = JointAddresses.of(model, [JOINT])
    data.ctrl[:] = 0.5
    mujoco.mj_step(model, data, 3000)
    assert data.qpos[at.q][0] == pytest.approx(0.2, abs=5e-3)
    torque = FRICTIONLESS.stiffness * (data.qpos[at.theta] - data.qpos[at.q])
    np.testing.assert_allclose(torque, 40.0, rtol=1e-3)


def test_the_force_range_of_a_hinge_limits_its_rotor() -> None:
    """Catches a torque limit that stays on the link, where no actuator acts any more."""
    spec = mujoco.MjSpec.from_string(ARM)
    spec.actuator("yaw_motor_drive").gear = [100.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    model = make_elastic(spec, {"yaw": FOREIGN}).compile()
    data = mujoco.MjData(model)
    data.ctrl[0] = 1.0
    mujoco.mj_forward(model, data)
    assert data.qfrc_actuator[model.joint(motor_name("yaw")).dofadr[0]] == 60.0


@pytest.mark.parametrize("speed", [5.0, pytest.param(-8.0, marks=pytest.mark.slow)])
def test_wheels_on_velocity_actuators_roll(speed: float) -> None:
    """Catches unnamed actuators that stay on the link; the springs wind up by the torque over K,
    not without end."""
    spec = mujoco.MjSpec.from_string(ROVER)
    spec.option.density = spec.option.viscosity = 0.0
    joint = ElasticJoint(stiffness=40.0, damping=0.3, rotor_inertia=0.01)
    model = make_elastic(spec, dict.fromkeys(["left", "right"], joint)).compile()
    data = mujoco.MjData(model)
    data.ctrl[:2] = speed
    mujoco.mj_step(model, data, 4000)
    before = data.joint("root").qpos[0]
    mujoco.mj_step(model, data, 1000)
    at = JointAddresses.of(model, ["left", "right"])
    np.testing.assert_allclose(data.qvel[at.theta_dot], speed, rtol=0.05)
    deflection = data.qpos[at.theta] - data.qpos[at.q]
    np.testing.assert_allclose(40.0 * deflection, data.actuator_force[:2], rtol=0.0, atol=0.05)
    assert (data.joint("root").qpos[0] - before) / 0.5 == pytest.approx(0.1 * speed, rel=0.1)


def test_joint_addresses_find_rotor_and_link() -> None:
    """Catches addresses in the order of the model instead of the order asked for; rigid: both
    are the hinge."""
    spec = mujoco.MjSpec.from_string(QUADRUPED)
    names = ["rear_knee", "front_hip"]
    model = make_elastic(spec, {"front_hip": FOREIGN}).compile()
    at = JointAddresses.of(model, names)
    assert at.q.tolist() == [model.joint(name).qposadr[0] for name in names]
    expected = [
        model.joint("rear_knee").qposadr[0],
        model.joint(motor_name("front_hip")).qposadr[0],
    ]
    assert at.theta.tolist() == expected
    assert at.theta_dot.tolist() == [
        address - 1 for address in expected
    ]  # a free joint has one qpos more than dofs


# --------------------------------------------------------------------------------------------------
# Errors
# --------------------------------------------------------------------------------------------------


def test_an_unknown_hinge_lists_the_hinges() -> None:
    """Catches a silent no-op, and an error without the choices; joints that are no hinges are
    not among them."""
    spec = mujoco.MjSpec.from_string(ROVER)
    with pytest.raises(
        ConfigurationError, match=r"unknown hinge 'lft'; choose one of: left, right, pan\..*'left'"
    ):
        make_elastic(spec, {"lft": FOREIGN})
    with pytest.raises(ConfigurationError, match="unknown hinge 'root'"):
        make_elastic(spec, {"root": FOREIGN})


@pytest.mark.parametrize("joints", [5, ["left"], {"left": 1000.0}, {"left": {"stiffness": 1000.0}}])
def test_what_is_no_mapping_of_joints_says_so(joints: Any) -> None:
    """Catches an AttributeError for a stiffness in the place of a joint."""
    with pytest.raises(ConfigurationError, match="mapping from names of hinges to ElasticJoint, g"):
        make_elastic(mujoco.MjSpec.from_string(ROVER), joints)


def test_an_unknown_form_or_rule_lists_the_choices() -> None:
    """Catches a form that falls through to another one."""
    spec = mujoco.MjSpec.from_string(ROVER)
    with pytest.raises(
        ConfigurationError, match="unknown form 'tendons'; choose one of: tendon, rigid"
    ):
        make_elastic(spec, {"left": FOREIGN}, "tendons")
    with pytest.raises(
        ConfigurationError, match="unknown actuator rule 'drop'; choose one of: keep, replace"
    ):
        make_elastic(spec, {"left": FOREIGN}, actuators="drop")


def test_an_elastic_hinge_is_not_made_elastic_again() -> None:
    """Catches a second spring in series with the first."""
    once = make_elastic(mujoco.MjSpec.from_string(QUADRUPED), {"front_hip": FOREIGN})
    with pytest.raises(
        ConfigurationError, match=r"'front_hip_\w+' already exists .* elastic already"
    ):
        make_elastic(once, {"front_hip": FOREIGN})


@pytest.mark.parametrize(
    "element",
    [
        '<body name="h_motor"><geom size="0.1"/></body>',
        '<body name="h_spring"><geom size="0.1"/></body>',
    ],
    ids=["motor", "spring"],
)
def test_a_body_may_have_any_name(element: str) -> None:
    """Catches a clash with a body of the robot: names of bodies, joints and tendons are separate in
    MuJoCo.

    A motor housing is often a body of its own, called after its joint. Either the transform copes,
    or it says so.
    """
    xml = f"""<mujoco><worldbody><body><joint name="h" axis="0 1 0"/><geom size="0.1" pos="0 0 0.3"/>{element}</body>
      </worldbody></mujoco>"""
    try:
        model = make_elastic(mujoco.MjSpec.from_string(xml), {"h": FOREIGN}).compile()
    except ConfigurationError as error:
        assert "h_motor" in str(error)  # noqa: PT017  either answer is right
    else:
        assert spring_name("h") in [model.tendon(i).name for i in range(model.ntendon)]
