"""Friction that changes with load and speed, and the DC motor, in MuJoCo: closed forms, energy,
worlds alike."""

import copy
import pickle
import warnings
from typing import Any

import mujoco
import numpy as np
import pytest

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.elastic_joint import ElasticJoint, Servo
from elastic_env.joint.elasticity import joint_torque
from elastic_env.joint.friction import dry_friction, passed_torque
from elastic_env.joint.joint_names import JointAddresses, motor_name, servo_name
from elastic_env.joint.make_elastic import Form, make_elastic, transform_hinges
from elastic_env.joint.model_servo import position_servo
from elastic_env.joint.motor import Motor, terminal_speed
from elastic_env.joint.mujoco_friction import VaryingFriction
from elastic_env.world.drawn_robot import set_joints
from elastic_env.world.many_worlds import ManyWorlds, simulate
from elastic_env.world.robot_ranges import RobotRanges, draw_robot
from elastic_env.world.scenario import Scenario
from elastic_env.world.worlds import SingleWorld

MOTOR = Motor(torque_constant=0.4, back_emf=0.5, resistance=3.0, voltage=5.0, pwm_limit=0.9)
SERVO = Servo(position_gain=20.0, velocity_gain=0.2, torque_limit=2.0, speed_limit=9.0)
JOINT = ElasticJoint(
    stiffness=40.0,
    damping=0.02,
    rotor_inertia=0.004,
    coulomb_friction=0.05,
    load_friction=0.4,
    static_friction=0.03,
    stribeck_speed=0.1,
    servo=SERVO,
)
STEADY = JOINT.replace(static_friction=0.0, stribeck_speed=0.0)
LINK_INERTIA = 0.005


def rigid_spec(gravity: float = 0.0, timestep_s: float = 5e-4) -> mujoco.MjSpec:
    """A balanced link, or with gravity a pendulum of 0.4905 N·m, on the hinge `q`."""
    spec = mujoco.MjSpec()
    spec.option.gravity = [0.0, 0.0, -gravity]
    spec.option.timestep = timestep_s
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    link = spec.worldbody.add_body(
        name="link",
        mass=0.5,
        ipos=[0.0, 0.0, -0.1 * bool(gravity)],
        inertia=[LINK_INERTIA] * 3,
        explicitinertial=True,
    )
    link.add_joint(name="q", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0.0, -1.0, 0.0])
    return spec


def plant(joint: ElasticJoint, form: Form = "tendon", gravity: float = 0.0) -> mujoco.MjModel:
    """The link on an elastic joint."""
    return transform_hinges(rigid_spec(gravity), {"q": joint}, form).compile()


def turn(
    model: mujoco.MjModel, speed: float, load: float, time_s: float = 1.2
) -> tuple[mujoco.MjData, SingleWorld]:
    """Drive a joint at a speed against a constant torque on its link [rad/s], [N·m]."""
    world = SingleWorld(model)
    data = world._data
    data.qfrc_applied[model.joint("q").dofadr[0]] = -load
    for step in range(round(time_s / model.opt.timestep)):
        data.ctrl[0] = speed * step * model.opt.timestep
        world.advance(1)
    return data, world


@pytest.mark.parametrize(
    ("form", "load", "speed"),
    [
        *(("tendon", load, speed) for load in (0.6, -0.2, 0.02) for speed in (0.07, -0.07)),
        ("rigid", 0.6, 0.07),
        ("rigid", -0.2, -0.07),
        *(
            pytest.param("rigid", *turned, marks=pytest.mark.slow)
            for turned in ((0.6, -0.07), (-0.2, 0.07), (0.02, 0.07), (0.02, -0.07))
        ),
    ],
)
def test_a_load_that_slides_up_or_down_takes_its_share(
    form: Form, load: float, speed: float
) -> None:
    """Catches a share of the wrong torque: what is lost is a share of what the spring passes.

    Up a slope of load τ_J = (τ + F₀)/(1 − c), down it τ_J = (τ − F₀)/(1 + c).
    """
    data, _ = turn(plant(STEADY, form), speed, load)
    sign = np.sign(speed)
    expected = passed_torque(np.array(load), sign, STEADY.coulomb_friction, STEADY.load_friction)
    up = (load + sign * 0.05) / (1.0 - 0.4 * sign * np.sign(load + sign * 0.05))
    assert float(expected) == pytest.approx(up, rel=1e-12)
    held = SERVO.position_gain * abs(speed) * 5e-4  # the command moves once a step
    assert data.actuator_force[0] == pytest.approx(up, abs=held)
    if form == "tendon":
        assert 40.0 * data.ten_length[0] == pytest.approx(up, rel=1e-3, abs=1e-4)


def test_a_dead_band_carries_no_load() -> None:
    """Catches a load that is taken from the whole deflection."""
    data, _ = turn(plant(STEADY.replace(backlash=0.02)), speed=0.07, load=0.6)
    wound = data.ten_length[0] - 0.01
    assert 40.0 * wound == pytest.approx((0.6 + 0.05) / 0.6, rel=1e-3)


@pytest.mark.parametrize("beyond", [0.98, 1.02])
@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("preload", [0.5, -0.3, 0.0])
def test_a_joint_rests_within_its_band_and_not_beyond(
    preload: float, side: float, beyond: float
) -> None:
    """Catches a band that does not grow with the load, or lacks the excess at rest:
    |τ_J − τ| ≤ F₀ + F_s + c |τ_J|."""
    model = plant(JOINT)
    world = SingleWorld(model)
    data = world._data
    theta = preload / JOINT.stiffness
    data.qpos[model.joint(motor_name("q")).qposadr[0]] = theta
    data.ctrl[0] = theta + preload / SERVO.position_gain
    band = 0.05 + 0.03 + 0.4 * abs(preload)
    data.qfrc_applied[model.joint("q").dofadr[0]] = side * beyond * band - preload
    world.advance(400)
    moved = abs(data.joint("q").qpos[0])
    assert moved < 1e-5 if beyond < 1.0 else moved > 5e-5


@pytest.mark.parametrize("joint", [JOINT, STEADY], ids=["stribeck", "load"])
def test_friction_only_takes_energy(joint: ElasticJoint) -> None:
    """Catches a friction that pushes: of a swinging pendulum without damper and servo, energy
    never grows; without friction it stays."""
    bare = joint.replace(damping=0.0, servo=None)
    free = bare.replace(
        coulomb_friction=0.0, load_friction=0.0, static_friction=0.0, stribeck_speed=0.0
    )
    energies: list[Array] = []
    for one in (bare, free):
        model = plant(one, gravity=9.81)
        model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
        model.opt.timestep = 1e-4
        world = SingleWorld(model)
        world.qpos[0] = [0.9, 0.9]
        energy: list[float] = []
        for _ in range(2000):
            world.refresh(np.array([True]))
            energy.append(float(world._data.energy.sum()))
            world.advance(1)
        energies.append(np.array(energy))
    rubbed, kept = energies
    assert np.ptp(kept) < 1e-9
    assert np.diff(rubbed).max() < 1e-9
    assert rubbed[0] - rubbed[-1] > 0.02


@pytest.mark.parametrize("form", ["tendon", "rigid"])
@pytest.mark.parametrize("load", [0.0, 0.12, pytest.param(-0.1, marks=pytest.mark.slow)])
def test_a_motor_under_load_reaches_the_speed_of_the_closed_form(form: Form, load: float) -> None:
    """Catches a back-EMF that MuJoCo's driver compensates, and a gear loss k_t < k_e that is
    lost."""
    joint = STEADY.replace(servo=SERVO.replace(motor=MOTOR), viscous_friction=0.01)
    model = plant(joint, form)
    data = turn(model, speed=1e3, load=load, time_s=1.8)[0]
    speed = 0.0
    for _ in range(60):  # viscous friction is a load of the gear, too
        passed = passed_torque(np.array(load + 0.01 * speed), 1.0, 0.05, 0.4)
        speed = float(terminal_speed(MOTOR, passed))
    assert data.joint("q").qvel[0] == pytest.approx(speed, rel=1e-3)


@pytest.mark.parametrize("limit", [2.0, 0.3])
def test_a_blocked_motor_gives_its_stall_torque_or_that_of_its_current_limit(limit: float) -> None:
    """Catches a PWM limit that is left out, and a supply that is not scaled with the constants."""
    joint = STEADY.replace(servo=SERVO.replace(motor=MOTOR, torque_limit=limit))
    model = plant(joint)
    data = turn(model, speed=1e3, load=50.0)[0]
    blocked = mujoco.MjData(model)
    blocked.ctrl[0] = 10.0
    mujoco.mj_forward(model, blocked)
    assert blocked.actuator_force[0] == pytest.approx(min(0.6, limit), rel=1e-12)
    assert data.actuator_force[0] <= min(2.0, limit) + 1e-9


def test_the_motor_of_mujoco_is_that_of_the_closed_form() -> None:
    """Catches any term of PID, voltage limit, back-EMF and current limit, at states of all kinds."""
    servo = SERVO.replace(motor=MOTOR, torque_limit=0.5, integral_gain=30.0)
    model = plant(STEADY.replace(servo=servo))
    data = mujoco.MjData(model)
    generator = np.random.default_rng(3)
    at = model.joint(motor_name("q"))
    for _ in range(200):
        goal, theta, theta_dot, windup = generator.uniform(-0.2, 0.2, 4) * [1.0, 1.0, 50.0, 0.5]
        data.ctrl[0] = goal
        data.qpos[at.qposadr[0]] = theta
        data.qvel[at.dofadr[0]] = theta_dot
        data.act[0] = windup
        mujoco.mj_forward(model, data)
        wanted = 20.0 * (goal - theta) - 0.2 * theta_dot + 30.0 * windup
        stall = 0.4 * 5.0 * 0.9 / 3.0
        torque = np.clip(wanted, -stall, stall) - 0.4 * 0.5 / 3.0 * theta_dot
        assert data.actuator_force[0] == pytest.approx(np.clip(torque, -0.5, 0.5), abs=1e-12)


def swing(simulation: Any, steps: int = 60) -> Array:
    """States of worlds that follow different commands, (steps, num_worlds, nq + nv)."""
    states: list[Array] = []
    phase = np.arange(simulation.num_worlds)
    for step in range(steps):
        simulation.ctrl[:, 0] = 0.8 * np.sin(0.3 * step + phase)
        simulation.advance(8)
        states.append(np.concatenate([simulation.qpos, simulation.qvel], axis=1).copy())
    return np.array(states)


@pytest.mark.parametrize("form", ["tendon", "rigid"])
def test_many_worlds_are_one_world_bit_for_bit(form: Form) -> None:
    """Catches friction of another world, or of another step."""
    joint = JOINT.replace(servo=SERVO.replace(motor=MOTOR))
    model = plant(joint, form, gravity=9.81)
    many = swing(ManyWorlds(model, 3, num_threads=2))
    np.testing.assert_array_equal(many[:, :1], swing(SingleWorld(model)))
    assert not np.array_equal(many[:, 0], many[:, 1])


def through_pickle(one: Any) -> Any:
    """What a process receives of it."""
    return pickle.loads(pickle.dumps(one))


@pytest.mark.parametrize(
    ("copied", "num_worlds"),
    [
        (copy.deepcopy, 1),
        (through_pickle, 2),
        pytest.param(copy.deepcopy, 2, marks=pytest.mark.slow),
        pytest.param(through_pickle, 1, marks=pytest.mark.slow),
    ],
)
def test_a_copy_goes_on_as_its_original(num_worlds: int, copied: Any) -> None:
    """Catches friction that a copy forgets, or that it shares."""
    simulation = simulate(plant(JOINT, gravity=9.81), num_worlds)
    swing(simulation, 10)
    np.testing.assert_array_equal(swing(copied(simulation)), swing(simulation))


def test_a_loop_of_the_user_is_the_simulation() -> None:
    """Catches an update that forgets a joint or a term, and a warning that is not said."""
    with pytest.warns(UserWarning, match=r"friction of q changes .*VaryingFriction\(model\)"):
        model = make_elastic(rigid_spec(9.81), {"q": JOINT}).compile()
    known = swing(SingleWorld(plant(JOINT, gravity=9.81)))[:, 0]
    data = mujoco.MjData(model)
    friction = VaryingFriction(model)
    assert friction.joints == ["q"]
    for step, expected in enumerate(known):
        data.ctrl[0] = 0.8 * np.sin(0.3 * step)
        for _ in range(8):
            friction.update(model, data)
            mujoco.mj_step(model, data)
        np.testing.assert_array_equal([*data.qpos, *data.qvel], expected)


def test_a_model_keeps_its_friction_through_a_file() -> None:
    """Catches terms that are lost where a model is written and read again."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        spec = make_elastic(rigid_spec(9.81), {"q": JOINT})
    spec.compile()
    again = mujoco.MjModel.from_xml_string(spec.to_xml())
    np.testing.assert_allclose(swing(SingleWorld(again)), swing(SingleWorld(spec.compile())))


def test_where_friction_does_not_vary_nothing_is_added() -> None:
    """Catches a cost for joints without it: neither numbers, nor a step of its own, nor a field."""
    model = plant(JOINT.replace(load_friction=0.0, static_friction=0.0))
    assert model.nnumeric == 0
    assert VaryingFriction.of(model) is None
    many = ManyWorlds(model, 2)
    many.advance(3)
    assert not many._varied
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_elastic(rigid_spec(), {"q": JOINT.replace(load_friction=0.0, static_friction=0.0)})


def test_a_servo_with_a_motor_keeps_its_name() -> None:
    """Catches an actuator that policies do not find."""
    model = plant(STEADY.replace(servo=SERVO.replace(motor=MOTOR)))
    assert model.actuator(0).name == servo_name("q")


def test_a_motor_of_the_model_is_not_read_in_silence() -> None:
    """Catches a DC motor that is taken for no servo, and replaced by an assumed one."""
    text = """<mujoco><worldbody><body name="link"><joint name="q"/>
      <inertial mass="0.5" pos="0 0 -0.1" diaginertia="0.001 0.001 0.001"/></body></worldbody>
      <actuator><dcmotor joint="q" motorconst="0.4 0.5" resistance="3" input="pos"
        controller="5 0 0.2 0 0 4"/></actuator></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    with pytest.raises(ConfigurationError, match=r"joint 'q' has a dcmotor.*`motor`.*`servo`"):
        position_servo(model, "q")


def test_a_drawn_robot_has_its_own_varying_friction() -> None:
    """Catches draws that reach constant friction alone, or another world."""
    model = plant(JOINT)
    many = ManyWorlds(model, 2)
    drawn = draw_robot([RobotRanges(friction=(0.5, 0.5))], 1, np.random.default_rng(1))
    links = np.array([model.joint("q").dofadr[0]])
    set_joints(lambda name: many.vary(name)[1], model, np.array([0]), links, drawn, Scenario())
    friction = VaryingFriction(model)
    limits = friction.limits(many._field, many.bind)[:, 0]
    np.testing.assert_allclose(limits, [0.08, 0.04])


@pytest.mark.parametrize("stribeck_speed", [0.2, 0.0])
@pytest.mark.parametrize("form", ["tendon", "rigid"])
def test_the_kernel_is_the_formulas(form: Form, stribeck_speed: float) -> None:
    """Catches a term that the compiled friction has otherwise, in worlds with own parameters."""
    model = plant(JOINT, form)
    friction = VaryingFriction(model)
    at = JointAddresses.of(model, ["q"])
    generator = np.random.default_rng(4)
    terms, spring = generator.uniform(0.02, 0.2, (2, 4, 40))
    terms[3] = stribeck_speed
    state = {
        name: generator.normal(scale=0.2, size=(40, model.nv))
        for name in ("qpos", "qvel", "qacc", "qfrc_actuator")
    }
    state["qvel"][::4] = 0.0
    field = {
        "numeric_data": terms.T,
        "tendon_stiffness": spring[:1].T,
        "tendon_damping": spring[1:2].T,
        "tendon_lengthspring": spring[2:].T[:, None] * [-1.0, 1.0],
        "dof_armature": model.dof_armature[None],
    }
    if form == "tendon":
        deflection = state["qpos"][:, at.theta[0]] - state["qpos"][:, at.q[0]]
        rate = state["qvel"][:, at.theta_dot[0]] - state["qvel"][:, at.q_dot[0]]
        load = joint_torque(deflection, rate, spring[0], spring[1], spring[2] + spring[3])
    else:
        load = (state["qfrc_actuator"] - model.dof_armature * state["qacc"])[:, 0]
    expected = dry_friction(state["qvel"][:, friction.links[0]], load, *terms)
    limits = friction.limits(field.__getitem__, state.__getitem__)
    np.testing.assert_allclose(limits[:, 0], expected, rtol=1e-14)
