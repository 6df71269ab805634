"""Servos from logs in time: replay against closed forms and MuJoCo, known truth, bad logs."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from baselines.identification.servo_load import GRAVITY, Load
from baselines.identification.servo_log import ServoLog, read_servo_log
from baselines.identification.servo_replay import NAMES, Replay
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array

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
    played = Replay.of(log).play(parameters(rotor_inertia=1e-3, viscous_friction=damping))
    rate = damping / (2.0 * inertia)
    omega = np.sqrt(WEIGHT / inertia - rate**2)
    t = log.time
    expected = 0.01 * np.exp(-rate * t) * (np.cos(omega * t) + rate / omega * np.sin(omega * t))
    np.testing.assert_allclose(played, expected, atol=2e-5)


def test_free_swing_loses_what_dry_friction_takes() -> None:
    """Each half swing of a spring-like load loses 2 F / (m g l)."""
    log = log_of(np.zeros(400), start=0.05, on=False)
    friction = 0.01 * WEIGHT / 2.0
    played = Replay.of(log).play(parameters(rotor_inertia=1e-3, coulomb_friction=friction))
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
    q = Replay.of(log).play(own)
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
    assert Load.of_joint(model, "j").torque == pytest.approx(WEIGHT)
    assert Load.of_joint(model, "j").inertia == pytest.approx(MASS_KG * LENGTH_M**2)
    assert Load.of_joint(model, "j").rest == pytest.approx(0.0, abs=1e-9)
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
    np.testing.assert_allclose(Replay.of(log).play(own), expected, atol=2e-4)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.1, 5.0), st.floats(0.0, 0.8), st.floats(0.0, 0.3), st.floats(0.0, 0.5))
def test_no_torque_no_goal_gains_energy(start: float, c: float, F: float, Fs: float) -> None:
    """Without torque the pendulum never rises above its start, and friction holds it for ever."""
    angle = min(start, 3.0)
    log = log_of(np.zeros(300), start=angle, on=False)
    q = Replay.of(log).play(
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


def test_parquet_without_its_package_says_what_to_install(tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    try:
        import pyarrow  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ImportError:
        (tmp_path / "log.parquet").write_bytes(b"PAR1")
        with pytest.raises(Exception, match="pyarrow"):
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
    path = tmp_path / "log.parquet"
    log = read_servo_log(path, LOAD, unit="deg", joint="1")
    np.testing.assert_allclose(log.position, columns["position"])
    with pytest.raises(ConfigurationError, match="2 joints"):
        read_servo_log(path, LOAD, unit="deg")


def test_known_torque_replaces_the_weight(tmp_path: Path) -> None:
    columns = good()
    pull = -WEIGHT * np.sin(columns["position"])
    log = read_servo_log(csv_of(tmp_path / "log.csv", **columns, **{"tau_known.j": pull}))
    np.testing.assert_allclose(log.external_torque(log.position), pull)
    assert replace(log, load=LOAD).load.inertia is not None
