"""Numbers that are kept on the disk: the same to the last bit, or not there."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import mujoco
import numpy as np
import pytest

from elastic_env.core.disk_cache import VARIABLE, DiskCache, cache_folder, key_of
from elastic_env.robots.thormang import standing
from elastic_env.robots.thormang.config import WalkConfig, placed_robot, robot_bank
from elastic_env.world.scenario import make_scenario

NUMBERS = np.array([0.1, -0.0, np.inf, 5e-324, 1.0 / 3.0])
KEY = key_of(["a", b"b"])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of a cache that is on."""
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    return tmp_path / "numbers"


def test_what_is_kept_comes_back_to_the_last_bit(folder: Path) -> None:
    """Catches numbers through text, a lost sign of zero, and a file of another name."""
    cache = DiskCache("numbers")
    assert cache.read(KEY, len(NUMBERS)) is None
    cache.keep(KEY, NUMBERS[::-1][::-1])
    found = cache.read(KEY, len(NUMBERS))
    assert found is not None
    assert found.tobytes() == NUMBERS.tobytes()
    assert found.flags.writeable
    assert [file.name for file in folder.iterdir()] == [f"{KEY}.bin"]


def test_parts_of_a_key_are_kept_apart() -> None:
    """Catches two inputs with one key because their parts run together."""
    keys = {
        key_of(parts) for parts in (["ab", "c"], ["a", "bc"], ["abc"], ["c", "ab"], ["abc", ""])
    }
    assert len(keys) == 5


@pytest.mark.parametrize("length", [0, len(NUMBERS) - 1, len(NUMBERS) + 1])
def test_another_number_of_numbers_is_not_used(folder: Path, length: int) -> None:
    """Catches half a state that is taken for a whole one."""
    cache = DiskCache("numbers")
    cache.keep(KEY, NUMBERS)
    assert cache.read(KEY, length) is None


def test_damage_is_seen(folder: Path) -> None:
    """Catches a flipped bit, a file that ends early or goes on, one of another key, and a folder in
    its place."""
    cache = DiskCache("numbers")
    cache.keep(KEY, NUMBERS)
    file = folder / f"{KEY}.bin"
    whole = file.read_bytes()
    for position in range(0, len(whole), 7):
        changed = bytearray(whole)
        changed[position] ^= 1
        file.write_bytes(changed)
        assert cache.read(KEY, len(NUMBERS)) is None, position
    for content in (b"", whole[:-1], whole[:-8], whole + b"x" * 8, whole[:32]):
        file.write_bytes(content)
        assert cache.read(KEY, len(NUMBERS)) is None
    file.write_bytes(whole)
    assert cache.read(KEY, len(NUMBERS)) is not None
    other = key_of(["other"])
    file.rename(folder / f"{other}.bin")
    assert cache.read(other, len(NUMBERS)) is None
    file.mkdir()
    assert cache.read(KEY, len(NUMBERS)) is None
    cache.keep(KEY, NUMBERS)


def test_damage_is_mended(folder: Path) -> None:
    """Catches a damaged file that stays for ever."""
    cache = DiskCache("numbers")
    cache.keep(KEY, NUMBERS)
    (folder / f"{KEY}.bin").write_bytes(b"nothing")
    cache.keep(KEY, NUMBERS)
    assert cache.read(KEY, len(NUMBERS)) is not None


def test_off_is_off(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Catches a switch that is not looked at, and a folder called off."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(VARIABLE, "off")
    assert cache_folder() is None
    DiskCache("numbers").keep(KEY, NUMBERS)
    assert DiskCache("numbers").read(KEY, len(NUMBERS)) is None
    assert not [*tmp_path.iterdir()]


def test_default_folder_is_the_users(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Catches files beside the sources or in the working directory."""
    monkeypatch.delenv(VARIABLE)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert cache_folder() == tmp_path / ".cache" / "elastic-env"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "own"))
    assert cache_folder() == tmp_path / "own" / "elastic-env"
    monkeypatch.setattr(sys, "platform", "darwin")
    assert cache_folder() == tmp_path / "Library" / "Caches" / "elastic-env"


def test_a_folder_that_cannot_be_made_costs_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Catches an episode that cannot begin because nothing can be kept."""
    file = tmp_path / "file"
    file.touch()
    monkeypatch.setenv(VARIABLE, str(file))
    DiskCache("numbers").keep(KEY, NUMBERS)
    assert DiskCache("numbers").read(KEY, len(NUMBERS)) is None


def test_the_least_recently_used_go_first(folder: Path) -> None:
    """Catches a cache that grows for ever, and one that forgets what is used."""
    cache = DiskCache("numbers", most_files=8)
    keys = [key_of([str(number)]) for number in range(9)]
    for age, key in enumerate(keys[:8]):
        cache.keep(key, NUMBERS)
        os.utime(folder / f"{key}.bin", (1000.0 + age, 1000.0 + age))
    assert cache.read(keys[0], len(NUMBERS)) is not None
    cache.keep(keys[8], NUMBERS)
    there = [cache.read(key, len(NUMBERS)) is not None for key in keys]
    assert there == [True, False, False, False, True, True, True, True, True]


def test_many_at_once_read_what_is_whole(folder: Path) -> None:
    """Catches a file that is read while it is written, and a failure where two write or remove the
    same."""
    cache = DiskCache("numbers", most_files=3)
    keys = [key_of([str(number)]) for number in range(5)]
    values = {key: np.full(500, float(number)) for number, key in enumerate(keys)}

    def work(number: int) -> None:
        for round_ in range(40):
            key = keys[(number + round_) % 5]
            found = cache.read(key, 500)
            if found is None:
                cache.keep(key, values[key])
            else:
                np.testing.assert_array_equal(found, values[key])

    with ThreadPoolExecutor(8) as threads:
        list(threads.map(work, range(8)))


FIRST_STATE = """
import gymnasium, elastic_env, sys
import numpy as np
from elastic_env.robots.thormang import standing
if sys.argv[1] == "kept":
    def never(*args):
        raise AssertionError("it settles again")
    standing.settle = never
env = gymnasium.make("elastic_env/WalkInPlace-v0", scenario="drawn")
print(env.reset(seed=3)[0].tobytes().hex())
for _ in range(3):
    observation, *_ = env.step(np.zeros(12, dtype=np.float32))
print(observation.tobytes().hex())
"""


@pytest.mark.slow
def test_a_second_process_begins_with_the_same_bits(tmp_path: Path) -> None:
    """Catches an episode that depends on whether somebody has played the robot before."""
    found = [
        subprocess.run(
            [sys.executable, "-c", FIRST_STATE, mode],
            check=True,
            capture_output=True,
            text=True,
            env={**os.environ, VARIABLE: cache},
        ).stdout
        for mode, cache in (("off", "off"), ("first", str(tmp_path)), ("kept", str(tmp_path)))
    ]
    assert found[0]
    assert found[0] == found[1] == found[2]


def test_robots_rest_as_if_nothing_were_kept(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Catches a state of another robot: one spring, the load, the physics step or the calculation
    makes a key of its own."""
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    calls = []

    def settle(model: mujoco.MjModel, *start: object) -> standing.Equilibrium:
        calls.append(model)
        count = float(len(calls))
        return standing.Equilibrium(
            np.full(model.nq, count), np.full(model.na, -count), np.full(model.nv, 0.5 * count)
        )

    monkeypatch.setattr(standing, "settle", settle)
    drawn = WalkConfig(scenario=make_scenario("drawn"))
    first, second = robot_bank(drawn.scenario)[:2]
    softer = tuple(joint.replace(stiffness=900.0) for joint in WalkConfig().joints)
    robots = [
        (drawn, first),
        (drawn, second),
        (drawn.replace(timestep_s=0.5e-3), first),
        (drawn.replace(joints=softer), first),
    ]

    def rest(number: int) -> list[float]:
        placed_robot.cache_clear()
        state = placed_robot(*robots[number])[1]  # pyright: ignore[reportArgumentType]  frozen models can be hashed
        return [float(values[0]) for values in (state.qpos, state.act, state.warmstart)]

    try:
        each = [rest(number) for number in range(len(robots))]
        assert each == [[n, -n, 0.5 * n] for n in (1.0, 2.0, 3.0, 4.0)]
        assert [rest(number) for number in range(len(robots))] == each
        assert len(calls) == len(robots)
        monkeypatch.setattr(standing, "_platform", lambda: ("another processor",))
        assert rest(0) == [5.0, -5.0, 2.5]
    finally:
        placed_robot.cache_clear()
