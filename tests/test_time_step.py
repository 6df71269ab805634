"""The largest stable physics step against closed forms, and against MuJoCo itself."""

import warnings

import gymnasium
import mujoco
import numpy as np
import pytest

import elastic_env  # noqa: F401  registers the environments
from elastic_env.core.errors import ConfigurationError
from elastic_env.joint.elasticity import ElasticJoint, Servo
from elastic_env.joint.make_elastic import make_elastic
from elastic_env.joint.time_step import largest_stable_timestep, spectral_radius

SPRING = """<mujoco><option timestep="0.01" integrator="{integrator}" gravity="0 0 0"/><worldbody><body>
  <joint type="slide" axis="1 0 0" stiffness="{stiffness}"/><geom size=".1" mass="4"/></body></worldbody></mujoco>"""
SERVO = Servo(position_gain=2e3, velocity_gain=100.0, torque_limit=50.0, speed_limit=3.0)


@pytest.mark.parametrize(("integrator", "limit"), [("Euler", 2.0), ("implicitfast", 2.0), ("RK4", 2.0 * np.sqrt(2.0))])
def test_a_spring_without_damper_has_the_limit_of_the_textbook(integrator: str, limit: float) -> None:
    """Catches a wrong state, and differences in place of the integrator's own step: ωh < 2, or 2√2 of RK4."""
    model = mujoco.MjModel.from_xml_string(SPRING.format(integrator=integrator, stiffness=4e6))
    omega = np.sqrt(4e6 / 4.0)
    assert omega * largest_stable_timestep(model) == pytest.approx(limit, rel=2e-3)


@pytest.mark.parametrize(("stiffness", "is_refused"), [(4e4, False), (6e4, True), (1e5, True)])
def test_a_walker_that_would_explode_is_refused_with_the_largest_step(stiffness: float, is_refused: bool) -> None:
    """Catches a stiffness that ends as "fell" with joints at a million rad/s."""
    if not is_refused:
        gymnasium.make("elastic_env/WalkInPlace-v0", stiffness=stiffness)
        return
    with pytest.raises(ConfigurationError, match=r"largest stable one is timestep_s = 0\.000\d+ s") as error:
        gymnasium.make("elastic_env/WalkInPlace-v0", stiffness=stiffness)
    timestep_s = float(str(error.value).rsplit("timestep_s = ", 1)[1].split()[0])
    gymnasium.make("elastic_env/WalkInPlace-v0", stiffness=stiffness, timestep_s=timestep_s)


def test_what_explodes_is_called_diverged_and_no_fall() -> None:
    """Catches an explosion that ends as a fall: the pelvis is down when joints run away."""
    env = gymnasium.make("elastic_env/WalkInPlace-v0").unwrapped
    env.reset(seed=0)
    env.simulation.vary("tendon_stiffness")[:] = 3e5
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


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicitfast"])
def test_an_elastic_model_that_explodes_is_warned_of(integrator: str) -> None:
    """Catches the silence in which MuJoCo starts a model anew; the warning agrees with what MuJoCo then does."""
    spec = mujoco.MjSpec.from_string(ARM.format(integrator=integrator, actuator=""))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        model = make_elastic(spec, {"shoulder": JOINT}).compile()
    data = mujoco.MjData(model)
    data.qvel[:] = 1e-3
    mujoco.mj_step(model, data, 400)
    has_exploded = bool(data.warning.number.any()) or spectral_radius(model) > 1.001
    assert has_exploded == bool(said)
    assert all("mjINT_IMPLICITFAST" in str(one.message) for one in said)


def test_a_servo_that_is_left_out_is_warned_of() -> None:
    """Catches a servo that the user gave and the model does not have."""
    motor = '<motor name="m" joint="shoulder"/>'
    spec = mujoco.MjSpec.from_string(ARM.format(integrator="implicitfast", actuator=motor))
    with pytest.warns(UserWarning, match=r"'shoulder' keeps its actuator 'm'.*actuators='replace'"):
        make_elastic(spec, {"shoulder": JOINT.replace(servo=SERVO)}, actuators="keep")


FULL = """<mujoco><size memory="20K"/><worldbody><geom type="plane" size="1 1 1"/>{bodies}</worldbody></mujoco>"""


def test_a_full_arena_is_said_once_and_is_no_divergence() -> None:
    """Catches an episode that ends as diverged although its state is finite."""
    from elastic_env.runtime.physics import SingleWorld

    bodies = "".join(f'<body pos="{0.05 * i} 0 .02"><freejoint/><geom size=".03"/></body>' for i in range(12))
    simulation = SingleWorld(mujoco.MjModel.from_xml_string(FULL.format(bodies=bodies)))
    simulation.advance(5)
    with pytest.warns(UserWarning, match="too many .* for its memory"):
        assert simulation.diverged().tolist() == [False]
    simulation.advance(5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert simulation.diverged().tolist() == [False]
