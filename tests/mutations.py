"""Configurations and residual folders with mistakes in them, drawn from the shipped ones by a seed.

python -m tests.mutations FIRST COUNT     plays cases in this process and prints what was neither
taken nor refused

Cases may be drawn from configurations with short walks: long ones take seconds to plan.
"""

import copy
import json
import random
import re
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from baselines.policies import RESIDUAL
from elastic_env.core.config import load_yaml
from elastic_env.core.errors import ElasticError
from elastic_env.core.yaml_text import parse_yaml
from train.commands.bench import BenchConfig
from train.commands.compare_config import CompareConfig
from train.commands.comparison import try_out
from train.evaluate.conditions import PolicySpec
from train.evaluate.residual_seeds import expand, origin
from train.learn.train_config import TrainConfig, training_worlds

ROOT = Path(__file__).parents[1]
CONFIGS = sorted((ROOT / "configs").glob("*.yaml"))
RESIDUALS = sorted((ROOT / "baselines" / "trained").glob("*/seed_0"))

NASTY: list[Any] = [
    None,
    True,
    False,
    0,
    -1,
    1,
    2,
    5,
    10**6,
    10**9,
    2**31,
    2**63,
    10**30,
    -(10**30),
    0.5,
    -0.5,
    1e-300,
    1e300,
    1e-9,
    float("nan"),
    float("inf"),
    -float("inf"),
    "",
    " ",
    "x",
    "x" * 300,
    "../../x",
    "/",
    "a/b",
    "nul\x00byte",
    "\ud800",
    "ärger€",
    "🙂",
    "2001-99-99",
    "2001-01-01",
    "1e3",
    "json:loads",
    "no_such:f",
    ":",
    "os:sep",
    "*",
    "[",
    "residual:",
    "residual:*",
    "residual:/",
    "residual:x",
    "-",
    "+",
    "ideal+ideal",
    "soft+soft",
    "hold",
    "walker",
    "testbed",
    [],
    {},
    [[]],
    [None],
    [0],
    [-1.5, 2],
    ["x"],
    [1, 2, 3],
    [0.5, 0.5, 0.5],
    {"x": 1},
    {"kind": "sine"},
    {"kind": "hold", "positions": 900},
    {"kind": "steps", "moves": 1000},
    {"step_period": 3, "num_steps": 10**6},
    {"name": "x"},
    {"": 0},
    [[1, 2], [3]],
    1e200,
    -1e9,
    "a b " * 2500,
    "'x" * 5000,
    ["x" * 10_000],
    {"x" * 10_000: 1},
    {"device": "cuda"},
    {"log_std_init": 1e9},
    [1] * 2000,
    {str(i): i for i in range(2000)},
    "a\nb",
    "\u202e",
]
ADDED = [
    b"\x00",
    b"[" * 5000,
    b"{a: " * 3000,
    b"&a [*a]",
    b"!!timestamp x",
    b"9" * 5000,
    b"\xff",
    b"? ",
    b"- ",
    b"*a",
    b"<<: ",
    b"'",
    b"\t",
    b": ",
    b"1: 2\n",
    b"x: !!binary aGk=",
]
KEYS = [
    "name",
    "env",
    "references",
    "reference",
    "scenarios",
    "policies",
    "options",
    "env_options",
    "joint",
    "stiffness",
    "timestep_s",
    "gait",
    "robot",
    "reward",
    "algorithm",
    "algorithm_options",
    "policy_kwargs",
    "n_steps",
    "net_arch",
    "worlds",
    "sweep",
    "values",
    "option",
    "groups",
    "seeds",
    "label",
    "level",
    "num_envs",
    "settings",
    "scale",
    "learning_rate",
    "log_std_init",
    "device",
    "seed",
    "policy",
    "weights",
    "base",
    "ranges",
    "figures",
    "metric",
    "map",
    "history",
    "observe",
    "joints",
    "decision_period",
    "bank",
    "num_steps",
    "damping",
    "servo",
    "gains",
    "x",
    "<<",
    "",
]


def places(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of all values within a tree."""
    items = (
        tree.items()
        if isinstance(tree, dict)
        else enumerate(tree)
        if isinstance(tree, list)
        else ()
    )
    return [found for key, value in items for found in [(*path, key), *places(value, (*path, key))]]


def _nested(depth: int) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = [value]
    return value


def _at(tree: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        tree = tree[key]
    return tree


def change(tree: Any, draw: random.Random) -> Any:
    """A tree with one mistake; it is changed in place."""
    known = places(tree)
    value = copy.deepcopy(draw.choice([*NASTY, _nested(20), _nested(60)]))
    if not known or draw.random() < 0.02:
        return value
    *where, key = draw.choice(known)
    holder = _at(tree, tuple(where))
    kind = draw.randrange(6)
    if kind <= 2:
        holder[key] = value
    elif kind == 3:
        del holder[key]
    elif kind == 4 and isinstance(holder, dict):
        holder[draw.choice([*KEYS, f"{key}s", f"{key}\x00"])] = holder.pop(key)
    elif isinstance(holder, dict):
        holder[draw.choice(KEYS)] = value
    else:
        holder.append(holder[key])
    return tree


def damage(data: bytes, draw: random.Random) -> bytes:
    """Bytes with some of them flipped, cut, doubled or added."""
    place = draw.randrange(len(data) + 1)
    text = bytearray(data)
    match draw.randrange(5):
        case 0:
            return data[:place]
        case 1:
            return data[:place] + draw.choice(ADDED)
        case 2:
            return data + data
        case 3:
            return data[:place] + data[min(place + draw.randrange(200), len(data)) :]
    for _ in range(draw.randrange(1, 6)):
        if text:
            text[draw.randrange(min(len(text), 2000))] ^= 1 << draw.randrange(8)
    return bytes(text)


def with_short_walks(text: str) -> str:
    """A configuration whose walks have six steps where they have more."""
    return re.sub(r"num_steps(: |=)(20|40)\b", r"num_steps\g<1>6", text)


def mutated_configuration(
    draw: random.Random, path: Path, short_walks: bool
) -> Callable[[Path], None]:
    """Write a configuration with mistakes; what reads it, now and then what is not meant to."""
    source = draw.choice(CONFIGS)
    meant = next(
        (reader for name, reader in READERS.items() if source.name.startswith(name)),
        read_comparison,
    )
    text = source.read_text(encoding="utf-8")
    _mutate(draw, with_short_walks(text) if short_walks else text, path)
    return meant if draw.random() < 0.95 else draw.choice(list(READERS.values()))


def _mutate(draw: random.Random, text: str, path: Path) -> None:
    if draw.random() < 0.3:
        path.write_bytes(damage(text.encode(), draw))
        return
    tree = parse_yaml(text)
    for _ in range(draw.randrange(1, 4)):
        tree = change(tree, draw)
    path.write_text(yaml.safe_dump(tree, allow_unicode=False), encoding="utf-8")


def mutated_residual(draw: random.Random, folder: Path) -> None:
    """Write a residual folder with mistakes."""
    source = draw.choice(RESIDUALS)
    shutil.copytree(source, folder)
    description = folder / "residual.json"
    weights = folder / "weights.safetensors"
    kind = draw.randrange(10)
    if kind < 6:
        tree = json.loads(description.read_text(encoding="utf-8"))
        for _ in range(draw.randrange(1, 4)):
            tree = change(tree, draw)
        description.write_text(json.dumps(tree), encoding="utf-8")
    elif kind < 9:
        file = draw.choice([description, weights, weights])
        file.write_bytes(damage(file.read_bytes(), draw))
    else:
        file, other = draw.sample([description, weights], 2)
        draw.choice(
            [lambda: file.unlink(), lambda: shutil.copy(file, other), lambda: file.write_bytes(b"")]
        )()


def read_comparison(path: Path) -> None:
    """All that `elastic compare` does before it simulates; of many cells the first."""
    try_out(load_yaml(path, CompareConfig).conditions()[:3])


def read_training(path: Path) -> None:
    """What `elastic train` does before it simulates, on few worlds."""
    config = load_yaml(path, TrainConfig)
    training_worlds(config, [(scenario, 1) for scenario, _ in config.shares[:3]], 1).close()


def read_bench(path: Path) -> None:
    """What `elastic bench` does before it simulates; of many cases the first."""
    try_out([case.condition for case in load_yaml(path, BenchConfig).cases[:2]])


def read_residual(folder: Path) -> None:
    """All that a comparison does with a residual before and after it simulates."""
    config = CompareConfig(
        name="x",
        env="walker",
        policies=[PolicySpec(name=f"{RESIDUAL}{folder}")],
        references=[3],
        scenarios=["ideal"],
    )
    members = [entrant.member for entrant in expand(config.policies) if entrant.member is not None]
    origin(members)
    try_out(config.conditions())


LONGEST_S = 10.0
LONGEST_ERROR = 2200
"""A case that takes longer [s of processor time], or an error of more characters, is a fault."""

READERS: dict[str, Callable[[Path], None]] = {
    "train": read_training,
    "bench": read_bench,
    "": read_comparison,
}
"""What reads the shipped configurations, by the beginning of their names."""


def play(number: int, folder: Path, short_walks: bool = False) -> str:
    """Outcome of a case: "taken", or what refused it.

    Raises:
        Exception: What is no error of ours: a fault.
    """
    draw = random.Random(number)
    path = folder / f"case_{number}"
    try:
        if draw.random() < 0.3:
            mutated_residual(draw, path)
            read_residual(path)
        else:
            mutated_configuration(draw, path, short_walks)(path)
    except ElasticError as error:
        return str(error)
    finally:
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    return "taken"


def main(first: int, count: int, short_walks: bool = False) -> int:
    """Play cases and say which were faults, and how many were taken; the number of faults."""
    faults = 0
    taken = 0
    slowest = (0.0, 0)
    longest = 0
    with tempfile.TemporaryDirectory() as folder:
        for number in range(first, first + count):
            began = time.process_time()
            try:
                outcome = play(number, Path(folder), short_walks)
                taken = taken + (outcome == "taken")
                longest = max(longest, len(outcome))
                if len(outcome) > LONGEST_ERROR:
                    faults += 1
                    print(
                        f"case {number}: an error of {len(outcome)} characters, {outcome[:200]!r}",
                        flush=True,
                    )
            except Exception:
                faults += 1
                print(
                    "case"
                    f" {number}:\n{''.join(traceback.format_exc().splitlines(keepends=True)[-9:])}",
                    flush=True,
                )
            if time.process_time() - began > LONGEST_S:
                faults += 1
                print(f"case {number}: {time.process_time() - began:.1f} s", flush=True)
            slowest = max(slowest, (time.process_time() - began, number))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{count} cases: {faults} faults, {taken} taken; slowest {slowest[0]:.1f} s (case"
        f" {slowest[1]})"
    )
    print(f"peak {peak:.0f} MB, longest error {longest} characters")
    return faults


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2])) > 0)
