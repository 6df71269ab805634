"""The largest stable physics step against closed forms, and against MuJoCo itself."""

import copy
import warnings
from contextlib import nullcontext
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest

import elastic_env  # noqa: F401  registers the environments
from elastic_env.core.errors import ConfigurationError
from elastic_env.joint.elastic_joint import ElasticJoint, Servo
from elastic_env.joint.make_elastic import make_elastic, transform_hinges
from elastic_env.joint.time_step import largest_stable_timestep

SPRING = """<mujoco><option timestep="0.01" integrator="{integrator}" gravity="0 0 0"/><worldbody><body>
  <joint type="slide" axis="1 0 0" stiffness="{stiffness}"/><geom size=".1" mass="4"/></body></worldbody></mujoco>"""
SERVO = Servo(position_gain=2e3, velocity_gain=100.0, torque_limit=50.0, speed_limit=3.0)


@pytest.mark.parametrize(
    ("integrator", "limit"), [("Euler", 2.0), ("implicitfast", 2.0), ("RK4", 2.0 * np.sqrt(2.0))]
)
def test_a_spring_without_damper_has_the_limit_of_the_textbook(
    integrator: str, limit: float
) -> None:
    """Catches a wrong state, and differences in place of the integrator's own step: ωh < 2, or
    2√2 of RK4."""
    model = mujoco.MjModel.from_xml_string(SPRING.format(integrator=integrator, stiffness=4e6))
    omega = np.sqrt(4e6 / 4.0)
    assert omega * largest_stable_timestep(model) == pytest.approx(limit, rel=2e-3)


def test_a_model_that_no_step_follows_is_refused_without_messages_of_mujoco(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Catches a hundred warnings before the one sentence, and a file in the user's folder."""
    monkeypatch.chdir(tmp_path)
    model = mujoco.MjModel.from_xml_string(SPRING.format(integrator="Euler", stiffness=1e30))
    with pytest.raises(ConfigurationError, match="no physics step from"):
        largest_stable_timestep(model)
    assert (capfd.readouterr(), list(tmp_path.iterdir())) == (("", ""), [])
    data = mujoco.MjData(model)
    data.qpos[0] = np.nan
    mujoco.mj_checkPos(model, data)  # elsewhere warnings are said as before
    assert (tmp_path / "MUJOCO_LOG.TXT").is_file()


@pytest.mark.parametrize(
    ("stiffness", "is_refused"),
    [(4e4, False), (6e4, True), pytest.param(1e5, True, marks=pytest.mark.slow)],
)
def test_a_walker_that_would_explode_is_refused_with_the_largest_step(
    stiffness: float, is_refused: bool
) -> None:
    """Catches a stiffness that ends as "fell" with joints at a million rad/s."""
    if not is_refused:
        gymnasium.make("elastic_env/WalkInPlace-v0", stiffness=stiffness)
        return
    with pytest.raises(
        ConfigurationError, match=r"largest stable one is timestep_s = 0\.000\d+ s"
    ) as error:
        gymnasium.make("elastic_env/WalkInPlace-v0", stiffness=stiffness)
    timestep_s = float(str(error.value).rsplit("timestep_s = ", 1)[1].split()[0])
    gymnasium.make("elastic_env/WalkInPlace-v0", stiffness=stiffness, timestep_s=timestep_s)


def test_what_explodes_is_called_diverged_and_no_fall() -> None:
    """Catches an explosion that ends as a fall: the pelvis is down when joints run away."""
    env = gymnasium.make("elastic_env/WalkInPlace-v0").unwrapped
    env.reset(seed=0)
    stiffer = copy.copy(env.simulation.model)
    stiffer.tendon_stiffness[:] = 3e5
    env.simulation.set_model(0, stiffer)
    for _ in range(500):
        *_, terminated, _, info = env.step(np.full(12, 0.01, dtype=np.float32))
        if terminated:
            break
    assert info["termination"] == "diverged"
    assert (info["episode_metrics"]["diverged"], info["episode_metrics"]["fell"]) == (True, False)


ARM = """<mujoco><option timestep="0.01" integrator="{integrator}"/><worldbody><body>
  <joint name="shoulder" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="0.3"/></body></worldbody>
  <actuator>{actuator}</actuator></mujoco>"""
JOINT = ElasticJoint(stiffness=1000.0, damping=10.0, rotor_inertia=0.1)


IMPLICITFAST = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
AT_NIGHT = ("ant", "half_cheetah", "humanoid", "inverted_double_pendulum", "pusher", "walker2d")
ASSETS = sorted((Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets").glob("*.xml"))


def moved(model: mujoco.MjModel, duration_s: float) -> mujoco.MjData:
    """Its state some time after a small push."""
    data = mujoco.MjData(model)
    data.qvel[:] = 1e-3
    mujoco.mj_step(model, data, round(duration_s / model.opt.timestep))
    return data


def is_well(data: mujoco.MjData) -> bool:
    """Whether MuJoCo itself found nothing bad in a motion."""
    return bool(np.isfinite(data.qpos).all() and not data.warning.number.any())


def arm(integrator: str, timestep_s: float) -> mujoco.MjSpec:
    """A light arm, whose spring is fast."""
    spec = mujoco.MjSpec.from_string(ARM.format(integrator=integrator, actuator=""))
    spec.option.timestep = timestep_s
    return spec


@pytest.mark.parametrize(
    ("integrator", "becomes"), [("Euler", True), ("RK4", True), ("implicitfast", False)]
)
def test_the_integrator_is_changed_where_the_springs_need_it(
    integrator: str, becomes: bool
) -> None:
    """Catches a model that explodes, a change without a word and one without need; the sag has a
    closed form."""
    spec = arm(integrator, 3e-3)
    joints = {"shoulder": JOINT.replace(servo=SERVO)}
    assert is_well(moved(transform_hinges(spec, joints).compile(), 2.0)) == (not becomes)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        model = make_elastic(spec, joints).compile()
    assert [str(one.message) for one in said] == becomes * [
        f"the elastic joints explode with {integrator.upper()} at a physics step of 0.003 s; the"
        " elastic model has the integrator IMPLICITFAST, which follows them"
    ]
    assert model.opt.integrator == IMPLICITFAST
    data = moved(model, 10.0)
    assert is_well(data)
    q = data.joint("shoulder").qpos[0]
    torque = 9.81 * model.body_mass.sum() * 0.15 * np.cos(q)
    assert q == pytest.approx(
        torque * (1.0 / JOINT.stiffness + 1.0 / SERVO.position_gain), rel=1e-6
    )


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicitfast"])
def test_what_no_integrator_follows_is_refused_with_the_largest_step(integrator: str) -> None:
    """Catches a step that is named and explodes, and one that is named far below what MuJoCo
    follows."""
    with pytest.raises(
        ConfigurationError, match=r"at most 0\.\d+ s before they are made elastic"
    ) as error:
        make_elastic(arm(integrator, 0.01), {"shoulder": JOINT})
    largest_s = float(str(error.value).split("at most ")[1].split()[0])
    for timestep_s, holds in ((largest_s, True), (1.3 * largest_s, False)):
        elastic = transform_hinges(arm("implicitfast", timestep_s), {"shoulder": JOINT})
        assert is_well(moved(elastic.compile(), 10.0)) == holds
    with (
        pytest.warns(UserWarning, match="IMPLICITFAST")
        if integrator != "implicitfast"
        else nullcontext()
    ):
        make_elastic(arm(integrator, largest_s), {"shoulder": JOINT})


@pytest.mark.parametrize(
    "path",
    [pytest.param(p, id=p.stem, marks=[pytest.mark.slow] * (p.stem in AT_NIGHT)) for p in ASSETS],
)
@pytest.mark.filterwarnings(
    "ignore:the elastic joints explode", "ignore:compiler attribute 'settotalmass'"
)
def test_known_robots_move_or_are_refused(path: Path) -> None:
    """Catches an integrator that does not fit: with their own, half of Gymnasium's robots
    explode with this joint."""
    spec = mujoco.MjSpec.from_file(str(path))
    hinges = [j.name for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_HINGE and j.name]
    joints = dict.fromkeys(hinges, JOINT)
    try:
        elastic = make_elastic(spec, joints)
    except ConfigurationError as error:
        spec.option.timestep = float(str(error).split("at most ")[1].split()[0])
        elastic = make_elastic(spec, joints)
    data = moved(elastic.compile(), 1.0)
    assert is_well(data)
    assert data.time == pytest.approx(1.0, abs=spec.option.timestep)


def test_no_reset_hides_a_divergence() -> None:
    """Catches a model that MuJoCo starts anew: its state is finite then, and its clock begins at
    zero."""
    model = make_elastic(arm("implicitfast", 1e-3), {"shoulder": JOINT}).compile()
    model.tendon_stiffness[:] *= 1e4
    data = moved(model, 1.0)
    assert np.isnan(data.qpos).all()
    assert data.warning.number.any()
    assert data.time == pytest.approx(1.0)
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    assert np.isfinite(moved(model, 1.0).qpos).all()


def test_a_servo_that_is_left_out_is_warned_of() -> None:
    """Catches a servo that the user gave and the model does not have."""
    motor = '<motor name="m" joint="shoulder"/>'
    spec = mujoco.MjSpec.from_string(ARM.format(integrator="implicitfast", actuator=motor))
    spec.option.timestep = 1e-3
    with pytest.warns(UserWarning, match=r"'shoulder' keeps its actuator 'm'.*actuators='replace'"):
        make_elastic(spec, {"shoulder": JOINT.replace(servo=SERVO)}, actuators="keep")


FULL = """<mujoco><size memory="20K"/><worldbody><geom type="plane" size="1 1 1"/>{bodies}</worldbody></mujoco>"""


def test_a_full_arena_is_said_once_and_is_no_divergence() -> None:
    """Catches an episode that ends as diverged although its state is finite."""
    from elastic_env.world.worlds import SingleWorld

    bodies = "".join(
        f'<body pos="{0.05 * i} 0 .02"><freejoint/><geom size=".03"/></body>' for i in range(12)
    )
    simulation = SingleWorld(mujoco.MjModel.from_xml_string(FULL.format(bodies=bodies)))
    simulation.advance(5)
    with pytest.warns(UserWarning, match="too many .* for its memory"):
        assert simulation.divergence().tolist() == [False]
    simulation.advance(5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert simulation.divergence().tolist() == [False]
