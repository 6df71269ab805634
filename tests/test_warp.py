"""The backend "warp" on a GPU, or on Warp's CPU device where there is none, against MuJoCo's own
physics on the same plants. The first test on a device compiles kernels."""

import copy
import importlib
import pickle
import sys
import warnings
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
import warp

import baselines
import elastic_env  # noqa: F401  registers the environments
from elastic_env.core.errors import ConfigurationError, MissingExtraError
from elastic_env.core.signals import Array
from elastic_env.joint.make_elastic import transform_hinges
from elastic_env.joint.small_servos import small_servo
from elastic_env.world.many_worlds import ManyWorlds
from elastic_env.world.physics import Simulation
from train.commands.speed import Speed, measure

TESTBED = "elastic_env/Testbed-v0"
WALKER = "elastic_env/WalkInPlace-v0"
DEVICE = "cuda:0" if warp.is_cuda_available() else "cpu"
WARP = {"backend": "warp", "device": DEVICE}
SERVO = """<mujoco><option timestep="0.001" integrator="implicitfast"><flag autoreset="disable"/></option>
  <worldbody><body><joint name="theta" axis="0 1 0" armature="0.8"/><geom size="0.05" pos="0.3 0 0" mass="5"/></body></worldbody>
  <actuator><pid joint="theta" kp="{kp}" kv="50" ki="{ki}" imax="{imax}" slewmax="{slewmax}" input="pos"
    forcerange="-40 40"/></actuator></mujoco>"""
LINK = (
    '<mujoco><worldbody><body><joint name="STS3215"/><geom size=".05"/></body></worldbody></mujoco>'
)
BOXES = "".join(
    f'<body pos="{x} 0 0.0499"><freejoint/><geom type="box" size=".05 .05 .05"/></body>'
    for x in range(6)
)


def backend() -> Any:
    """Its module, which takes long to import, where it is needed."""
    return importlib.import_module("elastic_env.world.warp_physics")


def servo(kp: float = 4e3, ki: float = 0.0, imax: float = 0.0, slewmax: float = 0.0) -> Any:
    """A link on a PID servo that gravity pulls down."""
    text = SERVO.format(kp=kp, ki=ki, imax=imax, slewmax=slewmax)
    return mujoco.MjModel.from_xml_string(text)


def plant_of_testbed() -> mujoco.MjModel:
    """The testbed of the paper: dead band, dry friction, PID, RK4."""
    return gymnasium.make(TESTBED, scenario="backlash").unwrapped.task.model  # pyright: ignore[reportAttributeAccessIssue]


def both(number: int = 3) -> tuple[Any, ManyWorlds]:
    """Worlds of the testbed on Warp and on threads, in the same states."""
    plant = plant_of_testbed()
    pair = (backend().WarpWorlds(plant, number, DEVICE), ManyWorlds(plant, number, 1))
    for worlds in pair:
        worlds.bind("xpos")
        worlds.qpos[:] = 0.2 * np.arange(1, number + 1)[:, None]
        worlds.ctrl[:] = worlds.qpos[:, :1]
    return pair


def make(env: str, num_envs: int, **options: Any) -> Any:
    """A vector environment."""
    return gymnasium.make_vec(
        env, num_envs=num_envs, vectorization_mode="vector_entry_point", num_threads=1, **options
    )


def play(env: Any, steps: int, policy: str, again: int = 0) -> list[tuple[Array, Any]]:
    """Observations and infos under a baseline; the second world begins anew at a step."""
    base: Any = baselines.make(policy, env)
    observation, _ = env.reset(seed=5)
    state = None
    start = np.ones(env.num_envs, dtype=np.bool_)
    shown = []
    for step in range(steps):
        if again and step == again:
            start = np.arange(env.num_envs) == 1
            observation, _ = env.reset(options={"reset_mask": start})
        action, state = base.predict(observation, state, start, deterministic=True)
        observation, _, terminated, truncated, info = env.step(action)
        start = terminated | truncated
        shown.append((observation, {**info}))
    return shown


@pytest.mark.parametrize(("ki", "aim"), [(0.0, 0.5), (3e4, 0.5), (3e4, 3.0)])
def test_the_motor_in_place_of_a_pid_moves_the_link_the_same(ki: float, aim: float) -> None:
    """Catches a gain in a wrong slot, the back-EMF left in the torque, and a torque beyond the
    servo's; both models run on MuJoCo."""
    ends = []
    for model in (servo(ki=ki), backend().warp_model(servo(ki=ki))):
        data = mujoco.MjData(model)
        data.ctrl[:] = aim
        mujoco.mj_step(model, data, 400)
        ends.append(np.concatenate([data.qpos, data.qvel, data.act, data.actuator_force]))
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-9, atol=1e-12)
    assert len(ends[0]) == (4 if ki else 3)


def test_the_integral_of_the_motor_stops_at_its_limit() -> None:
    """Catches an integral that winds up; a PID passes its limit by a part of the last step."""
    aim = 0.5
    imax = 4e-4
    largest = []
    for model in (servo(ki=3e4, imax=imax), backend().warp_model(servo(ki=3e4, imax=imax))):
        data = mujoco.MjData(model)
        data.ctrl[:] = aim
        acts = []
        for _ in range(400):
            mujoco.mj_step(model, data)
            acts.append(abs(data.act[0]))
        largest.append(max(acts))
    assert imax <= largest[0] < imax + aim * model.opt.timestep
    assert largest[1] == imax


def test_servos_that_are_motors_stay_and_the_given_model_too() -> None:
    """Catches a change of the caller's model, and of actuators that need none."""
    joint = {"STS3215": small_servo("STS3215")}
    model = transform_hinges(mujoco.MjSpec.from_string(LINK), joint).compile()
    assert model.actuator_gaintype.tolist() == [int(mujoco.mjtGain.mjGAIN_DCMOTOR)]
    np.testing.assert_array_equal(
        backend().warp_model(model).actuator_gainprm, model.actuator_gainprm
    )
    own = servo(ki=3e4)
    backend().warp_model(own)
    assert own.actuator_gaintype[0] == mujoco.mjtGain.mjGAIN_PID
    with pytest.raises(ConfigurationError, match="slewmax = 0, got 2 rad/s"):
        backend().warp_model(servo(slewmax=2.0))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"backend": "wrap"}, "unknown backend 'wrap'; choose one of: mujoco, warp"),
        ({"device": "cpu"}, "device = 'cpu' needs backend=\"warp\""),
        ({"backend": "warp", "device": "cuda:99"}, 'needs CUDA, .* choose device="cpu"'),
    ],
)
def test_a_backend_or_a_device_that_is_not_there_is_one_sentence(
    options: dict[str, str], said: str
) -> None:
    """Catches a traceback of Warp, and a device that is silently not used."""
    with pytest.raises(ConfigurationError, match=said):
        make(TESTBED, 2, **options)


def test_the_extra_is_asked_for_where_it_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a bare ImportError."""
    monkeypatch.delitem(sys.modules, "elastic_env.world.warp_physics")
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(MissingExtraError, match=r"\.\[gpu\]'"):
        make(TESTBED, 2, **WARP)


def test_a_second_of_the_testbed_agrees_with_mujoco() -> None:
    """Catches another spring, dead band, friction or servo, worlds that are mixed up, robots or
    noise that the backend draws otherwise, and a restart that leaves something behind."""
    motion = {"kind": "sine", "middle": 0.4, "amplitude": 0.1}
    plain, warped = (
        play(
            make(TESTBED, 3, scenario="spread+backlash", reference=motion, **options),
            250,
            "input",
            125,
        )
        for options in ({}, WARP)
    )
    for (seen, info), (own, own_info) in zip(plain, warped, strict=True):
        np.testing.assert_allclose(own[:, 0], seen[:, 0], rtol=0.0, atol=2.6e-5)  # two counts
        moved = info["link_error"]
        np.testing.assert_allclose(own_info["link_error"], moved, rtol=0.0, atol=5e-6)
    errors = np.array([info["link_error"] for _, info in plain])
    assert (np.ptp(errors, axis=0) > 5e-3).all()
    assert np.ptp(errors, axis=1).max() > 5e-3  # another stiffness in every world


@pytest.mark.slow
def test_results_lag_by_a_physics_step_until_some_worlds_are_refreshed() -> None:
    """Catches fields that are read too late or in another shape, and a refresh of all worlds."""
    for worlds in (pair := both()):
        worlds.bind("xmat")
        worlds.advance(40)
    warped, plain = pair
    some = np.array([True, False, True])
    for name in ("qpos", "qvel", "act", "xpos", "xmat"):
        np.testing.assert_allclose(warped.bind(name), plain.bind(name), rtol=0.0, atol=1e-4)
    before = warped.bind("xpos").copy()
    for worlds in pair:
        worlds.qpos[:] += 0.5
        worlds.refresh(some)
    np.testing.assert_array_equal(warped.bind("xpos")[1], before[1])
    np.testing.assert_allclose(warped.bind("xpos"), plain.bind("xpos"), rtol=0.0, atol=1e-4)


@pytest.mark.slow
def test_every_world_can_have_its_own_model() -> None:
    """Catches a field that all worlds share, or keep when they get another model, and a graph
    that was recorded before."""
    pair = both()
    heavy = copy.copy(pair[0].model)
    heavy.body_mass[:] *= 3.0
    heavy.tendon_stiffness[:] *= 0.5
    for worlds in pair:
        worlds.advance(1)
        worlds.set_model(0, heavy)
        worlds.set_model(2, heavy)
        worlds.advance(20)
        worlds.set_model(2, worlds.model)
        worlds.advance(40)
    warped, plain = pair
    np.testing.assert_allclose(warped.qpos, plain.qpos, rtol=0.0, atol=2e-5)
    assert np.abs(warped.qpos - both()[0].qpos).max() > 1e-3
    with pytest.raises(ConfigurationError, match="all worlds have the same jnt_type"):
        warped.vary("jnt_type")


@pytest.mark.slow
def test_restarts_divergence_and_copies_are_of_single_worlds() -> None:
    """Catches a bad number that spreads, is forgotten or outlives a restart, and a copy that
    shares its state."""
    warped, plain = both()
    warped.vary("tendon_stiffness")[1] = 300.0
    warped.advance(5)
    twin = pickle.loads(pickle.dumps(warped))
    for worlds in (warped, twin):
        worlds.advance(5)
    np.testing.assert_array_equal(twin.qpos, warped.qpos)
    bad = np.array([True, False, False])
    warped.qvel[0, 0] = np.nan
    for _ in range(2):
        warped.advance(5)
        np.testing.assert_array_equal(warped.divergence(), bad)
    assert not twin.divergence().any()
    twin.advance(10)
    np.testing.assert_array_equal(warped.qpos[1:], twin.qpos[1:])
    warped.restart(bad)
    np.testing.assert_array_equal(warped.qpos[0], plain.model.qpos0)
    np.testing.assert_array_equal(warped.qpos[1:], twin.qpos[1:])
    warped.advance(5)
    assert not warped.divergence().any()


@pytest.mark.slow
def test_a_world_with_too_many_contacts_says_so_once() -> None:
    """Catches contacts that are left out silently: six boxes have 24."""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom type="plane" size="9 9 1"/>{BOXES}</worldbody></mujoco>'
    )
    worlds: Simulation = backend().WarpWorlds(model, 1, DEVICE)
    with pytest.warns(UserWarning, match="more than 16 contacts"):
        worlds.advance(2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        worlds.advance(2)


@pytest.mark.slow
def test_a_step_of_the_walk_agrees_with_mujoco() -> None:
    """Catches another contact, sensor, load or spring of any world: pelvis and ZMP within half
    a per cent, over one step of the gait of 3 s in four scenarios."""
    metrics = []
    for options in ({}, WARP):
        scenario = ["nominal", "soft", "spread", "payload"]
        env = make(WALKER, 4, scenario=scenario, num_steps=1, **options)
        episode = play(env, env.unwrapped.task.num_steps, "input_output")
        metrics.append(episode[-1][1]["episode_metrics"])
    plain, warped = metrics
    assert not plain["fell"].any()
    assert not warped["fell"].any()
    for name in ("pelvis_error_rms_rad", "pelvis_roll_rms_rad", "zmp_deviation_rms_m"):
        np.testing.assert_allclose(warped[name], plain[name], rtol=5e-3)
    assert np.ptp(plain["pelvis_error_rms_rad"]) > 1e-3


@pytest.mark.slow
def test_the_command_that_measures_a_gpu_steps_its_worlds_on_warp() -> None:
    """Catches a command that measures the CPU under the name of the GPU."""
    options = {"backend": "warp", "device": DEVICE, "others": False, "ppo": False}
    config = Speed(env="testbed", num_envs=[2], steps=2, rounds=1, **options)
    loop = config.vector_loop(2, "input", residual=False)
    assert isinstance(loop.env.unwrapped.simulation, backend().WarpWorlds)
    found = measure(config, lambda share: None)
    assert [one["contender"] for one in found][:2] == ["vector env on warp", "raw mj_step"]
    assert min(one["steps_per_s"] for one in found) > 0.0
