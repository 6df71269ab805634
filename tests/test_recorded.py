"""Recordings of others: made-up files of the same form, and the published geometry."""

import zipfile
from dataclasses import dataclass
from http.client import IncompleteRead
from io import BytesIO
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from baselines.identification.geometry_fit import fit_geometry
from docs.pages import recorded
from docs.recorded import justin
from docs.recorded.justin import RecordedPoses, find_rigid, justin_spec, read_poses
from docs.recorded.servos import servo_rows
from docs.recorded.sources import Source
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array


def craig(row: justin.Row, q: float) -> Array:
    """Rx(α) Tx(r) Rz(q + θ) Tz(d), written out."""
    alpha = np.deg2rad(row.alpha_deg)
    angle = q + np.deg2rad(row.theta_deg)
    c, s = np.cos(angle), np.sin(angle)
    ca, sa = np.cos(alpha), np.sin(alpha)
    return np.array(
        [
            [c, -s, 0.0, row.r_m],
            [s * ca, c * ca, -sa, -sa * row.d_m],
            [s * sa, c * sa, ca, ca * row.d_m],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def test_the_model_has_the_published_geometry() -> None:
    """Catches a row in another convention, a length on the wrong side of its joint, and a mass
    elsewhere than in the middle of its link."""
    q = np.random.default_rng(5).uniform(-1.0, 1.0, 11)
    spec = justin_spec({"left": Rotation.identity()})
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    T = np.eye(4)
    for row, angle in zip(justin._TORSO, q[:4], strict=True):
        T = T @ craig(row, angle)
    shoulder = np.eye(4)
    shoulder[:3, 3] = justin._SHOULDERS["left"]
    T = T @ shoulder
    for row, angle in zip(justin._LEFT, q[4:], strict=True):
        T = T @ craig(row, angle)
    hand = T @ [*justin._MARKERS["left"], 1.0]
    np.testing.assert_allclose(data.site("left_hand").xpos, hand[:3], atol=1e-12)
    assert model.body_mass.sum() == pytest.approx(40.0 + 16.4)
    for name, middle in (("torso_1", [0.15, 0.0, 0.0]), ("left_2", [0.0, 0.0, -0.2])):
        np.testing.assert_allclose(model.body(name).ipos, middle, atol=1e-12)


def table(poses: int) -> str:
    """A table of the published form."""
    text = ",joints,markers\n"
    for number in range(poses):
        joints = " ".join(f"{0.01 * (number + j):.8f}" for j in range(19))
        text += f'{number},[ {joints}],"[[1. 2. {number}.]\n [4. 5. 6.]]"\n'
    return text


@pytest.mark.parametrize("is_packed", [True, False])
def test_the_published_table_is_read(is_packed: bool, tmp_path: Path) -> None:
    """Catches columns that are shifted, the hands swapped, and a chest that is not upright."""
    file = tmp_path / "m.csv"
    file.write_text(table(3))
    if is_packed:
        with zipfile.ZipFile(tmp_path / "m.zip", "w") as archive:
            archive.write(file, "m.csv")
        file = tmp_path / "m.zip"
    poses = read_poses(file)
    assert poses.measured[2].tolist() == [[1.0, 2.0, 2.0], [4.0, 5.0, 6.0]]
    np.testing.assert_allclose(poses.theta[1, [0, 3, 4, 17]], [0.01, -0.05, 0.04, 0.17])


def test_another_table_is_refused(tmp_path: Path) -> None:
    """Catches a traceback where a file of the name has another content."""
    (tmp_path / "m.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ConfigurationError, match="must have the columns joints, 19 numbers"):
        read_poses(tmp_path / "m.csv")


@dataclass(frozen=True)
class Local(Source):
    """A source whose files lie in a folder."""

    def address(self, path: str) -> str:
        return f"file://{self.repository}/{path}"


def test_a_recording_is_fetched_once_and_checked(tmp_path: Path) -> None:
    """Catches another file under the name, and a copy that is fetched again."""
    (tmp_path / "there").mkdir()
    (tmp_path / "there/a.json").write_text("{}")
    digest = "44136fa355b3678a1146ad16f7e8649e94fb4fc21fe77e8310c060f61caaff8a"
    source = Local("made", "", str(tmp_path), "c", "none", {"there/a.json": digest})
    folder = tmp_path / "here"
    with pytest.raises(ConfigurationError, match=r"a.json is not there; get it by --fetch"):
        source.file(folder, "there/a.json")
    shown = list[str]()
    source.fetch(folder, shown.append)
    source.fetch(folder, shown.append)
    assert len(shown) == 1
    copy = source.file(folder, "there/a.json")
    assert copy.read_text() == "{}"
    copy.write_text("[]")
    with pytest.raises(ConfigurationError, match="is not the file that was measured: SHA-256"):
        source.file(folder, "there/a.json")
    (tmp_path / "there/a.json").unlink()
    copy.unlink()
    with pytest.raises(ConfigurationError, match="cannot fetch file:"):
        source.fetch(folder, shown.append)
    (tmp_path / "there/a.json").write_text("[]")
    with pytest.raises(ConfigurationError, match=r"sent is not the file .*; nothing was written"):
        source.fetch(folder, shown.append)
    assert not copy.exists()


@pytest.mark.parametrize(
    "error", [ConnectionResetError("reset"), IncompleteRead(b"{"), TimeoutError("slow")]
)
def test_a_download_that_breaks_off_is_refused_in_one_sentence(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a traceback where the line is cut while the file is read."""

    class Broken(BytesIO):
        def read(self, size: int | None = -1, /) -> bytes:
            del size
            raise error

    monkeypatch.setattr("urllib.request.urlopen", lambda address, timeout: Broken())
    source = Source("made", "", "a/b", "c", "none", {"a.json": "0"})
    with pytest.raises(ConfigurationError, match="cannot fetch https:"):
        source.fetch(tmp_path, lambda address: None)


def test_rivals_and_replay_are_shown_over_the_same_rows() -> None:
    """Catches a replay over all rows beside rivals over those with the torque on."""
    errors = [{"rms_mrad": value} for value in (40.0, 30.0, 20.0, 10.0)]
    part = {"motions": ["sin_sin"], "errors": errors, "replay_mrad": 90.0}
    slow = {
        "gain": 32.0,
        "the goal itself": 4.0,
        "a constant offset": 3.0,
        "a line in the goal": 2.0,
        "identified": 1.0,
    }
    rows = servo_rows({"sts3250": {"held_out": [part], "sag": [slow]}})
    assert rows[0]["replay_mrad"] == 10.0
    assert rows[0]["replay_all_mrad"] == 90.0
    assert "replay_all_mrad" not in rows[1]
    texts = [{name: str(value) for name, value in row.items()} for row in rows]
    shown = recorded.replays(texts).splitlines()
    assert "| identified | torque off included |" in shown[0]
    assert shown[2].endswith("| 10.0 | 90.0 |")
    assert "torque off" not in recorded.slow_motion(texts)


@pytest.mark.slow
def test_shoulders_are_found_from_poses_alone() -> None:
    """Catches a search that ends in another frame: made-up rigid poses are met exactly."""
    turns = {
        "right": Rotation.from_rotvec([0.2, 3.0, 0.1]),
        "left": Rotation.from_rotvec([0.4, 0, 0]),
    }
    model = justin_spec(turns).compile()
    data = mujoco.MjData(model)
    generator = np.random.default_rng(5)
    theta = generator.uniform(-1.5, 1.5, (40, 18))
    measured = np.empty((40, 2, 3))
    for pose, q in enumerate(theta):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        measured[pose] = data.site_xpos
    measured += generator.normal(0.0, 1e-4, measured.shape)
    poses = RecordedPoses(theta, measured)
    again = justin._problem(find_rigid(poses), poses, ("right", "left")).as_rigid()
    assert fit_geometry(again).noise_m == pytest.approx(1e-4, rel=0.3)
