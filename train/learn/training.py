"""Training of residuals with Stable-Baselines3, and checkpoints of all that it depends on.

A run is a folder per training seed: `checkpoint/` to go on from, `best/` and `last/` as policies
that need no torch, `progress.csv`, and TensorBoard's files. Training is deterministic on one
thread; a run that is interrupted or killed and resumed ends with the same weights, bit for bit, as
one that was not.
"""

import io
import random
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.logger import Logger, make_output_format
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecNormalize

from baselines.residual.settings import ResidualDescription
from train.learn.algorithm_options import complete_options
from train.learn.checkpoint import read_state, write_state
from train.learn.critic import KnowingCritic
from train.learn.export import algorithm_class, name_options, network_of
from train.learn.sb3_env import SB3VecEnv
from train.learn.train_config import (
    FIRST_TRAINING_SEED,
    first_episode,
    joints_of,
    training_worlds,
)
from train.learn.trainer import Trainer, require_finite

_OF_MODEL = ("num_timesteps", "_n_updates", "_episode_num")
"""Attributes of an algorithm of SB3 that a training goes on from."""
_REPLAY = "observations next_observations actions rewards dones timeouts"


class Training(Trainer):
    """One training seed of a configuration, in a folder of its own.

    Args:
        config: What is trained.
        seed: Training seed.
        folder: Where its files go; one with a checkpoint is gone on with.
        threads: Threads of the physics, 0 for all cores; the weights do not depend on it.

    Raises:
        ConfigurationError: Names or options that do not exist.
    """

    _shown: "Curves | None" = None

    def _prepare(self, threads: int) -> None:
        torch.set_num_threads(1)  # more would fight the threads of the physics
        torch.use_deterministic_algorithms(True)
        config = self.config
        seed = self._seed
        worlds = training_worlds(config, config.shares, threads)
        self._joints = joints_of(worlds)
        self._worlds = SB3VecEnv(worlds, np.random.default_rng(seed))
        options = complete_options(config.algorithm, config.algorithm_options)
        gamma = options.get("gamma", 0.99)
        scales = {"clip_obs": config.clip, "gamma": gamma}
        self._normaliser = VecNormalize(self._worlds, norm_reward=True, **scales)
        set_random_seed(seed)
        self._normaliser.seed(first_episode(seed))
        algorithm = algorithm_class(config.algorithm)
        with name_options(config.algorithm, config.algorithm_options):
            options = {**_with_activation(options), "device": "cpu", "seed": None}
            with warnings.catch_warnings():
                # a rollout whose last minibatch is smaller is no mistake
                smaller = "You have specified a mini-batch size"
                warnings.filterwarnings("ignore", smaller, UserWarning)
                policy = "MlpPolicy"
                if config.critic_sees:
                    policy = KnowingCritic
                    options["policy_kwargs"]["actor_features"] = worlds.actor_features
                self.model: Any = algorithm(policy, self._normaliser, **options)
            self._learning_rate = float(self.model.lr_schedule(1.0))
            self._shrink_last_layer()
        self.model.action_space.seed(seed)

    def run(self, progress: Callable[[int], None] | None = None) -> None:
        """Learn to the end, and raise here what TensorBoard's thread could not write.

        That thread ends with the work, whatever ended that.
        """
        with _thread_raises_here():
            curves = Curves(str(self.folder / "tensorboard"), self.model, self._worlds)
            self.model.set_logger(curves)
            self._shown = curves
            try:
                super().run(progress)
            except BaseException:
                with suppress(Exception):  # what ended the work is what is said
                    curves.close()
                raise
            curves.close()

    @property
    def done(self) -> int:
        """Decisions so far."""
        return int(self.model.num_timesteps)

    def _advance(self) -> None:
        before = self.done
        if self.config.anneal:
            rate = self._learning_rate * (1.0 - before / self.config.decisions)
            self.model.lr_schedule = lambda _: rate
        portion = self.config.worlds
        if not isinstance(self.model, OffPolicyAlgorithm):  # whose n_steps are those of returns
            portion *= self.model.n_steps
        try:
            self.model.learn(portion, reset_num_timesteps=before == 0, log_interval=1)
        except ValueError:  # such as of a distribution whose parameters are nan
            self._require_finite_weights()
            raise
        self._require_finite_weights()

    def _require_finite_weights(self) -> None:
        for name, tensor in self.model.policy.state_dict().items():
            require_finite(f"{name} of the network", tensor.numpy())
        observations, returns = self._statistics
        require_finite("the variance of the observations", observations.var)
        require_finite("the variance of the returns", returns.var)

    def _write(self, checkpoint: Path) -> None:
        parameters = {"model": self.model.get_parameters(), "rng": torch.get_rng_state()}
        if (entropy := self._entropy_weight) is not None:
            parameters["log_ent_coef"] = entropy.detach()
        content = io.BytesIO()  # torch itself calls a full disk an internal error
        torch.save(parameters, content)
        (checkpoint / "model.pt").write_bytes(content.getbuffer())
        write_state(checkpoint, "state", self._state())

    def _read(self, checkpoint: Path) -> None:
        parameters = torch.load(checkpoint / "model.pt", weights_only=True)
        self.model.set_parameters(parameters["model"], device="cpu")
        if (entropy := self._entropy_weight) is not None:
            entropy.data.copy_(parameters["log_ent_coef"])
        torch.set_rng_state(parameters["rng"])
        self._load(read_state(checkpoint, "state"))

    @property
    def _entropy_weight(self) -> Any:
        """Logarithm of the weight of the entropy where SAC learns it, else None."""
        return getattr(self.model, "log_ent_coef", None)

    def _state(self) -> dict[str, Any]:
        model = self.model
        state = {
            "model": {name: getattr(model, name) for name in _OF_MODEL},
            "statistics": [[s.mean, s.var, float(s.count)] for s in self._statistics],
            "best": self._best,
            "numpy": _to_lists(np.random.get_state()),  # noqa: NPY002
            "python": _to_lists(random.getstate()),
            "actions": model.action_space.np_random.bit_generator.state,
        }
        if isinstance(model, OffPolicyAlgorithm):
            buffer: Any = model.replay_buffer
            size = buffer.buffer_size if buffer.full else buffer.pos
            kept = [name for name in _REPLAY.split() if hasattr(buffer, name)]
            state["replay"] = {name: getattr(buffer, name)[:size] for name in kept}
            state["replay_at"] = [buffer.pos, bool(buffer.full)]
        return state

    def _load(self, state: dict[str, Any]) -> None:
        model = self.model
        for name, value in state["model"].items():
            setattr(model, name, value)
        for rms, own in zip(self._statistics, state["statistics"], strict=True):
            rms.mean, rms.var, rms.count = own
        self._best = state["best"]
        np.random.set_state(tuple(state["numpy"]))  # noqa: NPY002
        random.setstate(_to_tuples(state["python"]))
        model.action_space.np_random.bit_generator.state = state["actions"]
        if model.ep_info_buffer is None:
            model.ep_info_buffer = deque(maxlen=100)
            model.ep_success_buffer = deque(maxlen=100)
        if isinstance(model, OffPolicyAlgorithm):
            buffer: Any = model.replay_buffer
            for name, values in state["replay"].items():
                getattr(buffer, name)[: len(values)] = values
            buffer.pos, buffer.full = state["replay_at"]
        self._begin_episodes()

    def checkpoint(self) -> None:
        """Keep everything but the state of the worlds: a checkpoint ends their episodes."""
        before = self._kept
        super().checkpoint()
        share = (self.done - (before or 0)) / self.config.checkpoint_every
        if self._shown is not None and (before is None or share > _WHOLE):
            self._shown.end_episodes(self.done)
        self._begin_episodes()

    def _begin_episodes(self) -> None:
        """End all episodes and begin others, seeded by the training seed and the decisions done."""
        model = self.model
        if isinstance(model, OffPolicyAlgorithm):
            # the last transitions are of episodes that are cut
            buffer: Any = model.replay_buffer
            last = buffer.pos - 1
            is_cut = np.logical_not(buffer.dones[last])
            buffer.timeouts[last] = np.logical_or(buffer.timeouts[last], is_cut)
        entropy = np.random.SeedSequence((self._seed, self.done))
        first = FIRST_TRAINING_SEED + int(entropy.generate_state(1)[0])
        self._worlds.begin_with(first, np.random.default_rng(entropy))
        model._last_obs = self._normaliser.reset()
        model._last_original_obs = self._normaliser.get_original_obs()
        model._last_episode_starts = np.ones(self.config.worlds, dtype=np.bool_)

    @property
    def _statistics(self) -> tuple[Any, Any]:
        """Means and variances of the normaliser: of observations and of returns."""
        return self._normaliser.obs_rms, self._normaliser.ret_rms

    def _shrink_last_layer(self) -> None:
        """A residual begins near zero: as the base."""
        policy = self.model.policy
        layer = policy.action_net if hasattr(policy, "action_net") else policy.actor.mu
        with torch.no_grad():
            layer.weight.mul_(0.01)
            layer.bias.zero_()

    def _policy(self) -> tuple[dict[str, Any], ResidualDescription]:
        """The present policy, as it is exported."""
        tensors, network = network_of(self.model, self._normaliser)
        return tensors, self.config.description(self._joints, **network)

    def _show(self, changes: Mapping[str, float]) -> None:
        for name, change in changes.items():
            self.model.logger.record(f"eval/{name}", change)
        self.model.logger.dump(self.done)

    def _evaluate(self) -> None:
        """Score the present policy, without a trace in the random states of the training."""
        states = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
        super()._evaluate()
        torch.set_rng_state(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        random.setstate(states[2])


@contextmanager
def _thread_raises_here() -> Iterator[None]:
    """Keep TensorBoard's thread from printing the error that its next call raises in this one."""
    before = threading.excepthook

    def print_others(error: threading.ExceptHookArgs) -> None:
        if getattr(error.thread, "exception", None) is not error.exc_value:
            before(error)

    threading.excepthook = print_others
    try:
        yield
    finally:
        threading.excepthook = before


def _with_activation(options: dict[str, Any]) -> dict[str, Any]:
    """Options with the activation's class in the place of its name."""
    policy = dict(options.get("policy_kwargs") or {})
    if isinstance(policy.get("activation_fn"), str):
        policy["activation_fn"] = getattr(torch.nn, policy["activation_fn"])
    return {**options, "policy_kwargs": policy}


def _to_lists(value: Any) -> Any:
    return list(map(_to_lists, value)) if isinstance(value, tuple) else value


def _to_tuples(value: Any) -> Any:
    return tuple(map(_to_tuples, value)) if isinstance(value, list) else value


_WHOLE = 0.9
"""Share of the decisions between checkpoints that the last of them must have for its mean reward
to be comparable.
"""
_REWARD = "rollout/reward_per_decision"
_MISLEADING = "rollout/ep_rew_mean"
"""Sum of rewards of an episode: each is a penalty, so that an episode which ends early would
look better.
"""


class Curves(Logger):
    """SB3's logger with the reward per decision in the place of that per episode.

    It is the mean over the last whole episodes. Those that were cut short to spread the worlds over
    the motion do not count, since their decisions are of its beginning alone. Where every
    checkpoint ends the episodes before one is whole, it is the mean between checkpoints, whose
    decisions are of the same parts of the motion.

    Args:
        folder: Of TensorBoard's files.
        model: Whose episodes they are.
        worlds: In which it learns.
    """

    def __init__(self, folder: str, model: Any, worlds: SB3VecEnv) -> None:
        super().__init__(folder, [make_output_format("tensorboard", folder)])
        self._model = model
        self._worlds = worlds

    def dump(self, step: int = 0) -> None:
        """Write what was recorded; see SB3."""
        self.name_to_value.pop(_MISLEADING, None)
        self.name_to_excluded.pop(_MISLEADING, None)
        episodes = self._model.ep_info_buffer
        if episodes:
            decisions = sum(episode["l"] for episode in episodes)
            self.record(_REWARD, sum(episode["r"] for episode in episodes) / decisions)
        super().dump(step)

    def end_episodes(self, step: int) -> None:
        """Write the reward per decision since the episodes began, where no whole one has ended."""
        reward = self._worlds.reward_per_decision
        if not self._model.ep_info_buffer and reward is not None:
            self.record(_REWARD, reward)
            self.dump(step)
