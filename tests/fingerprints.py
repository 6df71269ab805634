"""Digests of what environments and policies produce, to notice a changed bit.

`python -m tests.fingerprints check` plays all cases, of which the tests play half. `python -m
tests.fingerprints write` writes fingerprints.json anew. Do that only where results are meant to
change. `python -m tests.fingerprints add TEXT` adds the new cases whose names hold a text, and
leaves the others as they are.

Bits depend on the processor too: BLAS and NumPy choose their instructions by it. `numerics` is a
digest of a small calculation without this project. Where it differs from the recorded one,
`Fingerprint.levels` are compared instead. A case that was added on another processor than the
others has a digest of its own.
"""

import hashlib
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.catalogue import ON_JOINTS, ON_THE_WALKER, Track
from baselines.policies import sensors_needed
from elastic_env.world.scenario import scenario_names

RECORDED = Path(__file__).with_name("fingerprints.json")
STEPS = 300
WORLDS = 7
POLICIES = {"testbed": ON_JOINTS, "walker": ON_THE_WALKER}
RESIDUALS = {
    "testbed": ("testbed/seed_0",),
    "walker": ("walker_3s/seed_0", "walker_1600ms/seed_0"),
}
SUMMED = ("observation", "reward", "zmp_deviation", "link_error")


@dataclass(frozen=True)
class Case:
    """A rollout: environment with arguments, policy, scenario, number of worlds (1: the scalar
    environment)."""

    env: str
    policy: str
    scenario: str
    worlds: int
    arguments: str = "{}"
    """Of the environment, as JSON."""

    @property
    def name(self) -> str:
        return "/".join([self.env, self.policy, self.scenario, str(self.worlds), self.arguments])


@dataclass(frozen=True)
class Fingerprint:
    """Digest of all bits of a rollout, and a few of its sums for other processors."""

    digest: str
    levels: dict[str, float]
    numerics: str = ""
    """Of the processor that recorded it; empty for that of the whole file."""


def cases() -> list[Case]:
    """Every scenario with one policy, every policy in one scenario, and whole short episodes."""
    found = []
    for env, own in (("testbed", "input"), ("walker", "input_output")):
        baselines_of = [
            name for name, known in POLICIES[env].items() if known.track is not Track.WALKS
        ]
        policies = [*baselines_of, *(f"residual:{name}" for name in RESIDUALS[env])]
        pairs = [(own, scenario) for scenario in scenario_names(walks=env == "walker")]
        pairs += [(policy, "nominal") for policy in policies if policy != own]
        found += [
            Case(env, policy, scenario, worlds)
            for policy, scenario in pairs
            for worlds in (1, WORLDS)
        ]
    sine = '{"reference": {"kind": "sine", "duration_s": 1.0}}'
    walk = '{"step_period": 1.1, "num_steps": 1}'
    whole = [
        ("testbed", "dynamic", "sensor", sine),
        ("walker", "zero", "ideal", walk),
        ("walker", "input", "soft", walk),
    ]
    return found + [
        Case(env, policy, scenario, n, arguments)
        for env, policy, scenario, arguments in whole
        for n in (1, WORLDS)
    ]


_IDS = {"testbed": "elastic_env/Testbed-v0", "walker": "elastic_env/WalkInPlace-v0"}


def _made(case: Case) -> Any:
    arguments = {"scenario": case.scenario, **json.loads(case.arguments)}
    if sensors := sensors_needed(case.policy, case.env == "walker"):
        arguments["sensors"] = sensors
    if case.worlds == 1:
        return gymnasium.make(_IDS[case.env], disable_env_checker=True, **arguments)
    more = {"num_envs": case.worlds, "vectorization_mode": "vector_entry_point", "num_threads": 1}
    return gymnasium.make_vec(_IDS[case.env], **more, **arguments)


def _rollout(case: Case) -> Iterator[dict[str, Any]]:
    """Everything that comes out of the environment, step by step, to the end of the episode or
    STEPS."""
    env = _made(case)
    policy = baselines.make(case.policy, env)
    observation, info = env.reset(seed=7)
    yield {"observation": observation, **info}
    state = None
    start = np.ones(observation.shape[:-1], dtype=np.bool_)
    for _ in range(STEPS if case.arguments == "{}" else 100_000):
        action, state = policy.predict(
            observation, state=state, episode_start=start, deterministic=True
        )
        observation, reward, terminated, truncated, info = env.step(action)
        start = np.zeros_like(start)
        yield {
            "observation": observation,
            "action": action,
            "reward": reward,
            "terminated": terminated,
            "truncated": truncated,
            **info,
        }
        if np.any(terminated) or np.any(truncated):
            break
    env.close()


def _flat(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in sorted(values.items()):
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, np.asarray(value)


def fingerprint(case: Case) -> Fingerprint:
    """Play a case."""
    digest = hashlib.sha256()
    summed = dict[str, list[Any]]()
    kind_of = cache(lambda dtype, shape: f"{dtype}{shape}")  # takes longer than the hash
    for number, step in enumerate(_rollout(case)):
        for key, value in _flat(step):
            digest.update(f"{number}.{key}:{kind_of(value.dtype, value.shape)}".encode())
            digest.update(value.tobytes())
            if key in SUMMED or key.startswith("episode_metrics."):
                summed.setdefault(key, []).append(value)
    levels = {
        key: float(np.nansum(np.abs(np.asarray(values, dtype=np.float64))))
        for key, values in summed.items()
    }
    return Fingerprint(digest.hexdigest(), levels)


def numerics() -> str:
    """Digest of linear algebra, elementary functions and physics that this project has no part
    in."""
    a = np.random.default_rng(0).normal(size=(64, 64))
    spec = (
        "<mujoco><worldbody><body><joint axis='0 1 0'/><geom size='.1' pos='1 0"
        " 0'/></body></worldbody></mujoco>"
    )
    model = mujoco.MjModel.from_xml_string(spec)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 100)
    parts = (a @ a, np.linalg.solve(a, a[0]), a @ a[0], np.sin(a), np.exp(a), np.tanh(a), data.qpos)
    return hashlib.sha256(
        b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
    ).hexdigest()[:16]


def recorded() -> tuple[str, dict[str, Fingerprint]]:
    """Numerics of the recording processor, and the fingerprints by the names of their cases."""
    content = json.loads(RECORDED.read_text())
    return content["numerics"], {
        name: Fingerprint(**values) for name, values in content["cases"].items()
    }


def _as_recorded(found: Fingerprint) -> dict[str, Any]:
    return {key: value for key, value in asdict(found).items() if value != ""}


def write() -> None:
    """Record all cases anew."""
    found = {case.name: _as_recorded(fingerprint(case)) for case in cases()}
    RECORDED.write_text(json.dumps({"numerics": numerics(), "cases": found}, indent=0) + "\n")


def add(text: str) -> list[str]:
    """Record the cases that are new and whose names hold a text; their names."""
    content = json.loads(RECORDED.read_text())
    here = numerics()
    added = [case for case in cases() if text in case.name and case.name not in content["cases"]]
    for case in added:
        found = replace(fingerprint(case), numerics="" if here == content["numerics"] else here)
        content["cases"][case.name] = _as_recorded(found)
    RECORDED.write_text(json.dumps(content, indent=0) + "\n")
    return [case.name for case in added]


def check() -> list[str]:
    """Cases that differ from what was recorded."""
    _, known = recorded()
    return [case.name for case in cases() if fingerprint(case).digest != known[case.name].digest]


if __name__ == "__main__":
    if sys.argv[1:] == ["write"]:
        write()
    elif sys.argv[1:2] == ["add"]:
        print("\n".join(add(sys.argv[2])))
    elif sys.argv[1:] == ["check"]:
        sys.exit("\n".join(check()) or 0)
    else:
        sys.exit(__doc__)
