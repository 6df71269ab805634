"""The environment on hardware, the IMU's stream and the commands, on an emulated bus."""

import copy
import csv
import gc
import json
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
from elastic_env.core.errors import ConfigurationError
from elastic_env.hardware.buses.bus import States
from elastic_env.hardware.emulator.launch import EmulatorConfig, RunningEmulator
from elastic_env.hardware.errors import HardwareError
from elastic_env.hardware.imu import Attitude, AttitudeError, AttitudeStream, SharedSample
from elastic_env.hardware.live import plant
from elastic_env.hardware.safety import realtime
from elastic_env.hardware.safety.supervised_bus import Cycle
from elastic_env.hardware.settings import HardwareSettings
from elastic_env.robots.testbed.environment import configure_testbed
from tests.busy import once_more
from tests.emulators import wait_until_rest
from tests.hardware_trials import trials as hardware_trials
from tests.hardware_trials.__main__ import prove
from train.commands.cli import main
from train.commands.identify import Identify, JointOptions, identified_environments
from train.commands.options import HardwareOptions

QUICK = {"kind": "sine", "amplitude": 0.1, "frequency_hz": 0.5, "duration_s": 0.3, "onset_s": 0.4}
PATIENT = {"patience_cycles": 10, "hang_s": 0.09}
"""A busy computer delays pseudo-terminals."""

pytestmark = once_more


@pytest.fixture(scope="module")
def running() -> Iterator[RunningEmulator]:
    with RunningEmulator() as running:
        yield running


@pytest.fixture
def emulator(running: RunningEmulator) -> RunningEmulator:
    """The one emulator, at rest and without the faults that a test before may have left."""
    running.faults(imu_silent=False, imu_corrupted=0)
    wait_until_rest(running)
    return running


def make_hardware(emulator: RunningEmulator, **arguments: Any) -> Any:
    given = {
        "reference": QUICK,
        "confirm": False,
        "approach_rad_s": 2.0,
        "limits": PATIENT,
        "imu_oldest_s": 0.3,
    }
    given |= arguments
    return gymnasium.make(
        "elastic_env/HardwareTestbed-v0", disable_env_checker=True, port=emulator.port, **given
    )


def play(env: Any, policy: Any) -> tuple[list[Any], dict[str, Any], float]:
    observation, info = env.reset(seed=0)
    seen = [observation]
    state = None
    start = np.array(True)
    reward = 0.0
    while True:
        action, state = policy.predict(observation, state=state, episode_start=start)
        observation, reward, terminated, truncated, info = env.step(action)
        seen.append(observation)
        start = np.array(False)
        if terminated or truncated:
            return seen, info, reward


@pytest.mark.slow
def test_hardware_has_the_spaces_the_keys_and_the_motion_of_the_simulation(
    emulator: RunningEmulator,
) -> None:
    """Catches a policy that would see something else on the real joint: every column agrees with
    the simulation's."""
    simulated: Any = gymnasium.make(
        "elastic_env/Testbed-v0", disable_env_checker=True, reference=QUICK
    )
    real = make_hardware(emulator, imu_port=emulator.imu_port)
    assert real.observation_space == simulated.observation_space
    assert real.action_space == simulated.action_space
    expected, told, _ = play(simulated, baselines.make("input", simulated))
    seen, info, reward = play(real, baselines.make("input", real))
    real.close()
    assert set(info) >= set(told)
    assert set(info["episode_metrics"]) >= set(told["episode_metrics"])
    assert set(info) - set(told) == {"jitter", "period", "overruns", "missed_replies", "limited"}
    last = np.array(seen[-1]), np.array(expected[-1])
    np.testing.assert_allclose(last[0][[0, 5]], last[1][[0, 5]], atol=0.02)
    np.testing.assert_array_equal(last[0][2:5], last[1][2:5])
    assert info["link_angle"] == pytest.approx(told["link_angle"], abs=0.03)
    assert np.isfinite(reward)
    assert emulator.state()["torque_on"] == [False]


@pytest.mark.slow
def test_a_link_that_turns_against_its_motor_stops_the_motion(emulator: RunningEmulator) -> None:
    """Catches an IMU whose sign is wrong, by which a policy would be scored and identification
    would fit K."""
    env = make_hardware(
        emulator, imu_port=emulator.imu_port, imu_sign=-1, reference={"kind": "hold", "lower": -0.5}
    )
    with pytest.raises(HardwareError, match="imu_sign") as caught:
        env.reset()
    assert caught.value.__notes__ == [f"torque at {emulator.port} is off"]
    assert emulator.state()["torque_on"] == [False]


@pytest.mark.slow
def test_a_testbed_that_is_forgotten_lets_go(emulator: RunningEmulator) -> None:
    """Catches a cell of a notebook that cannot be run a second time: its own kernel has the
    ports."""

    def forget() -> None:
        make_hardware(emulator, imu_port=emulator.imu_port).reset()

    forget()
    gc.collect()
    assert emulator.state()["torque_on"] == [False]
    AttitudeStream(emulator.imu_port, oldest_s=0.5).close()
    wait_until_rest(emulator)
    again = make_hardware(emulator)
    again.reset()
    again.close()


@pytest.mark.slow
def test_a_stalled_imu_ends_the_episode_with_torque_off(emulator: RunningEmulator) -> None:
    """Catches an old attitude that is used as a new one."""
    env = make_hardware(emulator, imu_port=emulator.imu_port)
    env.reset()
    emulator.faults(imu_silent=True)
    with pytest.raises(AttitudeError, match="has sent no attitude") as caught:
        _step_for(env, 1.0)
    assert caught.value.__notes__ == [f"torque at {emulator.port} is off"]
    assert emulator.state()["torque_on"] == [False]


def _step_for(env: Any, duration_s: float) -> None:
    begin = time.monotonic()
    while time.monotonic() - begin < duration_s:
        env.step(np.zeros(1, dtype=np.float32))


def test_a_sample_whose_writer_died_within_is_none() -> None:
    """Catches a control loop that waits for ever, under torque, for the second half of a sample."""
    file = SharedSample.file()
    writer = SharedSample(file)
    reader = SharedSample(file)
    os.close(file)
    seen: list[Attitude | None] = []
    sample = Attitude(1.0, 0.1, 0.2, 0.3)
    writer._memory[0] = 1  # odd: a write has begun
    _within_seconds(lambda: seen.append(reader.get()))
    writer._memory[0] = 0
    writer.write(sample)
    seen.append(reader.get())
    writer._memory[0] = 3
    _within_seconds(lambda: seen.append(reader.get()))
    writer._memory[0] = 0  # as while a counter is packed
    _within_seconds(lambda: seen.append(reader.get()))
    assert seen == [None, sample, sample, sample]


def _within_seconds(function: Any) -> None:
    thread = threading.Thread(target=function, daemon=True)
    thread.start()
    thread.join(10.0)
    assert not thread.is_alive()


class StillBus:
    """A servo that stands where it is told to, on a clock that only its bus moves."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.goal = 0.0
        self.is_closed = False

    def monotonic(self) -> float:
        return self.now_s

    def disable(self) -> None:
        pass

    def close(self) -> None:
        self.is_closed = True

    def enable(self, limits: Any) -> Any:
        return np.zeros(1)

    def keep(self, goals: Any) -> None:
        pass

    def stop_keeping(self) -> None:
        self.now_s += 0.006  # the rest of a cycle

    def exchange(self, goals: Any, at: float) -> Cycle:
        late_s = max(self.now_s - at, 0.0)
        self.now_s = max(at, self.now_s)
        self.goal = float(goals[0])
        yes = np.ones(1, dtype=np.bool_)
        no = np.zeros(1, dtype=np.bool_)
        states = States(
            np.array(goals), np.zeros(1), np.full(1, 1.0 + self.goal), yes, no, self.now_s
        )
        return Cycle(states, np.array(goals), no, is_held=False, late_s=late_s)


@pytest.fixture
def still(monkeypatch: pytest.MonkeyPatch) -> StillBus:
    bus = StillBus()
    monkeypatch.setattr(plant, "SupervisedBus", lambda *_: bus)
    monkeypatch.setattr(plant, "time", bus)
    monkeypatch.setattr(realtime, "Pace", partial(realtime.Pace, clock=bus))
    monkeypatch.setattr(plant.realtime, "prefer_realtime", lambda _: None)
    return bus


def make_still(**arguments: Any) -> Any:
    given = {"reference": QUICK, "confirm": False, "approach_rad_s": 2.0} | arguments
    return gymnasium.make(
        "elastic_env/HardwareTestbed-v0", disable_env_checker=True, port="still", **given
    )


def refuse_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on whoever opens a port fails the test."""
    for name in ("SupervisedBus", "AttitudeStream"):
        monkeypatch.setattr(plant, name, lambda *_: pytest.fail("a port was opened"))


def test_without_an_imu_the_link_is_unknown(
    still: StillBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches an encoder that is passed off as the link's angle, and a torque that is passed off
    as measured; and a port that is opened for a step outside an episode."""
    env = make_still()
    env.reset()
    _, reward, _, _, info = env.step(np.zeros(1, dtype=np.float32))
    unknown = {"link_angle", "link_angle_imu", "link_error", "link_error_imu", "deflection"}
    assert {name for name in unknown if not np.isnan(info[name])} == set()
    assert np.isnan(reward)
    assert np.isfinite([info["joint_torque"], info["servo_error"], info["time_s"]]).all()
    with pytest.raises(HardwareError, match="no truth"):
        env.unwrapped.truth()
    assert not still.is_closed
    env.close()
    assert still.is_closed
    refuse_ports(monkeypatch)
    with pytest.raises(HardwareError, match=r"no episode is under way at still.* reset\(\)"):
        env.step(np.zeros(1, dtype=np.float32))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_link_that_turns_against_its_motor_is_no_reset(
    still: StillBus, monkeypatch: pytest.MonkeyPatch, sign: int
) -> None:
    """Catches an IMU whose sign is wrong, by which a policy would be scored and identification
    would fit K; and a motion that this does not end."""
    attitude = lambda: Attitude(still.now_s, still.goal, 0.0, 0.0)  # noqa: E731
    imu = SimpleNamespace(latest=attitude, close=lambda: None)
    monkeypatch.setattr(plant, "AttitudeStream", lambda *_: imu)
    hold = {"kind": "hold", "lower": -0.5}
    env = make_still(imu_port="imu", imu_sign=sign, reference=hold)
    if sign == 1:
        env.reset()
        assert not still.is_closed
        env.close()
        return
    with pytest.raises(HardwareError, match="imu_sign"):
        env.reset()
    assert still.is_closed


def test_nothing_moves_unless_somebody_agrees(
    still: StillBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a motion that begins in a pipeline or a notebook without anybody there."""
    refuse_ports(monkeypatch)
    with pytest.raises(HardwareError, match="agree"):
        make_still(confirm=True).reset()
    assert still.now_s == 0.0


def test_a_reference_beyond_the_limits_is_refused_before_anything_moves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches an episode that would be cut off by the limits half-way."""
    refuse_ports(monkeypatch)
    with pytest.raises(HardwareError, match="limits allow"):
        make_still(limits={"lowest_rad": -0.05})
    for wrong, words in (
        ({"prot": 1}, "port"),
        ({"scenario": "soft"}, "simulation"),
        ({"form": "rigid"}, "form"),
    ):
        with pytest.raises(
            ConfigurationError if "prot" in wrong or "form" in wrong else HardwareError, match=words
        ):
            make_still(**wrong)


def test_the_first_step_may_come_any_time_after_the_reset(still: StillBus) -> None:
    """Catches a period that is counted from the reset: every episode would begin with an overrun
    that is none."""
    env = make_still()
    env.reset()
    still.now_s += 2.0
    info = env.step(np.zeros(1, dtype=np.float32))[-1]
    assert info["overruns"] == 0
    assert info["period"] == pytest.approx(0.004)
    env.close()


def test_the_last_step_tells_of_itself_and_not_of_the_way_back(still: StillBus) -> None:
    """Catches torque and timing that are measured when the pendulum has been brought back to
    rest."""
    env = make_still()
    env.reset()
    torques = []
    is_over = False
    while not is_over:
        *_, is_over, info = env.step(np.full(1, 0.2, dtype=np.float32))
        torques.append(info["joint_torque"])
    assert still.goal == 0.0
    assert info["period"] == pytest.approx(0.004)
    assert torques[-1] == pytest.approx(torques[-2], abs=0.1)
    assert torques[-1] == pytest.approx(1.0 + info["reference_angle"] + 0.2)


def test_nothing_that_was_measured_is_not_met() -> None:
    """Catches a traceback that ends all other measurements with it."""
    trial = hardware_trials._ending("killed", "torque off", 2, [], 2)
    assert not trial.is_met
    assert "all 2 tries had stopped" in trial.measured


@pytest.mark.slow
def test_a_measurement_of_which_every_try_is_spoiled_is_not_met(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches a measurement that tries for ever, or that ends in a traceback."""
    monkeypatch.setattr(hardware_trials, "_end_once", lambda *_: None)
    trial = hardware_trials.TRIALS["killed"](0.02)
    assert not trial.is_met
    assert "all 2 tries had stopped" in trial.measured


def test_a_measurement_that_does_not_exist_is_refused() -> None:
    """Catches half an hour of measurements that were not asked for."""
    with pytest.raises(ConfigurationError, match="killed"):
        prove(only=("kiled",))


def test_mounting_turns_angles_into_the_joints() -> None:
    """Catches a sign that is applied to the angle but not to the limits."""
    mounting = HardwareSettings(
        port="p", direction=-1, zero_rad=0.5, limits={"lowest_rad": -1.0, "highest_rad": 0.3}
    )  # type: ignore[arg-type]
    assert mounting.joint_angle(mounting.servo_angle(0.7)) == pytest.approx(0.7)
    assert mounting.servo_angle(0.2) == pytest.approx(0.3)
    limits = mounting.servo_limits
    assert (limits.lowest_rad, limits.highest_rad) == pytest.approx((0.2, 1.5))
    assert Attitude(0.0, 0.1, -0.2, 0.0).link_angle("pitch", -1, -0.2) == 0.0
    assert Attitude(0.0, 0.1, -0.2, 0.0).link_angle("pitch", -1, 0.05) == pytest.approx(0.25)
    assert Attitude(0.0, 3.0, 0.0, 0.0).link_angle("roll", 1, -0.5) == pytest.approx(
        3.5 - 2 * np.pi
    )


def test_identification_takes_the_pendulum_that_is_mounted(tmp_path: Path) -> None:
    """Catches K that is found with the torque of another pendulum."""
    (tmp_path / "m.yaml").write_text(
        "port: /dev/a\nimu_port: /dev/b\npendulum: {gravity_torque: 52.0, mass: 8.0}\n"
    )
    hardware = HardwareOptions(mounting=tmp_path / "m.yaml")
    envs = identified_environments(
        Identify(hardware=hardware, testbed=JointOptions(second_mass=0.5))
    )
    pendulums = [env.unwrapped.task.config.pendulum for env in envs]
    assert [(p.gravity_torque, p.mass) for p in pendulums] == [(52.0, 8.0), (26.0, 4.0)]


def command(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """Run a command; one that fails says why where `once_more` looks for it."""
    try:
        main(arguments)
    except SystemExit:
        pytest.fail(capsys.readouterr().err)


@pytest.mark.slow
def test_commands_run_on_hardware(
    emulator: RunningEmulator,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Catches --port that is not passed on: evaluate and run play on the emulated joint with its
    mounting."""
    residual = Path("baselines/trained/testbed/seed_0").absolute()
    monkeypatch.chdir(tmp_path)
    Path("mounting.yaml").write_text(
        f"port: {emulator.port}\napproach_rad_s: 2.0\nimu_oldest_s: 0.3\nlimits: {{patience_cycles:"
        " 10, hang_s: 0.09, slew_rad_s: 2.5}\npendulum: {gravity_torque: 60.0, mass: 11.0}\n"
    )
    options = ["--mounting", "mounting.yaml", "--imu-port", emulator.imu_port, "--yes"]
    assert (
        HardwareOptions(mounting=Path("mounting.yaml"), yes=True).arguments["limits"]["slew_rad_s"]
        == 2.5
    )
    patient = HardwareOptions(mounting=Path("mounting.yaml"), yes=True, patient=True).arguments
    assert [patient["limits"][name] for name in ("patience_cycles", "slew_rad_s")] == [10, 2.5]
    assert patient["imu_oldest_s"] == 0.3  # as the file says, which is more patient still
    assert HardwareOptions(port="p", yes=True, patient=True).arguments["imu_oldest_s"] == 0.2
    assert (
        "pendulum" not in HardwareOptions(port=emulator.port, yes=True).arguments
    )  # a configuration may say it
    reference = ["--reference", json.dumps(QUICK)]
    command(
        [
            "evaluate",
            "--policy",
            f"residual:{residual}",
            *reference,
            *options,
            "--output",
            "evaluated",
        ],
        capsys,
    )
    (episode,) = csv.DictReader(Path("evaluated/episodes.csv").read_text().splitlines())
    assert episode["scenario"] == "hardware"
    assert 0.0 < float(episode["link_error_imu_rms_rad"]) < 0.05
    command(["hardware", "run", *reference, *options, "--output", "run"], capsys)
    rows = list(csv.DictReader(Path("run/log.csv").read_text().splitlines()))
    assert len(rows) == 425
    assert all(float(row["period"]) > 0.0 for row in rows)
    assert json.loads(Path("run/metrics.json").read_text())["limited"] == max(
        int(row["limited"]) for row in rows
    )
    capsys.readouterr()
    main(["hardware", "scan", emulator.port])
    assert capsys.readouterr().out.count("H54-200-S500-R") == 1  # at its own rate only


def test_a_mounting_needs_no_port_of_its_own(tmp_path: Path) -> None:
    """Catches --port that is looked at after the file was refused for having none, and errors
    without a cure."""
    mounting = tmp_path / "mounting.yaml"
    mounting.write_text("direction: -1\n")
    given = HardwareOptions(
        port="/dev/ttyUSB7", imu_port="/dev/ttyACM7", mounting=mounting
    ).arguments
    assert (given["port"], given["imu_port"], given["direction"]) == (
        "/dev/ttyUSB7",
        "/dev/ttyACM7",
        -1,
    )
    for text, port, words in (
        ("direction: -1", None, "'port': .* --port"),
        ("limits: 5", "p", "limits must be a mapping"),
        ("limits: {torque_nm: 200}", "p", "<= 84"),
        ("imu_port: p", "p", "port of their own"),
        ("", None, "an empty file"),
        ("limits: {highest_rad: 4}\nzero_rad: 3", "p", "zero_rad 3 are 1.40 to 7.00 rad"),
    ):
        mounting.write_text(text)
        with pytest.raises(ConfigurationError, match=words):
            _ = HardwareOptions(port=port, mounting=mounting).arguments
    with pytest.raises(ConfigurationError, match="is a folder"):
        _ = HardwareOptions(port="p", mounting=tmp_path).arguments


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "words"),
    [
        (signal.SIGINT, "interrupted"),
        pytest.param(signal.SIGTERM, "ended by SIGTERM", marks=pytest.mark.slow),
    ],
)
def test_an_interrupted_run_keeps_its_steps_and_says_that_torque_is_off(
    emulator: RunningEmulator, tmp_path: Path, number: signal.Signals, words: str
) -> None:
    """Catches a log that is written at the end only, and an end after which nobody knows what the
    servo does.

    And a motion that waits for the compiler, of which nothing is kept, where steps are scored.
    """
    mounting = tmp_path / "mounting.yaml"
    mounting.write_text("approach_rad_s: 2.0\nlimits: {patience_cycles: 10, hang_s: 0.09}\n")
    command = [
        *(
            sys.executable,
            "-c",
            "from train.commands.cli import main; main()",
            "hardware",
            "run",
            "--port",
            emulator.port,
        ),
        *(
            "--mounting",
            str(mounting),
            "--yes",
            "--reference",
            "sine",
            "--output",
            str(tmp_path / "run"),
        ),
    ]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "compiled")},
    ) as program:
        log = tmp_path / "run" / "log.csv"
        deadline = time.monotonic() + 120.0
        while time.monotonic() < deadline and not (
            log.exists() and log.read_text().count("\n") > 500
        ):
            assert program.poll() is None
            time.sleep(0.05)  # what is kept is seen on the disk while the run goes on
        program.send_signal(number)
        time.sleep(0.01)
        program.send_signal(number)  # a nervous user's second one takes nothing from what is said
        said, complained = program.communicate(timeout=30)
    rows = list(csv.DictReader(log.read_text().splitlines()))
    assert len(rows) >= 500, complained
    assert f"cut short; the {len(rows)} steps until then are in {log}" in said
    assert f"{words}; torque at {emulator.port} is off" in complained
    assert program.returncode == 128 + number
    assert emulator.state()["torque_on"] == [False]


def test_commands_say_what_hardware_needs(capsys: pytest.CaptureFixture[str]) -> None:
    """Catches an identification without the link's angle, and options of hardware that are
    silently ignored."""
    for arguments, words in (
        (["evaluate", "--port", "/dev/null", "--scenario", "soft"], "--scenario"),
        (
            ["identify", "--port", "/dev/null", "--imu-port", "p", "--scenario", "soft"],
            "--scenario",
        ),
        (["hardware", "check", "/dev/null", "--imu-port", "/dev/null"], "port of their own"),
        (["hardware", "check", "/dev/null", "--ids"], "ids must be different"),
        (["hardware", "check", "/dev/null", "--ids", "300"], "from 0 to 252"),
        (["hardware", "scan", "/dev/null"], "no serial port"),
        (["hardware", "scan", "/tmp"], "a folder"),
        (["identify", "--port", "/dev/null"], "--imu-port"),
        (["identify", "--yes"], "--port"),
        (["evaluate", "--patient"], "--patient is for a real testbed"),
        (["evaluate", "--env", "walker", "--port", "/dev/null"], "testbed"),
        (["hardware", "run"], "--port"),
    ):
        with pytest.raises(SystemExit):
            main(arguments)
        assert words in capsys.readouterr().err


@pytest.mark.slow
def test_the_links_deflection_is_that_of_the_emulated_spring() -> None:
    """Catches counts, signs or angles that are off anywhere between the emulated joint and what a
    policy is told.

    The joint is softer than the paper's, so that an assumed K would not pass, and damped, so that
    it settles quickly.
    """
    soft = configure_testbed(scenario="ideal", stiffness=300.0, joint={"damping": 60.0})
    with RunningEmulator(EmulatorConfig(testbed=soft)) as emulator:
        env = make_hardware(
            emulator, imu_port=emulator.imu_port, reference={"kind": "hold", "lower": -0.5}
        )
        _, info = env.reset()
        env.close()
    torque = soft.true_pendulum.torque(np.array(info["link_angle"]))
    assert torque < -20.0
    assert info["deflection"] == pytest.approx(torque / 300.0, rel=0.05)


@pytest.mark.parametrize("copied", [copy.deepcopy, pickle.dumps])
def test_hardware_is_not_copied(still: StillBus, copied: Any) -> None:
    """Catches two environments at one port, or an error from the depths of a socket."""
    env = make_still()
    with pytest.raises(
        HardwareError, match="cannot be copied or pickled: there is one joint at its port"
    ):
        copied(env)
    env.close()
