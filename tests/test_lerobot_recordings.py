"""Data sets of LeRobot as logs of joints: names, units, torque, and what is refused."""

import io
import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pandas as pd
import pytest

from baselines.identification.servo_log import read_servo_log
from baselines.lerobot import LeRobotArm
from baselines.lerobot.recordings import joint_logs, read_recordings, robot_of
from elastic_env.core.errors import ConfigurationError
from tests.test_lerobot import BODY, RANGES, calibration, settings
from train.commands.cli import main

pytestmark = pytest.mark.usefixtures("_reader")
RATE_HZ = 30.0
NAMES = [f"{name}.pos" for name in RANGES]


@pytest.fixture
def _reader(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parquet files in the tests are tables as JSON where the package pyarrow is missing."""
    try:
        import pyarrow  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ImportError:

        def read(file: io.BytesIO) -> pd.DataFrame:
            return pd.DataFrame(json.loads(file.read()))

        monkeypatch.setattr(pd, "read_parquet", read)
        monkeypatch.setattr(
            pd.DataFrame,
            "to_parquet",
            lambda self, path: path.write_text(json.dumps(self.to_dict("list"))),
        )


def sweep(count: int = 240) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Clock, goals and positions in LeRobot's values."""
    time = np.arange(count) / RATE_HZ
    waves = np.sin(np.outer(time, 0.4 + 0.1 * np.arange(6)))
    goal = 20.0 * waves + np.array([0.0, 3.0, -8.0, 5.0, 0.0, 50.0])
    return time, goal, 0.9 * goal


def dataset(folder: Path, version: str = "v3.0", **changed: Any) -> Path:
    """A data set of two episodes, without pictures."""
    time, goal, position = sweep()
    feature = {"dtype": "float32", "shape": [6], "names": NAMES}
    info = {
        "codebase_version": version,
        "robot_type": "so101_follower",
        "fps": RATE_HZ,
        "features": {"action": feature, "observation.state": feature},
    }
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info | changed))
    parts = [
        pd.DataFrame(
            {
                "timestamp": time.tolist(),
                "action": (goal + episode).tolist(),
                "observation.state": position.tolist(),
                "episode_index": [episode] * len(time),
            }
        )
        for episode in (0, 1)
    ]
    chunk = folder / "data" / "chunk-000"
    chunk.mkdir(parents=True)
    if version == "v3.0":
        pd.concat(parts, ignore_index=True).to_parquet(chunk / "file-000.parquet")
    else:
        for episode, part in enumerate(parts):
            part.to_parquet(chunk / f"episode_{episode:06d}.parquet")
    return folder


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_episodes_come_one_by_one(version: str, tmp_path: Path) -> None:
    """Catches episodes in one file that are run together, which a clock that goes back shows."""
    folder = dataset(tmp_path / "set", version)
    found = read_recordings(folder)
    time, goal, position = sweep()
    assert [one.episode for one in found] == [0, 1]
    assert found[0].motors == tuple(RANGES)
    for one in found:
        np.testing.assert_allclose(one.time, time)
        np.testing.assert_allclose(one.goal, goal + one.episode, rtol=1e-6)
        np.testing.assert_allclose(one.position, position, rtol=1e-6)
    assert [one.episode for one in read_recordings(folder, [1])] == [1]


@pytest.mark.parametrize(
    "names",
    [
        NAMES[::-1],
        {"motors": [f"main_{name}" for name in RANGES][::-1]},
        [f"{name}.{what}" for name in list(RANGES)[::-1] for what in ("pos",)],
    ],
)
def test_columns_are_known_by_their_names(names: Any, tmp_path: Path) -> None:
    """Catches columns that are taken by their number; the names of 2024 are read, too."""
    feature = {"names": names}
    folder = dataset(
        tmp_path / "set", features={"action": feature, "observation.state": {"names": NAMES}}
    )
    found = read_recordings(folder)[0]
    _, goal, position = sweep()
    at = [list(RANGES).index(name) for name in found.motors]
    np.testing.assert_allclose(found.position, position[:, at], rtol=1e-6)
    np.testing.assert_allclose(found.goal, goal[:, ::-1][:, at], rtol=1e-6)


@pytest.mark.parametrize(
    ("said", "robot"),
    [
        ("so101_follower", "so101_follower"),
        ("so_follower", "so101_follower"),
        ("so100", "so100_follower"),
        ("koch", "koch_follower"),
        ("bi_openarm_follower", "bi_openarm_follower"),
    ],
)
def test_the_robot_is_that_of_the_data_set(said: str, robot: str, tmp_path: Path) -> None:
    assert robot_of(dataset(tmp_path / "set", robot_type=said)) == robot


def test_the_known_torque_is_that_of_weight_and_of_the_other_joints(tmp_path: Path) -> None:
    """By the model's inverse dynamics along the exact motion, and the mean of MuJoCo's inertia.
    Catches the sign, degrees, and an own inertia that counts twice, or for the rotor's."""
    arm = LeRobotArm(settings(joints={"*": "rigid"}))
    recording = read_recordings(dataset(tmp_path / "set"), [0])[0]
    time, _, position = sweep()
    turn = np.deg2rad(4095 / 4096)
    rate = 0.4 + 0.1 * np.arange(5)
    size = 0.9 * 20.0 * turn
    phase = np.outer(time, rate)
    q = turn * position[:, :5]
    q_dot = size * rate * np.cos(phase)
    q_ddot = -size * rate**2 * np.sin(phase)
    body = arm.compensator.constants.body
    inside = slice(10, -10)  # the derivatives at the ends are one-sided
    logs = joint_logs(recording, arm)
    assert [log.name for log in logs] == [f"{name}_0" for name in BODY]
    model = arm.compensator.constants.model
    data = mujoco.MjData(model)
    matrices = np.zeros((len(q), model.nv, model.nv))
    for row, matrix in zip(q, matrices, strict=True):
        data.qpos[[model.joint(name).qposadr[0] for name in BODY]] = row
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, matrix)
    for joint, log in enumerate(logs):
        assert log.load.inertia is not None
        assert log.known_torque is not None
        dof = model.joint(BODY[joint]).dofadr[0]
        own = np.mean(matrices[:, dof, dof]) - model.dof_armature[dof]
        assert log.load.inertia == pytest.approx(own, rel=0.01)
        expected = log.load.inertia * q_ddot - body.inverse_dynamics(q, q_dot, q_ddot)
        expected = expected[:, joint]
        largest = np.abs(expected).max()
        np.testing.assert_allclose(
            log.known_torque[inside], expected[inside], atol=0.01 * largest + 2e-4
        )
        np.testing.assert_allclose(log.position, q[:, joint], atol=1e-6)


def test_the_command_writes_logs_that_identify_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = dataset(tmp_path / "set")
    (tmp_path / "arm.json").write_text(json.dumps(calibration()))
    arguments = ["lerobot", str(folder), "--model", "docs/hardware/so101.xml"]
    arguments += ["--calibration", str(tmp_path / "arm.json"), "--output", str(tmp_path / "logs")]
    main(arguments)
    assert "480 rows in 2 recordings" in capsys.readouterr().out
    found = {file.stem for file in (tmp_path / "logs").glob("*.csv")}
    assert found == {f"{name}_{episode}" for name in BODY for episode in (0, 1)}
    log = read_servo_log(tmp_path / "logs" / "elbow_flex_1.csv")
    _, goal, position = sweep()
    turn = np.deg2rad(4095 / 4096)
    np.testing.assert_allclose(log.goal, turn * (goal[:, 2] + 1.0), atol=1e-6)
    np.testing.assert_allclose(log.position, turn * position[:, 2], atol=1e-6)
    assert log.known_torque is not None
    # the servo has to lift the load: where the link is pulled forward, its goal is behind
    assert log.known_torque.shape == log.position.shape


@pytest.mark.parametrize(
    ("changed", "episodes", "said"),
    [
        ({"features": {}}, [], "does not name the motors of action"),
        ({"features": 3}, [], "describes no features"),
        ({"robot_type": None}, [], "names no robot"),
        ({}, [7], "has no episode 7"),
    ],
)
def test_a_folder_that_cannot_be_used_is_one_sentence(
    changed: dict[str, Any], episodes: list[int], said: str, tmp_path: Path
) -> None:
    folder = dataset(tmp_path / "set", **changed)
    with pytest.raises(ConfigurationError, match=said):  # noqa: PT012  both read it
        robot_of(folder)
        read_recordings(folder, episodes)


@pytest.mark.parametrize(
    "clock", [[0.0], [0.0, 0.1], [0.0] * 3, [0.2, 0.1, 0.0], [0.0, 0.1, 0.2, 1e9]]
)
def test_an_episode_without_a_clock_is_one_sentence(clock: list[float], tmp_path: Path) -> None:
    """Catches a traceback, and a memory that a gap fills."""
    folder = dataset(tmp_path / "set", "v2.1")
    file = folder / "data" / "chunk-000" / "episode_000001.parquet"
    state = [[0.0] * 6] * len(clock)
    columns = {"timestamp": clock, "action": state, "observation.state": state}
    pd.DataFrame({**columns, "episode_index": [1] * len(clock)}).to_parquet(file)
    with pytest.raises(ConfigurationError, match="episode 1: needs at least 3 rows"):
        read_recordings(folder)
    assert len(read_recordings(folder, [0])) == 1


def test_a_joint_with_a_slash_in_its_name_has_its_file(tmp_path: Path) -> None:
    """Catches a folder that is not there, behind a prefix of a model that was attached."""
    named = '<joint name="elbow_flex"', '<joint name="arm/elbow_flex"'
    (tmp_path / "arm.xml").write_text(Path("docs/hardware/so101.xml").read_text().replace(*named))
    (tmp_path / "arm.json").write_text(json.dumps(calibration()))
    (tmp_path / "places.yaml").write_text("elbow_flex: {joint: arm/elbow_flex}")
    arguments = ["lerobot", str(dataset(tmp_path / "set")), "--output", str(tmp_path / "logs")]
    for option, file in (("model", "arm.xml"), ("calibration", "arm.json")):
        arguments += [f"--{option}", str(tmp_path / file)]
    main([*arguments, "--places", str(tmp_path / "places.yaml")])
    assert (tmp_path / "logs" / "arm_elbow_flex_1.csv").is_file()


def test_no_data_set_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="is no data set of LeRobot"):
        read_recordings(tmp_path)
