"""Training of residuals with Stable-Baselines3: configuration, worlds, checkpoints, evaluation on the way, export.

A run is a folder per training seed: `checkpoint/` to go on from, `best/` and `last/` as policies that need no torch,
`progress.csv`, and TensorBoard's files. Training is deterministic on one thread; a run that is interrupted or killed
and resumed ends with the same weights, bit for bit, as one that was not.
"""

import csv
import importlib
import os
import random
import shutil
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import stable_baselines3
import torch
from gymnasium.vector import AutoresetMode
from pydantic import Field, field_validator
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecNormalize

import baselines
from baselines.correction import ResidualSettings
from baselines.residual import ResidualDescription, require_plain_base, save_residual
from elastic_env.config import Model, quantity
from elastic_env.errors import ConfigurationError, unknown_name
from train.conditions import Condition, Motion, PolicySpec
from train.environments import environment
from train.evaluate import evaluate, make_vector_env
from train.export import network_of
from train.mixed_env import MixedVectorEnv
from train.residual_env import ResidualVectorWrapper
from train.runs import provenance
from train.sb3_env import SB3VecEnv
from train.state import capture, read_state, restore, write_state

_DEFAULTS: dict[str, dict[str, Any]] = {
    "PPO": {
        "n_steps": 32, "batch_size": 512, "n_epochs": 10, "gamma": 0.95, "learning_rate": 5e-4,
        "policy_kwargs": {"net_arch": [64, 64], "log_std_init": -1.0},
    },
    "SAC": {
        "gamma": 0.95, "learning_rate": 5e-4, "batch_size": 512, "buffer_size": 200_000, "learning_starts": 2_000,
        "train_freq": 4, "gradient_steps": 8, "policy_kwargs": {"net_arch": [64, 64]},
    },
}  # fmt: skip
_REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_FIRST_TRAINING_SEED, _EVALUATION_SEED = 10_000_000, 50_000
"""Episodes of evaluation begin at the second, those of training above the first: no seed serves both."""


class TrainConfig(Model):
    """What is trained on what."""

    name: str = "train"
    env: str = "walker"
    reference: Motion = None
    """Motion, as in a comparison; None for the environment's default."""
    scenarios: list[str] = Field(default=["nominal"], min_length=1)
    """Scenarios whose worlds are learned from together, in equal shares."""
    env_options: dict[str, Any] = {}
    """Further arguments of the environment, such as the weights of its reward."""
    base: str = "input_output"
    """Policy that is corrected."""
    base_options: dict[str, Any] = {}
    settings: ResidualSettings = ResidualSettings()
    """How the residual acts and what it sees."""
    algorithm: str = "PPO"
    """Class of stable_baselines3, or "module:Class" of one that has the same interface."""
    algorithm_options: dict[str, Any] = {}
    """Its keyword arguments, over the defaults for PPO and SAC."""
    clip: float = quantity("1", 10.0, gt=0, description="bound of normalised features, in standard deviations")
    worlds: int = quantity("1", 64, ge=2, description="worlds, shared out to the scenarios")
    decisions: int = quantity("1", 200_000, ge=1, description="decisions of all worlds together")
    seeds: list[Annotated[int, Field(ge=0)]] = Field(default=[0], min_length=1)
    """Training seeds, each a run of its own."""
    evaluate_every: int = quantity("1", 20_000, ge=1, description="decisions between evaluations")
    evaluation_episodes: int = quantity("1", 4, ge=1, description="episodes per scenario in an evaluation")
    checkpoint_every: int = quantity("1", 10_000, ge=1, description="decisions between checkpoints")

    _checked = field_validator("base")(require_plain_base)

    @property
    def motion(self) -> Any:
        """The reference, or the environment's default."""
        return environment(self.env).default_reference if self.reference is None else self.reference

    def condition(self, scenario: str, policy: str) -> Condition:
        """A cell in which a policy is evaluated on the way."""
        return Condition(
            env=self.env,
            policy=PolicySpec(name=policy, options=self.base_options if policy == self.base else {}),
            scenario=scenario,
            reference=self.motion,
            env_options=self.env_options,
            episodes=1 if scenario == "ideal" else self.evaluation_episodes,
            seed=_EVALUATION_SEED,
        )


class Training:
    """One training seed of a configuration, in a folder of its own.

    Args:
        config: What is trained.
        seed: Training seed.
        folder: Where its files go; one with a checkpoint is gone on with.
        threads: Threads of the physics, 0 for all cores; the weights do not depend on it.

    Raises:
        ConfigurationError: Names or options that do not exist.
    """

    def __init__(self, config: TrainConfig, seed: int, folder: Path, threads: int = 0) -> None:
        torch.set_num_threads(1)  # more would fight the threads of the physics
        torch.use_deterministic_algorithms(True)
        self.config, self.seed, self.folder, self._threads = config, seed, folder, threads
        wrapped = [self._wrapped(scenario, share) for scenario, share in _shares(config)]
        self.settings = wrapped[0].settings
        self._spread = np.random.default_rng(seed)
        self._worlds = SB3VecEnv(MixedVectorEnv(wrapped, threads), self._spread)
        options = _merged(_DEFAULTS.get(config.algorithm, {}), config.algorithm_options)
        gamma = options.get("gamma", 0.99)
        self._normaliser = VecNormalize(self._worlds, clip_obs=config.clip, norm_reward=True, gamma=gamma)
        set_random_seed(seed)
        self._normaliser.seed(_FIRST_TRAINING_SEED + 100_000 * seed)
        self.model: Any = _algorithm(config.algorithm)(
            "MlpPolicy", self._normaliser, device="cpu", seed=None, **_resolved(options)
        )
        self._shrink_last_layer()
        self.model.action_space.seed(seed)
        self.best = np.inf
        self._base_scores: dict[str, tuple[list[float], int]] = {}
        self._provenance = provenance(seed)
        self._folder_ready()
        if (folder / "checkpoint").is_dir():
            self._resume()
        self._forget_later()

    @property
    def done(self) -> int:
        """Decisions so far."""
        return int(self.model.num_timesteps)

    def run(self, progress: Callable[[int], None] | None = None) -> None:
        """Train to the end of the configuration's decisions; `progress` is told the decisions done."""
        config = self.config
        if self.done == 0:
            self._evaluate()
        while self.done < config.decisions:
            before = self.done
            self.model.learn(self._portion(), reset_num_timesteps=before == 0, log_interval=10**9)
            if self._is_due(before, config.evaluate_every):
                self._evaluate()
            if self._is_due(before, config.checkpoint_every):
                self.checkpoint()
            if progress is not None:
                progress(self.done)
        self._export("last")

    def _is_due(self, before: int, every: int) -> bool:
        return self.done // every > before // every or self.done >= self.config.decisions

    def checkpoint(self) -> None:
        """Keep everything that the rest of the training depends on; a kill between its steps loses nothing."""
        fresh, old = self.folder / "checkpoint.new", self.folder / "checkpoint.old"
        shutil.rmtree(fresh, ignore_errors=True)
        fresh.mkdir()
        torch.save(self._parameters(), fresh / "model.pt")
        write_state(fresh, "state", self._state())
        for file in fresh.iterdir():
            _flush(file)
        _flush(fresh)
        shutil.rmtree(old, ignore_errors=True)
        current = self.folder / "checkpoint"
        if current.exists():
            current.rename(old)
        fresh.rename(current)
        _flush(self.folder)
        shutil.rmtree(old, ignore_errors=True)

    def _resume(self) -> None:
        path = self.folder / "checkpoint"
        parameters = torch.load(path / "model.pt", weights_only=True)
        self.model.policy.load_state_dict(parameters["policy"])
        for name, optimiser in self._optimisers().items():
            optimiser.load_state_dict(parameters["optimisers"][name])
        if "log_ent_coef" in parameters:
            self.model.log_ent_coef.data.copy_(parameters["log_ent_coef"])
        torch.set_rng_state(parameters["rng"])
        self._load(read_state(path, "state"))

    def _forget_later(self) -> None:
        """Drop evaluations that were made after the checkpoint, or without one; they will be made again."""
        path, fresh = self.folder / "progress.csv", self.folder / "progress.csv.new"
        lines = path.read_text().splitlines(keepends=True) if path.exists() else []
        kept = [line for line in lines[1:] if line.endswith("\n") and int(line.split(",")[0]) <= self.done]
        if self.done == 0 or not lines:
            path.unlink(missing_ok=True)
            return
        fresh.write_text("".join([lines[0], *kept]))
        fresh.replace(path)

    def _parameters(self) -> dict[str, Any]:
        parameters = {
            "policy": self.model.policy.state_dict(),
            "optimisers": {name: optimiser.state_dict() for name, optimiser in self._optimisers().items()},
            "rng": torch.get_rng_state(),
        }
        if getattr(self.model, "log_ent_coef", None) is not None:
            parameters["log_ent_coef"] = self.model.log_ent_coef.detach()
        return parameters

    def _optimisers(self) -> dict[str, Any]:
        policy = self.model.policy
        found = {
            "policy": getattr(policy, "optimizer", None),
            "actor": getattr(getattr(policy, "actor", None), "optimizer", None),
            "critic": getattr(getattr(policy, "critic", None), "optimizer", None),
            "entropy": getattr(self.model, "ent_coef_optimizer", None),
        }
        return {name: optimiser for name, optimiser in found.items() if optimiser is not None}

    def _state(self) -> dict[str, Any]:
        model, normaliser = self.model, self._normaliser
        statistics: dict[str, Any] = {"observation": normaliser.obs_rms, "return": normaliser.ret_rms}
        numpy_state: Any = np.random.get_state()  # noqa: NPY002  the generator that SB3 shuffles with
        state = {
            "decisions": model.num_timesteps,
            "updates": model._n_updates,
            "episodes": model._episode_num,
            "best": float(self.best) if np.isfinite(self.best) else None,
            "observation": model._last_obs,
            "original": model._last_original_obs,
            "starts": model._last_episode_starts,
            "normaliser": {name: [rms.mean, rms.var, float(rms.count)] for name, rms in statistics.items()},
            "returns": normaliser.returns,
            "old_observation": normaliser.old_obs,
            "old_reward": normaliser.old_reward,
            "numpy": [numpy_state[0], numpy_state[1], *numpy_state[2:]],
            "python": _listed(random.getstate()),
            "actions": capture(model.action_space.np_random),
            "worlds": capture(self._worlds),
        }
        if isinstance(model, OffPolicyAlgorithm):
            buffer = model.replay_buffer
            names = [name for name in _REPLAY if hasattr(buffer, name)]
            size = buffer.buffer_size if buffer.full else buffer.pos  # type: ignore[union-attr]
            state["replay"] = {name: getattr(buffer, name)[:size] for name in names}
            state["replay_at"] = [buffer.pos, bool(buffer.full)]  # type: ignore[union-attr]
        return state

    def _load(self, state: dict[str, Any]) -> None:
        model, normaliser = self.model, self._normaliser
        model.num_timesteps, model._n_updates = state["decisions"], state["updates"]
        model._episode_num = state["episodes"]
        self.best = np.inf if state["best"] is None else state["best"]
        model._last_obs, model._last_original_obs = state["observation"], state["original"]
        model._last_episode_starts = state["starts"]
        rms: Any
        for name, rms in (("observation", normaliser.obs_rms), ("return", normaliser.ret_rms)):
            mean, var, count = state["normaliser"][name]
            rms.mean, rms.var, rms.count = mean, var, count
        normaliser.returns = state["returns"]
        normaliser.old_obs, normaliser.old_reward = state["old_observation"], state["old_reward"]
        np.random.set_state(tuple(state["numpy"]))  # noqa: NPY002
        random.setstate(_tupled(state["python"]))
        restore(model.action_space.np_random, state["actions"])
        restore(self._worlds, state["worlds"])
        if model.ep_info_buffer is None:
            model.ep_info_buffer, model.ep_success_buffer = deque(maxlen=100), deque(maxlen=100)
        if isinstance(model, OffPolicyAlgorithm):
            buffer: Any = model.replay_buffer
            for name, values in state["replay"].items():
                getattr(buffer, name)[: len(values)] = values
            buffer.pos, buffer.full = state["replay_at"]

    def _portion(self) -> int:
        """Decisions of one call of `learn`: an iteration of PPO, a thousand or so of SAC."""
        steps = getattr(self.model, "n_steps", None)
        return self.config.worlds * (steps if steps is not None else max(1024 // self.config.worlds, 1))

    def _wrapped(self, scenario: str, worlds: int) -> ResidualVectorWrapper:
        config = self.config
        condition = config.condition(scenario, config.base)
        threads = 1 if len(config.scenarios) > 1 else self._threads  # scenarios step side by side
        env = make_vector_env(condition, worlds, threads, AutoresetMode.SAME_STEP)
        base = baselines.make(config.base, env, **config.base_options)
        settings = config.settings.model_dump()
        return ResidualVectorWrapper(env, base, **settings)

    def _shrink_last_layer(self) -> None:
        """A residual begins near zero: as the base."""
        policy = self.model.policy
        layer = policy.action_net if hasattr(policy, "action_net") else policy.actor.mu
        with torch.no_grad():
            layer.weight.mul_(0.01)
            layer.bias.zero_()

    def _folder_ready(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        kept, moved = self.folder / "checkpoint", self.folder / "checkpoint.old"
        if not kept.exists() and moved.exists():  # killed between the two moves
            moved.rename(kept)
        self.model.set_logger(configure(str(self.folder / "tensorboard"), ["tensorboard"]))

    def _description(self) -> tuple[dict[str, Any], ResidualDescription]:
        tensors, activation, output = network_of(self.model, self._normaliser)
        config = self.config
        description = ResidualDescription(
            robot=config.env,
            base=config.base,
            base_options=config.base_options,
            settings=self.settings,
            activation=activation,  # type: ignore[arg-type]
            output=output,
            clip=float(self._normaliser.clip_obs),
            training={"config": config.model_dump(mode="json"), "decisions": self.done, **self._provenance},
        )
        return tensors, description

    def _export(self, name: str) -> Path:
        """Write the present policy as a folder, replacing the one of that name."""
        fresh = self.folder / f"{name}.new"
        shutil.rmtree(fresh, ignore_errors=True)
        tensors, description = self._description()
        save_residual(fresh, description, tensors)
        shutil.rmtree(self.folder / name, ignore_errors=True)
        return fresh.rename(self.folder / name)

    def _evaluate(self) -> None:
        """Score the present policy against its base on episodes that training never sees; keep the best."""
        states = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
        current = self._export("current")
        columns = [column.metric for column in environment(self.config.env).judged]
        table, ratios = [], []
        for scenario in self.config.scenarios:
            if scenario not in self._base_scores:
                self._base_scores[scenario] = self._score(scenario, self.config.base, columns)
            mine, falls = self._score(scenario, f"residual:{current}", columns)
            base, base_falls = self._base_scores[scenario]
            table.append([self.done, scenario, *mine, *base, falls, base_falls])
            ratios.append(np.nan_to_num(np.array(mine) / base, nan=10.0).mean() + falls)
        header = ["decisions", "scenario", *columns, *(f"base_{name}" for name in columns), "failed", "base_failed"]
        _append(self.folder / "progress.csv", header, table)
        score = float(np.mean(ratios))
        if score < self.best:
            self.best = score
            self._export("best")
        shutil.rmtree(current)
        torch.set_rng_state(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        random.setstate(states[2])

    def _score(self, scenario: str, policy: str, metrics: list[str]) -> tuple[list[float], int]:
        """Means of metrics over the episodes that did not fail, and how many did."""
        result = evaluate(self.config.condition(scenario, policy), num_threads=self._threads)
        values = [result.values(metric) for metric in metrics]
        return [float(np.mean(some)) if len(some) else np.nan for some in values], result.num_failed


def _shares(config: TrainConfig) -> list[tuple[str, int]]:
    """Worlds of each scenario; the first ones take what does not divide."""
    count = len(config.scenarios)
    if config.worlds < 2 * count:
        raise ConfigurationError(f"worlds must be at least two per scenario, {2 * count}, got {config.worlds}")
    whole, rest = divmod(config.worlds, count)
    return [(scenario, whole + (i < rest)) for i, scenario in enumerate(config.scenarios)]


def _algorithm(name: str) -> Any:
    if ":" in name:
        module, _, attribute = name.partition(":")
        try:
            return getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError, ValueError) as error:
            raise ConfigurationError(f"algorithm {name!r}: {error}") from None
    known = ("A2C", "PPO", "SAC")
    if name not in known:
        raise unknown_name("algorithm", name, [*known, "module:Class"])
    return getattr(stable_baselines3, name)


def _merged(defaults: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    policy = {**defaults.get("policy_kwargs", {}), **given.get("policy_kwargs", {})}
    return {**defaults, **given, **({"policy_kwargs": policy} if policy else {})}


def _resolved(options: dict[str, Any]) -> dict[str, Any]:
    """Options with the activation's class in the place of its name."""
    policy = dict(options.get("policy_kwargs", {}))
    if isinstance(policy.get("activation_fn"), str):
        policy["activation_fn"] = getattr(torch.nn, policy["activation_fn"])
    return {**options, "policy_kwargs": policy}


def _append(path: Path, header: list[str], rows: list[list[Any]]) -> None:
    is_new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.writer(file)
        if is_new:
            writer.writerow(header)
        writer.writerows(rows)


def _flush(path: Path) -> None:
    """Have a file or folder on the disk before anything that comes later."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _listed(value: Any) -> Any:
    return [_listed(part) for part in value] if isinstance(value, tuple) else value


def _tupled(value: Any) -> Any:
    return tuple(_tupled(part) for part in value) if isinstance(value, list) else value
