"""Servos from logs in time: replay against closed forms and MuJoCo, known truth, bad logs."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from io import StringIO
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from baselines.identification.servo_file import AngleUnit
from baselines.identification.servo_fit import ServoFit, fit_servo
from baselines.identification.servo_holdout import (
    PREDICTIONS,
    LogErrors,
    ServoError,
    ServoHoldout,
    judge_servo,
)
from baselines.identification.servo_intervals import cluster_variance
from baselines.identification.servo_load import GRAVITY, Load
from baselines.identification.servo_log import ServoLog, read_servo_log
from baselines.identification.servo_problem import find_limit_per_gain
from baselines.identification.servo_replay import NAMES, Replay
from baselines.identification.servo_result import ServoIdentification, describe_servo
from docs.pages.recorded import priors
from docs.recorded.servos import FURTHER_SEEDS, servo_figures, servo_rows
from elastic_env.core.errors import ConfigurationError, ElasticError, MissingExtraError
from elastic_env.core.signals import Array
from elastic_env.core.yaml_text import parse_yaml
from elastic_env.joint.joint_settings import read_joints
from tests.servo_trials import SOUGHT, draw_servo, holds, make_logs
from train.commands.cli import main
from train.commands.identify_options import ServoOptions
from train.commands.identify_servo import fitted_logs, known_load, show_result, verdict

MASS_KG, LENGTH_M = 0.5, 0.1
WEIGHT = MASS_KG * GRAVITY * LENGTH_M
LOAD = Load.pendulum(MASS_KG, LENGTH_M)


def parameters(**given: float) -> Array:
    """Parameters of a servo, zero and without limit where nothing is said."""
    values = dict.fromkeys(NAMES, 0.0) | {"torque_limit": np.inf, "stribeck_speed": 0.1} | given
    return np.array([values[name] for name in NAMES])


def log_of(
    goal: Array, start: float = 0.0, step_s: float = 5e-3, load: Load = LOAD, on: bool = True
) -> ServoLog:
    """A log whose position is only its start."""
    time = step_s * np.arange(len(goal))
    enabled = np.full(len(goal), on)
    return ServoLog("log", time, goal, np.full(len(goal), start), enabled, load=load)


def test_free_swing_has_the_period_and_the_decay_of_a_damped_pendulum() -> None:
    """Small swings: ω² = m g l / M, envelope exp(−d t / 2 M)."""
    inertia = MASS_KG * LENGTH_M**2 + 1e-3
    damping = 2e-3
    log = log_of(np.zeros(600), start=0.01, on=False)
    played = Replay.from_log(log).play(parameters(rotor_inertia=1e-3, viscous_friction=damping))
    rate = damping / (2.0 * inertia)
    omega = np.sqrt(WEIGHT / inertia - rate**2)
    t = log.time
    expected = 0.01 * np.exp(-rate * t) * (np.cos(omega * t) + rate / omega * np.sin(omega * t))
    np.testing.assert_allclose(played, expected, atol=2e-5)


def test_free_swing_loses_what_dry_friction_takes() -> None:
    """Each half swing of a spring-like load loses 2 F / (m g l)."""
    log = log_of(np.zeros(400), start=0.05, on=False)
    friction = 0.01 * WEIGHT / 2.0
    played = Replay.from_log(log).play(parameters(rotor_inertia=1e-3, coulomb_friction=friction))
    swings = np.abs(played[1:-1][np.diff(np.sign(np.diff(played))) != 0])
    np.testing.assert_allclose(swings[:3], 0.05 - 0.01 * np.arange(1, 4), atol=1e-4)


def test_friction_with_the_load_holds_a_band_and_drives_at_its_edges() -> None:
    """Upwards k e (1 − c) = m g l sin q + F, and downwards k e (1 + c) = m g l sin q − F."""
    gain, c, friction = 2.0, 0.4, 0.02
    ramp = np.concatenate([np.linspace(0.0, 1.2, 4000), np.linspace(1.2, -0.2, 5000)])
    own = parameters(
        position_gain=gain,
        motor_damping=0.02,
        rotor_inertia=1e-3,
        coulomb_friction=friction,
        load_friction=c,
    )
    log = log_of(ramp)
    q = Replay.from_log(log).play(own)
    w = np.gradient(q, log.time)
    pull = gain * (ramp - q) - 0.02 * w
    for rows, side in ((slice(2000, 3900), 1.0), (slice(6500, 8000), -1.0)):
        assert (side * w[rows] > 0.01).all()
        loss = WEIGHT * np.sin(q[rows]) + side * friction
        np.testing.assert_allclose(pull[rows] * (1.0 - side * c), loss, atol=2e-3)
    turned = slice(4050, 4350)
    np.testing.assert_allclose(np.ptp(q[turned]), 0.0, atol=1e-3)  # it stands in the band


def test_replay_without_friction_agrees_with_mujoco() -> None:
    """A position servo with limit on a pendulum, by RK4."""
    xml = f"""<mujoco><option integrator="RK4" timestep="0.0005" gravity="0 0 -{GRAVITY}"/>
    <worldbody><body><joint name="j" axis="0 1 0" armature="0.002" damping="0.03"/>
    <inertial pos="0 0 -{LENGTH_M}" mass="{MASS_KG}" diaginertia="1e-12 1e-12 1e-12"/></body>
    </worldbody><actuator><position joint="j" kp="1.5" forcerange="-.6 .6"/></actuator></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    assert Load.from_model(model, "j").torque == pytest.approx(WEIGHT)
    assert Load.from_model(model, "j").inertia == pytest.approx(MASS_KG * LENGTH_M**2)
    assert Load.from_model(model, "j").rest == pytest.approx(0.0, abs=1e-9)
    data = mujoco.MjData(model)
    goal = 0.8 * np.sin(3.0 * 5e-3 * np.arange(600))
    log = log_of(goal)
    expected = np.zeros(600)
    for row in range(599):
        for step in range(10):
            data.ctrl[0] = goal[row] + (goal[row + 1] - goal[row]) * (step + 0.5) / 10
            mujoco.mj_step(model, data)
        expected[row + 1] = data.qpos[0]
    own = parameters(
        position_gain=1.5, torque_limit=0.6, viscous_friction=0.03, rotor_inertia=0.002
    )
    np.testing.assert_allclose(Replay.from_log(log).play(own), expected, atol=2e-4)


def test_the_other_joints_of_a_robot_stand_where_its_keyframe_has_them() -> None:
    """Catches another pose than the one in which the compensator holds them."""
    link = '<inertial pos="0 0 -0.1" mass="0.2" diaginertia="1e-4 1e-4 1e-4"/>'
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><compiler angle="radian"/><worldbody>
    <body><joint name="shoulder" axis="0 1 0"/>{link}<body pos="0 0 -0.2">
    <joint name="elbow" axis="0 1 0"/>{link}</body></body></worldbody>
    <keyframe><key qpos="0.5 0"/></keyframe></mujoco>""")
    assert Load.from_model(model, "elbow").rest == pytest.approx(-0.5)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.1, 5.0), st.floats(0.0, 0.8), st.floats(0.0, 0.3), st.floats(0.0, 0.5))
def test_no_torque_no_goal_gains_energy(start: float, c: float, F: float, Fs: float) -> None:
    """Without torque the pendulum never rises above its start, and friction holds it for ever."""
    angle = min(start, 3.0)
    log = log_of(np.zeros(300), start=angle, on=False)
    q = Replay.from_log(log).play(
        parameters(rotor_inertia=1e-3, load_friction=c, coulomb_friction=F, static_friction=Fs)
    )
    height = 1.0 - np.cos(q)
    assert height.max() <= 1.0 - np.cos(angle) + 1e-3
    assert np.isfinite(q).all()


# readers


def csv_of(path: Path, **columns: Array) -> Path:
    """A log as a CSV file."""
    head = ",".join(columns)
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, delimiter=",", header=head, comments="")
    return path


def good() -> dict[str, Array]:
    """Columns of a usable log: a joint that sags below its goal."""
    time = 0.02 * np.arange(200)
    position = 0.6 * np.sin(time)
    return {"time": time, "goal": position + 0.3 * np.sin(position), "position": position}


def test_csv_and_json_of_recorders_are_read(tmp_path: Path) -> None:
    columns = good()
    named = {f"{k} [{'s' if k == 'time' else 'rad'}]": v for k, v in columns.items()}
    from_csv = read_servo_log(csv_of(tmp_path / "a.csv", **named), LOAD)
    keys = ("timestamp", "goal_position", "position")
    rows = zip(*columns.values(), strict=True)
    entries = [
        {**dict(zip(keys, map(float, row), strict=True)), "torque_enable": True, "load": 65530}
        for row in rows
    ]
    facts = {"mass": MASS_KG, "length": LENGTH_M, "kp": 400, "vin": 7.4, "motor": "xl330"}
    (tmp_path / "b.json").write_text(json.dumps({**facts, "entries": entries}))
    from_json = read_servo_log(tmp_path / "b.json")
    np.testing.assert_allclose(from_csv.goal, from_json.goal)
    assert from_json.load == LOAD
    assert (from_json.gain, from_json.supply) == (400.0, 7.4)
    assert from_json.pwm is not None
    np.testing.assert_array_equal(from_json.pwm, -6.0)


def _swap(c: dict[str, Array]) -> None:
    c["goal"], c["position"] = c["position"], c["goal"]


def _wrap(c: dict[str, Array]) -> None:
    c["position"] = np.where(c["position"] < -0.2, c["position"] + 2 * np.pi, c["position"])


def _set(name: str, change: Callable[[Array], Array]) -> Callable[[dict[str, Array]], None]:
    def apply(c: dict[str, Array]) -> None:
        c[name] = change(c[name])

    return apply


def _three(c: dict[str, Array]) -> None:
    for name in c:
        c[name] = c[name][:3]


def _twice(c: dict[str, Array]) -> None:
    c["goal [rad]"] = c["goal"]


def _of_two_joints(c: dict[str, Array]) -> None:
    c["tau_known.a"] = c["goal"]
    c["tau_known.b"] = c["goal"]


def _unit(c: dict[str, Array]) -> None:
    c["position [deg/s]"] = c.pop("position")


BAD: dict[str, tuple[Callable[[dict[str, Array]], object], str]] = {
    "degrees": (
        lambda c: [c.update({k: np.rad2deg(c[k])}) for k in ("goal", "position")] and None,
        "degrees",
    ),
    "one column in degrees": (_set("goal", lambda x: np.rad2deg(0.2 * x)), "radians"),
    "milliseconds": (_set("time", lambda t: 1e3 * t), "milliseconds"),
    "another unit": (_unit, "unit"),
    "gap": (_set("time", lambda t: t + (t > 2.0)), "gap"),
    "clock that goes back": (_set("time", lambda t: t - 0.5 * (t > 2.0)), "must grow"),
    "wrapped": (_wrap, "unwrap"),
    "exchanged": (_swap, "exchanged"),
    "three rows": (_three, "3 rows"),
    "goal twice": (_twice, "several columns goal; keep one"),
    "two joints": (_of_two_joints, "several columns tau_known; name the joint by --joints"),
    "constant goal": (_set("goal", lambda g: 0.0 * g), "constant"),
    "joint that stands": (_set("position", lambda q: 0.0 * q), "moves by"),
    "no position": (lambda c: c.pop("position") is None, "no column position"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_logs_are_refused_in_one_sentence(kind: str, tmp_path: Path) -> None:
    change, said = BAD[kind]
    columns = good()
    change(columns)
    with pytest.raises(ConfigurationError, match=said) as caught:
        read_servo_log(csv_of(tmp_path / "log.csv", **columns), LOAD)
    assert "\n" not in str(caught.value)
    assert str(caught.value).count(". ") <= 1


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"entries": 3}', '{"entries": []}', "{", "\xff"])
def test_bad_json_is_refused_in_one_sentence(text: str, tmp_path: Path) -> None:
    path = tmp_path / "log.json"
    path.write_text(text)
    with pytest.raises(ConfigurationError):
        read_servo_log(path, LOAD)


def test_a_log_without_a_load_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="mass-kg"):
        read_servo_log(csv_of(tmp_path / "log.csv", **good()))


def test_a_pendulum_in_grams_is_named() -> None:
    with pytest.warns(UserWarning, match=r"480.5 N·m, .* gives 84 N·m; check --mass-kg"):
        known_load(ServoOptions(mass_kg=490.0, lever_m=0.1), None, None)


def test_parquet_without_its_package_says_what_to_install(tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    try:
        import pyarrow  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ImportError:
        (tmp_path / "log.parquet").write_bytes(b"PAR1")
        with pytest.raises(MissingExtraError, match="pip install pyarrow"):
            read_servo_log(tmp_path / "log.parquet", LOAD)


def test_an_episode_of_lerobot_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its table, without the package that reads it from the file."""
    import pandas as pd

    columns = good()
    pairs = [
        np.column_stack([np.zeros(200), np.rad2deg(columns[key])]) for key in ("goal", "position")
    ]
    table = pd.DataFrame(
        {
            "timestamp": columns["time"],
            "action": list(pairs[0]),
            "observation.state": list(pairs[1]),
        }
    )
    monkeypatch.setattr(pd, "read_parquet", lambda path: table)
    path = written(tmp_path)
    log = read_servo_log(path, LOAD, unit="deg", joint="1")
    np.testing.assert_allclose(log.position, columns["position"])
    with pytest.raises(ConfigurationError, match="2 joints"):
        read_servo_log(path, LOAD, unit="deg")


def written(folder: Path) -> Path:
    """A file in the place of an episode."""
    path = folder / "log.parquet"
    path.write_bytes(b"PAR1")
    return path


def with_units(goal: str, position: str) -> dict[str, Array]:
    """Columns in degrees under headers with units."""
    columns = good()
    turned = {name: np.rad2deg(columns[name]) for name in ("goal", "position")}
    return {
        "time [s]": columns["time"],
        f"goal{goal}": turned["goal"],
        f"position{position}": turned["position"],
    }


def test_degrees_of_a_header_are_converted(tmp_path: Path) -> None:
    """Catches degrees that are taken for radians although the header names them."""
    path = csv_of(tmp_path / "log.csv", **with_units(" [deg]", " [deg]"))
    for log in (read_servo_log(path, LOAD), read_servo_log(path, LOAD, unit="deg")):
        np.testing.assert_allclose(log.position, good()["position"])
        np.testing.assert_allclose(log.goal, good()["goal"])


@pytest.mark.parametrize(
    ("goal", "position", "unit", "said"),
    [
        (" [deg]", " [deg]", "rad", "leave --angles out"),
        (" [rad]", " [rad]", "deg", "leave --angles out"),
        (" [deg]", " [rad]", None, "one unit"),
        (" [deg]", "", "deg", "one unit"),
    ],
)
def test_units_that_contradict_each_other_are_refused(
    goal: str, position: str, unit: AngleUnit | None, said: str, tmp_path: Path
) -> None:
    path = csv_of(tmp_path / "log.csv", **with_units(goal, position))
    with pytest.raises(ConfigurationError, match=said):
        read_servo_log(path, LOAD, unit=unit)


def episode(monkeypatch: pytest.MonkeyPatch, **changed: list[object]) -> None:
    """An episode of LeRobot with two joints, without a file."""
    import pandas as pd

    columns = good()
    lists = {
        name: [[0.0, float(value)] for value in columns[name]] for name in ("goal", "position")
    }
    content = {
        "timestamp": list(columns["time"]),
        "action": lists["goal"],
        "observation.state": lists["position"],
    }
    table = pd.DataFrame(content | changed)
    monkeypatch.setattr(pd, "read_parquet", lambda path: table)


@pytest.mark.parametrize("joint", ["2", "-1", "elbow", "1.0", "²", "9" * 5000])
def test_another_joint_than_the_episode_has_is_refused(
    joint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches another joint that is read in its place."""
    episode(monkeypatch)
    with pytest.raises(ConfigurationError, match="--joints 0 to 1, got"):
        read_servo_log(written(tmp_path), LOAD, joint=joint)


BAD_CELLS: dict[str, tuple[list[object], str]] = {
    "nan": ([*[[0.0, 0.1]] * 199, [0.0, np.nan]], "row 200: needs finite numbers"),
    "ragged": ([*[[0.0, 0.1]] * 199, [0.0]], "as many numbers"),
    "empty": ([[]] * 200, "as many numbers"),
    "text": ([["0.1", "0.2"]] * 200, "row 1: needs finite numbers"),
    "nothing": ([None] * 200, "row 1: needs finite numbers"),
}


@pytest.mark.parametrize("kind", BAD_CELLS)
def test_bad_episodes_are_refused_in_one_sentence(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a traceback of NumPy, and a replay of what is no number."""
    cells, said = BAD_CELLS[kind]
    episode(monkeypatch, **{"observation.state": cells})
    with pytest.raises(ConfigurationError, match=said) as caught:
        read_servo_log(written(tmp_path), LOAD, joint="1")
    assert "\n" not in str(caught.value)


def test_an_episode_without_rows_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    episode(monkeypatch, **{"timestamp": [], "action": [], "observation.state": []})
    with pytest.raises(ConfigurationError, match="it has 0"):
        read_servo_log(written(tmp_path), LOAD, joint="1")


def recorded_json(path: Path, **facts: object) -> Path:
    """A usable log of Rhoban's recorder with some facts changed."""
    keys = ("timestamp", "goal_position", "position")
    rows = zip(*good().values(), strict=True)
    entries = [dict(zip(keys, map(float, row), strict=True)) for row in rows]
    usual = {"mass": MASS_KG, "length": LENGTH_M, "kp": 400, "vin": 7.4}
    path.write_text(json.dumps({**usual, "entries": entries, **facts}))
    return path


@pytest.mark.parametrize("key", ["mass", "length", "kp", "vin"])
@pytest.mark.parametrize("value", [0, -1.0, True, "0.5"])
def test_facts_that_no_run_has_are_refused(key: str, value: object, tmp_path: Path) -> None:
    """Catches a load of zero, and a truth value that counts as 1 V."""
    path = recorded_json(tmp_path / "log.json", **{key: value})
    with pytest.raises(ConfigurationError, match=f"{key} must be a number above 0"):
        read_servo_log(path)


def test_a_supply_of_zero_volts_is_refused(tmp_path: Path) -> None:
    path = csv_of(tmp_path / "log.csv", **good(), voltage=np.zeros(200))
    with pytest.raises(ConfigurationError, match="above 0 V"):
        read_servo_log(path, LOAD)


def test_the_arm_of_the_pendulum_is_a_rod(tmp_path: Path) -> None:
    """Catches an arm that weighs nothing: its weight acts at l/2, its inertia is m l²/3."""
    load = read_servo_log(recorded_json(tmp_path / "log.json", arm_mass=0.06)).load
    assert load.torque == pytest.approx(WEIGHT + 0.06 * GRAVITY * LENGTH_M / 2.0)
    assert load.inertia == pytest.approx((MASS_KG + 0.06 / 3.0) * LENGTH_M**2)
    with pytest.raises(ConfigurationError, match="arm_mass must be a number of at least 0"):
        read_servo_log(recorded_json(tmp_path / "log.json", arm_mass=-0.1))


@pytest.mark.parametrize("key", ["torque_enable", "load", "goal_position"])
def test_a_key_of_some_entries_only_is_refused(key: str, tmp_path: Path) -> None:
    """Catches a column that is left out without a word, the torque then on."""
    path = recorded_json(tmp_path / "log.json")
    content = json.loads(path.read_text())
    for entry in content["entries"]:
        entry[key] = 0.5
    del content["entries"][3][key]
    path.write_text(json.dumps(content))
    with pytest.raises(ConfigurationError, match=f"entry 4 has no {key}"):
        read_servo_log(path)
    content["entries"][3][key] = "on"
    path.write_text(json.dumps(content))
    with pytest.raises(ConfigurationError, match=f"entry 4: {key} must be a number"):
        read_servo_log(path)


def test_options_do_not_override_what_a_log_says(tmp_path: Path) -> None:
    """Catches a load or a gain of an option in place of the recorded one."""
    path = recorded_json(tmp_path / "log.json")
    same = read_servo_log(path, LOAD, 400.0)
    assert (same.load, same.gain) == (LOAD, 400.0)
    with pytest.raises(ConfigurationError, match=r"0\.5 kg hang at 0\.1 m"):
        read_servo_log(path, Load.pendulum(0.6, LENGTH_M))
    with pytest.raises(ConfigurationError, match="gain is 400, and --gain 200"):
        read_servo_log(path, gain=200.0)
    columns = csv_of(tmp_path / "log.csv", **good(), gain=np.full(200, 32.0))
    with pytest.raises(ConfigurationError, match="gain is 32, and --gain 200"):
        read_servo_log(columns, LOAD, 200.0)


def test_a_joint_that_nothing_loads_is_refused() -> None:
    """Catches a division by the largest torque, which is zero."""
    _, logs = short_logs(6)
    with pytest.raises(ElasticError, match="nothing loads the joint"):
        fit_servo([replace(logs[0], load=Load(0.0, 0.0, 1e-3))], starts=1)


def test_known_torque_replaces_the_weight(tmp_path: Path) -> None:
    columns = good()
    pull = -WEIGHT * np.sin(columns["position"])
    log = read_servo_log(csv_of(tmp_path / "log.csv", **columns, **{"tau_known.j": pull}))
    np.testing.assert_allclose(log.external_torque(log.position), pull)
    assert replace(log, load=LOAD).load.inertia is not None


# estimates


def short_logs(seed: int, **changed: float) -> tuple[Array, list[ServoLog]]:
    """A servo and short logs of it."""
    rng = np.random.default_rng(seed)
    truth = draw_servo(rng)
    for name, value in changed.items():
        truth[NAMES.index(name)] = value
    return truth, make_logs(truth, rng, step_s=0.02)


def test_short_logs_tell_the_truth() -> None:
    """One start and rows at 50 Hz: every parameter within its interval, or within a twentieth."""
    truth, logs = short_logs(3)
    fit = fit_servo(logs, starts=1)
    for name in SOUGHT:
        value = truth[NAMES.index(name)]
        assert abs(fit.value(name) - value) < max(fit.half(name), 0.05 * abs(value), 1e-3), name
    held_out = judge_servo(fit, [logs[0].part(slice(150, None))])
    assert held_out.errors[-1].rms_mrad < 5.0 < held_out.best_rival.rms_mrad
    result = describe_servo(fit, "elbow", held_out)
    assert {one.name for one in result.parameters if one.is_told} >= set(SOUGHT) - {"zero_offset"}
    assert any("backlash" in text for text in result.untold)
    gains = {one.register_value: one.position_gain_nm_per_rad for one in result.gains}
    assert gains[800.0] == pytest.approx(4.0 * gains[200.0])


def test_without_a_swing_the_damping_is_split_by_assumption() -> None:
    _, logs = short_logs(4)
    fit = fit_servo(logs[:2], starts=1)
    assert "viscous_friction" in fit.tied
    assert any("back-EMF" in text for text in describe_servo(fit).untold)
    share = fit.value("viscous_friction") / (
        fit.value("viscous_friction") + fit.value("motor_damping")
    )
    assert share == pytest.approx(0.2)


def test_pwm_at_its_limit_tells_the_torque_limit() -> None:
    """The duty k g e / T stays at one: T follows from k, whatever unit the register has."""
    truth, logs = short_logs(5)
    gain = truth[NAMES.index("position_gain")]
    limit = 0.9
    duties = [
        885.0 * np.clip(gain * log.gain * (log.goal - log.position) / limit, -1.0, 1.0)
        for log in logs
    ]
    logged = [replace(log, pwm=duty) for log, duty in zip(logs, duties, strict=True)]
    assert find_limit_per_gain(logged) == pytest.approx(limit / gain, rel=1e-6)
    assert find_limit_per_gain(logs) is None


def test_the_start_limits_the_torque_where_the_replay_does() -> None:
    """Catches a limit in volts where it is in units of the register: 12 V scale both sides."""
    _, logs = short_logs(5)
    log = replace(logs[0], supply=12.0)
    duty = 0.4 * log.gain * float(np.abs(log.goal - log.position).max())
    torque = 1e-3 * log.torque_per_gain(duty)
    pull = 1e-3 * log.supply * log.gain * (log.goal - log.position)
    limit = 1e-3 * duty * log.supply
    np.testing.assert_allclose(torque, np.clip(pull, -limit, limit) * log.enabled)
    assert (np.abs(torque) < 0.999 * limit).any()


def test_a_parameter_without_influence_has_no_interval() -> None:
    """Catches ± 0 where nothing depends on a parameter, and where two cannot be told apart."""
    rng = np.random.default_rng(1)
    one = rng.normal(size=(100, 3))
    block = np.arange(100) // 10
    r = rng.normal(size=100)
    J = np.column_stack([one[:, 0], np.zeros(100), one[:, 1], one[:, 2], 2.0 * one[:, 2]])
    told = np.isfinite(cluster_variance(J, r, block))
    assert told.tolist() == [True, False, True, False, False]


def test_what_nothing_depends_on_is_named_and_not_told() -> None:
    """Catches an infinite width that JSON and checks refuse, or that stays unsaid."""
    _, logs = short_logs(3)
    half = np.full(len(NAMES), 1e-6)
    half[[NAMES.index("delay"), NAMES.index("position_gain")]] = np.inf
    values = np.full(len(NAMES), 0.1)
    sought = np.ones(len(NAMES), dtype=np.bool_)
    result = describe_servo(ServoFit(tuple(logs), values, half, sought, {}, 1e-3))
    again = ServoIdentification.model_validate_json(result.model_dump_json())
    delay = next(one for one in again.parameters if one.name == "delay")
    assert delay.half_width is None
    assert not delay.is_told
    assert again.gains[0].half_width is None
    assert any("position_gain, delay: nothing" in text for text in again.untold)


def test_a_joint_that_sticks_all_the_time_is_refused() -> None:
    _, logs = short_logs(6)
    stuck = replace(logs[0], position=1e-3 * np.sin(logs[0].time))
    with pytest.raises(ElasticError, match="sticks"):
        fit_servo([stuck])


def test_command_reads_a_log_and_writes_what_others_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("train.commands.identify_servo.fit_servo", quick_fit)
    """Catches a register at 1 that counts as one that nobody has said, and a log that is fitted
    though it is only to be replayed."""
    monkeypatch.chdir(tmp_path)
    truth, logs = short_logs(7)
    for i in (0, 1):
        log = logs[i]
        csv_of(
            tmp_path / f"{i}.csv",
            time=log.time,
            goal=log.goal,
            position=log.position,
            gain=np.full(len(log), log.gain / logs[0].gain),
        )
    pendulum = ["--mass-kg", "0.5", "--lever-m", "0.1"]
    logged = ["--log", "0.csv", "--unfitted", "./1.csv"]
    main(["identify", *logged, *pendulum, "--output", "out"])
    said = capsys.readouterr().out
    assert "a line in the goal" in said
    assert "the logs do not tell" in said
    assert "k_p at gain 1 " in said
    assert "say it by --gain" not in said
    result = ServoIdentification.model_validate_json(Path("out/identification.json").read_text())
    assert result.logs == ("0",)  # what is replayed without a fit was not fitted
    assert result.held_out is not None
    assert [log.log for log in result.held_out.logs] == ["1"]
    assert result.value("load_friction") == pytest.approx(
        truth[NAMES.index("load_friction")], abs=0.1
    )
    joint = read_joints(Path("out/joints.yaml"), ["elbow"])["elbow"]
    assert joint is not None
    assert joint.is_rigid
    gains = result.gains[0].position_gain_nm_per_rad
    assert joint.servo.position_gain == pytest.approx(gains, rel=1e-3)
    assert joint.load_friction == pytest.approx(result.value("load_friction"), rel=1e-3)
    assert Path("out/identification.png").stat().st_size > 1000
    assert parse_yaml(Path("out/config.yaml").read_text())["judged"]["holdout"] == 0.3


def quick_fit(logs: Sequence[ServoLog], *rest: object) -> ServoFit:
    """A fit with a single start."""
    del rest
    return fit_servo(logs, starts=1)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--mass-kg", "0.5"], "both"),
        (["--mass-kg", "0.5", "--lever-m", "0.1", "--plan", "20"], "--plan"),
        (["--mass-kg", "0.5", "--lever-m", "0.1", "--joints", "a", "b"], "name one"),
        (["--robot", "arm.xml"], "--joints"),
        (["--mass-kg", "0.5", "--lever-m", "0.1", "--unfitted", "./log.csv"], "one to fit"),
        (["copy.csv", "--mass-kg", "0.5", "--lever-m", "0.1"], "the same log"),
        (["--mass-kg", "0.5", "--lever-m", "0.1", "--unfitted", "copy.csv"], "one to fit"),
        (["--mass-kg", "0.5", "--lever-m", "0.1", "--holdout", "0.002"], "holds out 0"),
        (["--mass-kg", "0.5", "--lever-m", "0.1", "--holdout", "0.9"], "fits 20 rows"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    options: list[str],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    path = csv_of(tmp_path / "log.csv", **good())
    csv_of(tmp_path / "copy.csv", **good())
    with pytest.raises(SystemExit) as ended:
        main(["identify", "--log", str(path), *options])
    assert ended.value.code == 2
    assert said in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("name", ["./b.csv", "copy.csv"])
def test_a_log_that_is_named_twice_is_left_out_of_the_fit(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a log that is fitted and judged, by another path or as a copy."""
    monkeypatch.chdir(tmp_path)
    for file, gain in (("a.csv", 1.0), ("b.csv", 2.0), ("copy.csv", 2.0)):
        csv_of(tmp_path / file, **good(), gain=np.full(len(good()["time"]), gain))
    said = StringIO()
    console = Console(file=said, width=200)
    assert fitted_logs(["a.csv", "b.csv"], [name], console) == ["a.csv"]
    assert said.getvalue() == "not fitted, as --unfitted says: b.csv\n"


def test_a_log_that_is_not_there_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a message on options where the name of the file is wrong."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main(["identify", "--log", "nolog.csv", "--mass-kg", "0.5", "--lever-m", "0.1"])
    assert "no log at nolog.csv" in capsys.readouterr().err


def held_out_of(on_mrad: float, all_mrad: float, off_rows: int) -> ServoHoldout:
    """Errors of a replay beside rivals that are 20 mrad off."""
    rms = (20.0, 20.0, 20.0, on_mrad)
    return ServoHoldout(
        fitted=("a",),
        replay_mrad=all_mrad,
        errors=tuple(
            ServoError(name=name, rms_mrad=value, slow_mrad=None)
            for name, value in zip(PREDICTIONS, rms, strict=True)
        ),
        logs=(
            LogErrors(
                log="b",
                gain=1.0,
                rms_mrad=rms,
                slow_mrad=None,
                slow_rows=0,
                replay_mrad=all_mrad,
                off_rows=off_rows,
            ),
        ),
    )


def test_the_first_line_names_a_swing_that_is_replayed_wrongly() -> None:
    """Catches a verdict that leaves out the rows with the torque off without a word."""
    said = "with the torque off included the replay has 216.0"
    assert said in verdict(held_out_of(4.0, 216.0, 50))
    assert said in verdict(held_out_of(25.0, 216.0, 50))
    assert "torque off" not in verdict(held_out_of(4.0, 8.0, 50))
    assert "torque off" not in verdict(held_out_of(4.0, 4.0, 0))


def test_rows_with_the_torque_off_are_shown_apart() -> None:
    _, logs = short_logs(3)
    values = np.full(len(NAMES), 0.01)
    half = np.full(len(NAMES), 1e-6)
    sought = np.ones(len(NAMES), dtype=np.bool_)
    fit = ServoFit(tuple(logs), values, half, sought, {}, 1e-3)
    for log in (logs[0], logs[2]):
        held_out = judge_servo(fit, [log])
        off = int((~log.enabled).sum())
        assert held_out.logs[0].off_rows == off
        console = Console(width=200, record=True, quiet=False, file=StringIO())
        show_result(describe_servo(fit, "j", held_out), console)
        shown = console.export_text()
        assert ("all rows, torque off included" in shown) == bool(off)
    assert off > 0


def test_each_gain_is_that_of_its_own_supply() -> None:
    """Catches the voltage of the first log for all, and a torque limit of another voltage."""
    _, logs = short_logs(3)
    volts = (7.4, 12.0, 12.2)
    logs = [replace(log, supply=v) for log, v in zip(logs, volts, strict=True)]
    logs = [replace(logs[0], gain=100.0), *(replace(log, gain=200.0) for log in logs[1:])]
    logs.append(replace(logs[1], gain=100.0))
    values = np.full(len(NAMES), 0.01)
    half = np.full(len(NAMES), 1e-4)
    sought = np.ones(len(NAMES), dtype=np.bool_)
    result = describe_servo(ServoFit(tuple(logs), values, half, sought, {}, 1e-3))
    expected = [(100.0, 7.4), (200.0, 12.1), (100.0, 12.0)]
    assert [(one.register_value, one.supply_v) for one in result.gains] == [
        (register, pytest.approx(supply)) for register, supply in expected
    ]
    for one in result.gains:
        assert one.supply_v is not None
        stiffness = 0.01 * one.register_value * one.supply_v
        assert one.position_gain_nm_per_rad == pytest.approx(stiffness)
        assert one.half_width == pytest.approx(0.01 * stiffness)
    assert result.value("torque_limit") == pytest.approx(0.01 * 7.4)
    assert result.supply_v == 7.4
    console = Console(width=200, record=True, file=StringIO())
    show_result(result, console)
    shown = console.export_text()
    assert "k_p at gain 200, 12.1 V" in shown
    assert "torque_limit at 7.4 V" in shown
    assert "gain register" not in shown


def test_a_log_that_says_no_gain_is_not_of_a_gain_of_one(tmp_path: Path) -> None:
    """Catches a value of the register that nobody has given, and nothing on how to give it."""
    _, logs = short_logs(3)
    one = np.ones(len(NAMES))
    logs = [replace(log, gain=None) for log in logs]
    result = describe_servo(ServoFit(tuple(logs), one, one, one > 0.0, {}, 1e-3), "j")
    assert [own.register_value for own in result.gains] == [None]
    assert any("log a column gain, or say it by --gain" in text for text in result.untold)
    console = Console(width=200, record=True, file=StringIO())
    show_result(result, console)
    assert "at gain" not in console.export_text()
    assert "gain register as in the logs" in result.save(tmp_path)[1].read_text()


def test_a_torque_that_is_switched_before_its_row_is_replayed_so() -> None:
    """A lead of a whole row is the row before; half a row lies between, as a fall has it."""
    log = log_of(np.full(40, 1.0 + WEIGHT * np.sin(1.0) / 5.0), start=1.0, step_s=0.02)
    late = replace(log, enabled=np.arange(40) < 20)
    early = replace(log, enabled=np.arange(40) < 19)
    own = parameters(position_gain=5.0, rotor_inertia=1e-3, motor_damping=0.05)
    lead = NAMES.index("switch_lead")
    played = {}
    for share in (0.0, 0.5, 1.0):
        own[lead] = share * 0.02
        played[share] = Replay.from_log(late).play(own)
    own[lead] = 0.0
    np.testing.assert_allclose(played[1.0], Replay.from_log(early).play(own), atol=1e-12)
    fallen = {share: played[share][19] - played[share][20] for share in played}
    assert fallen[0.0] == pytest.approx(0.0, abs=1e-6)
    assert fallen[0.5] == pytest.approx(fallen[1.0] / 4.0, rel=0.1)


@pytest.mark.slow
def test_intervals_hold_the_truth() -> None:
    """Few of many; `python -m tests.servo_trials` makes 100."""
    held = []
    for seed in range(100, 106):
        rng = np.random.default_rng(seed)
        truth = draw_servo(rng)
        held += holds(fit_servo(make_logs(truth, rng)), truth).values()
    assert np.mean(held) > 0.85


@pytest.mark.slow
def test_figures_of_recorded_servos_are_made(tmp_path: Path) -> None:
    """From made-up logs of the form of the recordings."""
    for motor, gains in (("xl330", (100, 400)), ("sts3250", (32,))):
        for gain in gains:
            for name in ("sin_sin", "up_and_down", "sin_time_square", "lift_and_drop"):
                _recording(tmp_path / f"{motor}_{gain}_{name}.json", motor, gain, name)
    figures = servo_figures(sorted(tmp_path.glob("*.json")), tmp_path)
    assert len(figures["xl330"]["held_out"]) == 3
    assert [row["gain"] for row in figures["xl330"]["sag"]] == [100.0, 400.0]
    assert all(row["identified"] < row["the goal itself"] for row in figures["xl330"]["sag"])
    assert (tmp_path / "sts3250.png").exists()
    rows = servo_rows(figures)
    measures = [(row["servo"], row["measure"]) for row in rows]
    assert measures.count(("xl330", "replay from other starts")) == len(FURTHER_SEEDS)
    assert ("xl330", "replay without priors") in measures
    texts = [{name: str(value) for name, value in row.items()} for row in rows]
    assert priors(texts).startswith("* **Priors.**")


def _recording(path: Path, motor: str, gain: float, name: str) -> None:
    """A made-up recording of a motion."""
    time = 0.01 * np.arange(400)
    swing = {
        "sin_sin": np.sin(2.0 * time) + 0.4 * np.sin(5.0 * time),
        "up_and_down": np.sin(np.minimum(0.5 * time, 1.4)),
        "sin_time_square": np.sin(time**2),
        "lift_and_drop": -np.sin(np.minimum(time, 1.5)),
    }[name]
    on = time < (2.0 if name == "lift_and_drop" else 9.0)
    log = ServoLog("log", time, swing, np.zeros(400), on, gain=gain, load=LOAD)
    own = parameters(
        position_gain=0.8 / gain * np.sqrt(gain / 32.0),
        motor_damping=0.03,
        rotor_inertia=1e-3,
        viscous_friction=0.006,
        load_friction=0.3,
        coulomb_friction=0.01,
    )
    q = Replay.from_log(log).play(own)
    entries = [
        {"timestamp": t, "position": a, "goal_position": g, "torque_enable": bool(e)}
        for t, a, g, e in zip(time.tolist(), q.tolist(), swing.tolist(), on.tolist(), strict=True)
    ]
    facts = {"mass": MASS_KG, "length": LENGTH_M, "kp": gain, "vin": 7.4, "motor": motor}
    path.write_text(json.dumps({**facts, "trajectory": name, "entries": entries}))
