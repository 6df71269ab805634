"""Training of residuals with Stable-Baselines3, and checkpoints of all that it depends on.

A run has a folder per training seed: `checkpoint/` to resume from, `best/` and `last/` as policies
that need no torch, `progress.csv`, and TensorBoard's files. Training is deterministic on one
thread. An interrupted or killed run that is resumed ends with the same weights, bit for bit, as an
uninterrupted one.
"""

import io
import random
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecNormalize

from baselines.residual.settings import ResidualDescription
from train.learn.algorithm_options import complete_options
from train.learn.checkpoint import read_state, write_state
from train.learn.critic import AsymmetricPolicy
from train.learn.export import algorithm_class, explain_option_errors, network_of
from train.learn.sb3_env import SB3VecEnv
from train.learn.tensorboard_curves import RewardLogger, hide_thread_errors
from train.learn.train_config import FIRST_TRAINING_SEED, first_episode, joints_of, training_worlds
from train.learn.trainer import Trainer, require_finite

_MODEL_ATTRIBUTES = ("num_timesteps", "_n_updates", "_episode_num")
"""Attributes of an algorithm of SB3 that belong to a checkpoint."""
_REPLAY_ARRAYS = "observations next_observations actions rewards dones timeouts"
_COMPARABLE_SHARE = 0.9
"""Smallest share of `checkpoint_every` after which a mean reward is comparable to others."""


class Training(Trainer):
    """One training seed of a configuration, in a folder of its own.

    Args:
        config: Configuration of the training.
        seed: Training seed.
        folder: Folder for its files; a training with a checkpoint resumes from it.
        threads: Threads of the physics, 0 for all cores; the weights do not depend on it.

    Raises:
        ConfigurationError: A name or an option does not exist.
    """

    _logger: RewardLogger | None = None

    def _prepare(self, threads: int) -> None:
        torch.set_num_threads(1)  # more threads would slow down those of the physics
        torch.use_deterministic_algorithms(True)
        config = self.config
        seed = self._seed
        worlds = training_worlds(config, config.shares, threads)
        self._joints = joints_of(worlds)
        self._worlds = SB3VecEnv(worlds, np.random.default_rng(seed))
        options = complete_options(config.algorithm, config.algorithm_options)
        self._normaliser = VecNormalize(
            self._worlds, clip_obs=config.clip, gamma=options.get("gamma", 0.99)
        )
        set_random_seed(seed)
        self._normaliser.seed(first_episode(seed))
        algorithm = algorithm_class(config.algorithm)
        with explain_option_errors(config.algorithm, config.algorithm_options):
            options = {**_resolve_activation(options), "device": "cpu", "seed": None}
            with warnings.catch_warnings():
                # the last minibatch of a rollout may be smaller
                warning = "You have specified a mini-batch size"
                warnings.filterwarnings("ignore", warning, UserWarning)
                policy = "MlpPolicy"
                if config.critic_sees:
                    policy = AsymmetricPolicy
                    options["policy_kwargs"]["actor_features"] = worlds.actor_features
                self.model: Any = algorithm(policy, self._normaliser, **options)
            self._learning_rate = float(self.model.lr_schedule(1.0))
            self._shrink_last_layer()
        self.model.action_space.seed(seed)

    def run(self, progress: Callable[[int], None] | None = None) -> None:
        """Learn to the end; errors of TensorBoard's thread are raised in this thread.

        TensorBoard's thread ends with the training, also after an error.
        """
        with hide_thread_errors():
            folder = str(self.folder / "tensorboard")
            logger = RewardLogger(folder, self.model, self._worlds)
            self.model.set_logger(logger)
            self._logger = logger
            try:
                super().run(progress)
            except BaseException:
                with suppress(Exception):  # the first error is the one to report
                    logger.close()
                raise
            logger.close()

    @property
    def done(self) -> int:
        """Decisions so far."""
        return int(self.model.num_timesteps)

    def _advance(self) -> None:
        before = self.done
        if self.config.anneal:
            rate = self._learning_rate * (1.0 - before / self.config.decisions)
            self.model.lr_schedule = lambda _: rate
        decisions = self.config.worlds
        if not isinstance(self.model, OffPolicyAlgorithm):  # its n_steps is that of returns
            decisions *= self.model.n_steps
        try:
            self.model.learn(decisions, reset_num_timesteps=before == 0, log_interval=1)
        except ValueError:  # such as a distribution whose parameters are nan
            self._require_finite_weights()
            raise
        self._require_finite_weights()

    def _require_finite_weights(self) -> None:
        for name, tensor in self.model.policy.state_dict().items():
            require_finite(f"{name} of the network", tensor.numpy())
        observations, returns = self._statistics
        require_finite("the variance of the observations", observations.var)
        require_finite("the variance of the returns", returns.var)

    def _write_state(self, checkpoint: Path) -> None:
        parameters = {"model": self.model.get_parameters(), "rng": torch.get_rng_state()}
        if (entropy := self._entropy_weight) is not None:
            parameters["log_ent_coef"] = entropy.detach()
        content = io.BytesIO()  # torch would report a full disk as an internal error
        torch.save(parameters, content)
        (checkpoint / "model.pt").write_bytes(content.getbuffer())
        write_state(checkpoint, "state", self._state())

    def _read_state(self, checkpoint: Path) -> None:
        parameters = torch.load(checkpoint / "model.pt", weights_only=True)
        self.model.set_parameters(parameters["model"], device="cpu")
        if (entropy := self._entropy_weight) is not None:
            entropy.data.copy_(parameters["log_ent_coef"])
        torch.set_rng_state(parameters["rng"])
        self._load_state(read_state(checkpoint, "state"))

    @property
    def _entropy_weight(self) -> Any:
        """Logarithm of the weight of the entropy if SAC learns it, otherwise None."""
        return getattr(self.model, "log_ent_coef", None)

    def _state(self) -> dict[str, Any]:
        model = self.model
        state = {
            "model": {name: getattr(model, name) for name in _MODEL_ATTRIBUTES},
            "statistics": [[s.mean, s.var, float(s.count)] for s in self._statistics],
            "best": self._best,
            "numpy": np.random.get_state(),  # noqa: NPY002
            "python": random.getstate(),
            "actions": model.action_space.np_random.bit_generator.state,
        }
        if isinstance(model, OffPolicyAlgorithm):
            buffer: Any = model.replay_buffer
            size = buffer.buffer_size if buffer.full else buffer.pos
            arrays = [name for name in _REPLAY_ARRAYS.split() if hasattr(buffer, name)]
            state["replay"] = {name: getattr(buffer, name)[:size] for name in arrays}
            state["replay_at"] = [buffer.pos, bool(buffer.full)]
        return state

    def _load_state(self, state: dict[str, Any]) -> None:
        model = self.model
        for name, value in state["model"].items():
            setattr(model, name, value)
        for rms, values in zip(self._statistics, state["statistics"], strict=True):
            rms.mean, rms.var, rms.count = values
        self._best = state["best"]
        np.random.set_state(tuple(state["numpy"]))  # noqa: NPY002
        version, words, gauss = state["python"]
        random.setstate((version, tuple(words), gauss))
        model.action_space.np_random.bit_generator.state = state["actions"]
        if isinstance(model, OffPolicyAlgorithm):
            buffer: Any = model.replay_buffer
            for name, values in state["replay"].items():
                getattr(buffer, name)[: len(values)] = values
            buffer.pos, buffer.full = state["replay_at"]
        self._begin_episodes()

    def checkpoint(self) -> None:
        """Write everything except the state of the worlds, and end their episodes."""
        before = self._checkpoint_decisions
        super().checkpoint()
        share = (self.done - (before or 0)) / self.config.checkpoint_every
        if self._logger is not None and (before is None or share > _COMPARABLE_SHARE):
            self._logger.end_episodes(self.done)
        self._begin_episodes()

    def _begin_episodes(self) -> None:
        """End all episodes and begin others; training seed and decisions so far seed them."""
        model = self.model
        if isinstance(model, OffPolicyAlgorithm):
            # the last transitions belong to episodes that are cut short
            buffer: Any = model.replay_buffer
            last = buffer.pos - 1
            is_cut = np.logical_not(buffer.dones[last])
            buffer.timeouts[last] = np.logical_or(buffer.timeouts[last], is_cut)
        entropy = np.random.SeedSequence((self._seed, self.done))
        first = FIRST_TRAINING_SEED + int(entropy.generate_state(1)[0])
        self._worlds.seed_next_reset(first, np.random.default_rng(entropy))
        model._last_obs = self._normaliser.reset()
        model._last_original_obs = self._normaliser.get_original_obs()
        model._last_episode_starts = np.ones(self.config.worlds, dtype=np.bool_)

    @property
    def _statistics(self) -> tuple[Any, Any]:
        """Means and variances of the normaliser: of observations and of returns."""
        return self._normaliser.obs_rms, self._normaliser.ret_rms

    def _shrink_last_layer(self) -> None:
        """Shrink the output of the network, so that the policy begins near its base."""
        policy = self.model.policy
        layer = policy.action_net if hasattr(policy, "action_net") else policy.actor.mu
        with torch.no_grad():
            layer.weight.mul_(0.01)
            layer.bias.zero_()

    def _policy(self) -> tuple[dict[str, Any], ResidualDescription]:
        """Tensors and description of the current policy, for its export."""
        tensors, network = network_of(self.model, self._normaliser)
        return tensors, self.config.description(self._joints, **network)

    def _log_scores(self, changes: Mapping[str, float]) -> None:
        for name, change in changes.items():
            self.model.logger.record(f"eval/{name}", change)
        self.model.logger.dump(self.done)

    def _evaluate(self) -> None:
        """Score the current policy without changing the random states of the training."""
        states = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
        super()._evaluate()
        torch.set_rng_state(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        random.setstate(states[2])


def _resolve_activation(options: dict[str, Any]) -> dict[str, Any]:
    """Replace the name of the activation in options by its class."""
    policy = dict(options.get("policy_kwargs") or {})
    if isinstance(policy.get("activation_fn"), str):
        policy["activation_fn"] = getattr(torch.nn, policy["activation_fn"])
    return {**options, "policy_kwargs": policy}
