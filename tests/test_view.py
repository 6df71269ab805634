"""The robot three times side by side, and the page that shows it."""

import socket
import time
from typing import Any
from urllib.request import urlopen

import gymnasium
import mujoco
import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation

import elastic_env  # noqa: F401  registers the environments
from elastic_env.rendering.side_by_side import COPIES, LINK, MOTOR, REFERENCE, SideBySide, enlarged_pose
from tests.three_joints import ARM
from train.evaluate.conditions import Condition, PolicySpec
from train.experiments.view import Playback, record, show


@pytest.fixture(scope="module")
def walker() -> Any:
    """The walker after a few steps without compensation, bent."""
    env: Any = gymnasium.make("elastic_env/WalkInPlace-v0", step_period=3.0, num_steps=2)
    env.reset(seed=0)
    for _ in range(5):
        *_, env.info = env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    yield env
    env.close()


def posed(picture: Any, now: Any, factor: float) -> tuple[SideBySide, mujoco.MjData]:
    """The three robots in their postures."""
    scene = SideBySide(picture.alone())
    data = mujoco.MjData(scene.model)
    scene.pose(data, picture.sides(now), factor)
    mujoco.mj_kinematics(scene.model, data)
    return scene, data


def test_the_link_side_at_factor_one_is_the_robot_of_the_physics(walker: Any) -> None:
    """Catches joints in another order, and a base that is elsewhere: MuJoCo's own bodies say where the robot is."""
    scene, data = posed(walker.unwrapped.picture, walker.info, 1.0)
    simulation = walker.unwrapped.simulation
    truth = mujoco.MjData(simulation.model)
    truth.qpos[:] = simulation.qpos[0]
    mujoco.mj_kinematics(simulation.model, truth)
    offset = scene.model.body(f"{LINK}pelvis").pos - scene.model.body(f"{MOTOR}pelvis").pos
    for foot in ("l_foot", "r_foot", "pelvis"):
        np.testing.assert_allclose(data.body(LINK + foot).xpos - offset, truth.body(foot).xpos, atol=2e-9)
        np.testing.assert_allclose(data.body(LINK + foot).xmat, truth.body(foot).xmat, atol=2e-9)


def test_the_motor_side_is_what_the_encoders_say(walker: Any) -> None:
    """Catches motor and link exchanged: the deflection is what lies between them."""
    scene, data = posed(walker.unwrapped.picture, walker.info, 1.0)
    del scene
    truth = walker.unwrapped.truth()
    for number, name in enumerate(walker.unwrapped.picture.alone().joints):
        deflection = data.joint(MOTOR + name).qpos - data.joint(LINK + name).qpos
        np.testing.assert_allclose(deflection, truth.theta[0, number] - truth.q[0, number], atol=1e-12)


def test_deviations_grow_with_the_factor_and_the_reference_stays(walker: Any) -> None:
    """Catches a factor that also moves the reference, or that is applied twice."""
    picture = walker.unwrapped.picture
    at = {factor: posed(picture, walker.info, factor)[1] for factor in (0.0, 1.0, 4.0)}
    for name in picture.alone().joints:
        reference = at[1.0].joint(REFERENCE + name).qpos
        for copy in COPIES:
            np.testing.assert_allclose(at[0.0].joint(copy + name).qpos, reference)
            once, four = (at[f].joint(copy + name).qpos - reference for f in (1.0, 4.0))
            np.testing.assert_allclose(four, 4.0 * once, atol=1e-12)


def test_a_pose_is_enlarged_about_the_planned_one() -> None:
    """Catches an angle that is enlarged about another axis; SciPy's rotation vectors are the reference."""
    planned, turn = Rotation.from_rotvec([0.1, -0.2, 0.3]), np.array([0.02, 0.01, -0.03])
    true = planned * Rotation.from_rotvec(turn)
    poses = [
        np.array([*position, *rotation.as_quat(scalar_first=True)])
        for position, rotation in (((0, 0, 1), planned), ((0.1, 0, 1.2), true))
    ]
    found = enlarged_pose(poses[0], poses[1], 3.0)
    np.testing.assert_allclose(found[:3], [0.3, 0.0, 1.6])
    expected = planned * Rotation.from_rotvec(3.0 * turn)
    np.testing.assert_allclose(Rotation.from_quat(found[3:], scalar_first=True).as_matrix(), expected.as_matrix())


def served(url: str, *parts: bytes) -> bool:
    """Whether a server answers with all of these parts, within ten seconds: its thread starts, then takes the model."""
    for _ in range(500):
        try:
            with urlopen(url, timeout=10.0) as answer:
                page = answer.read()
            if all(part in page for part in parts):
                return True
        except OSError:
            pass
        time.sleep(0.02)
    return False


def test_the_page_serves_the_three_robots() -> None:
    """Catches a viewer that does not start, and a page without its model."""
    condition = Condition(env="testbed", policy=PolicySpec(name="input"), scenario="ideal", reference="sine")
    recording = record(condition, Console(quiet=True), max_s=0.2)
    np.testing.assert_allclose(recording.times_s, np.arange(0.004, 0.2, 0.02))
    playback = Playback(recording, paused=True)
    playback.tick()
    assert (playback.time_s, recording.at(0.0), recording.at(1e9)) == (0.0, recording.frames[0], recording.frames[-1])
    with socket.create_server(("", 0)) as free:
        port = free.getsockname()[1]
    with show(recording, port, open_browser=False) as handle:
        handle.sync()
        assert [handle.model.joint(number).name for number in range(3)] == [f"{copy}link" for copy in COPIES]
        assert served(f"http://localhost:{port}/", b"<canvas")
        assert served(f"http://localhost:{port}/model", *(f"{copy}link".encode() for copy in COPIES))


def test_a_robot_of_ones_own_has_sides() -> None:
    """Catches a picture without them: a JointRobot needs no code of its own."""
    env: Any = ARM.robot.make(reference="sine")
    env.reset(seed=0)
    *_, info = env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    scene, data = posed(env.unwrapped.picture, info, 1.0)
    del scene
    truth = env.unwrapped.truth()
    found = [data.joint(LINK + name).qpos[0] for name in env.unwrapped.picture.alone().joints]
    np.testing.assert_allclose(found, truth.q[0])
    env.close()
