"""Configuration of a training, and the worlds that it learns from."""

from typing import Annotated, Any, Self

from gymnasium.vector import AutoresetMode
from pydantic import Field, ValidationInfo, field_validator, model_validator

import baselines
from baselines.residual.settings import (
    TRUE_QUANTITIES,
    ResidualDescription,
    ResidualSettings,
    require_plain_base,
)
from baselines.residual_env import ResidualVectorWrapper
from elastic_env.core.config import MOST_ENTRIES, Entries, Locator, Once, Title, quantity
from elastic_env.core.errors import ConfigurationError, require_known
from elastic_env.registration import require_memory
from train.evaluate.conditions import (
    Condition,
    EnvOptions,
    GivenRanges,
    GivenReference,
    NumEpisodes,
    PolicySpec,
    require_drawn,
)
from train.evaluate.environments import environment
from train.learn.algorithm_options import CONSTANTS, validate_options
from train.learn.mixed_env import mixed_env
from train.runs.user_code import CodeNamingModel, kind_check

FIRST_TRAINING_SEED = 10_000_000
EVALUATION_SEED = 50_000
"""Seeds of the first episodes of training and of evaluation, so that they share no seed."""
_TRAINING_SEED_STRIDE = 100_000
"""Difference between the first episodes of two training seeds."""
_MOST_DECISIONS = 10**12
_WORLD_BYTES = 100_000
"""Memory of a world, measured on the walker with its policy and on the testbed with a motion."""


class TrainConfig(CodeNamingModel):
    """A training: worlds, base policy, algorithm, and how long."""

    name: Title = "train"
    """Name of the result folder under runs/."""
    env: str = "walker"
    """Environment, as in a comparison."""
    reference: GivenReference | None = None
    """Motion, as in a comparison; None for the environment's default."""
    scenarios: Entries[Title] = ["nominal"]
    """Scenarios of the training worlds, in equal shares."""
    weights: dict[str, Annotated[float, Field(gt=0, le=1e6)]] = {}
    """Weights of the rewards of single scenarios, at most 10⁶; default 1."""
    ranges: GivenRanges = {}
    """Intervals that replace those of `drawn`."""
    env_options: EnvOptions = {}
    """Further arguments of the environment, such as the weights of its reward."""
    training_options: EnvOptions = {}
    """The same for the training worlds alone, such as a longer physics step."""
    base: Title = "input_output"
    """Policy that is corrected: a baseline by name, since an exported residual plays without
    code of its own.
    """
    base_options: dict[str, Any] = {}
    settings: ResidualSettings = ResidualSettings()
    """Actions and observations of the residual."""
    critic_sees: Annotated[list[Title], Field(max_length=MOST_ENTRIES)] = []
    """True quantities of the robot that the critic sees, for PPO and A2C on a walker
    (`baselines.residual.true_robot`); the residual does not see them."""
    algorithm: Locator = "PPO"
    """Class of stable_baselines3, "module:Class" of one that has the same interface, or "CMA-ES", a
    search over residuals that never change."""
    algorithm_options: dict[str, Any] = {}
    """Its keyword arguments, over the defaults."""
    anneal: bool = False
    """Let the learning rate fall linearly to zero over the decisions."""
    clip: float = quantity("1", 10.0, gt=0, le=1e6)
    """Bound of normalised features, in standard deviations."""
    worlds: int = quantity("1", 64, ge=2, le=10_000_000)
    """Worlds, shared out to the scenarios."""
    decisions: int = quantity("1", 200_000, ge=1, le=_MOST_DECISIONS)
    """Decisions of all worlds together."""
    seeds: Annotated[Entries[Annotated[int, Field(ge=0, lt=2**32)]], Once] = [0]
    """Training seeds, each a run of its own."""
    evaluate_every: int = quantity("1", 20_000, ge=1, le=_MOST_DECISIONS)
    """Decisions between evaluations."""
    evaluation_episodes: NumEpisodes = 4
    """Episodes per scenario in an evaluation."""
    checkpoint_every: int = quantity("1", 50_000, ge=1, le=_MOST_DECISIONS)
    """Decisions between checkpoints.

    A checkpoint ends all episodes: leave several of every world between two.
    """

    _check_kind = model_validator(mode="before")(kind_check("training"))
    _check_base = field_validator("base")(require_plain_base)

    @model_validator(mode="after")
    def _check_scenarios(self) -> Self:
        require_known("scenario with a weight", self.weights, self.scenarios)
        require_drawn(self.scenarios, self.ranges)
        require_known("quantity that a critic sees", self.critic_sees, TRUE_QUANTITIES)
        motion = self.reference if isinstance(self.reference, dict) else {}
        if twice := sorted(motion.keys() & self.training_options.keys()):
            raise ValueError(
                f"training_options must not repeat keys of the reference: {', '.join(twice)}; set"
                " in the reference what trainings and evaluations share"
            )
        return self

    @field_validator("algorithm_options")
    @classmethod
    def _check_options(cls, options: dict[str, Any], others: ValidationInfo) -> dict[str, Any]:
        return validate_options(str(others.data.get("algorithm")), options)

    @model_validator(mode="after")
    def _check_critic(self) -> Self:
        if self.critic_sees and self.algorithm in ("SAC", CONSTANTS):
            raise ValueError(
                "critic_sees is for PPO and A2C, whose critic has inputs of its own,"
                f" got {self.algorithm}; leave it out"
            )
        return self

    def training_condition(self, scenario: str) -> Condition:
        """The cell of the training worlds of a scenario."""
        arguments = environment(self.env).training_arguments
        options = arguments | self.env_options | self.training_options
        return self.condition(scenario, self.base).replace(env_options=options)

    @property
    def names_of_code(self) -> list[str]:
        """Names that may refer to a user's code; that of the base never does."""
        return [self.algorithm, self.env]

    def condition(self, scenario: str, policy: str) -> Condition:
        """The cell of an evaluation of a policy, with one episode if nothing is random."""
        options = self.base_options if policy == self.base else {}
        condition = Condition(
            env=self.env,
            policy=PolicySpec(name=policy, options=options),
            scenario=scenario,
            reference=self.reference,
            ranges=self.ranges,
            env_options=self.env_options,
            episodes=self.evaluation_episodes,
            seed=EVALUATION_SEED,
        )
        is_one = condition.environment.is_deterministic(scenario, condition.reference)
        return condition.replace(episodes=1) if is_one else condition

    def description(self, joints: list[str], **network: Any) -> ResidualDescription:
        """Description of an exported policy; `network` names its activation and output."""
        names = ("base", "base_options", "settings", "clip")
        values = {name: getattr(self, name) for name in names}
        robot = environment(self.env).robot
        return ResidualDescription(robot=robot, joints=joints, **values, **network)

    def is_due(self, every: int, before: int, done: int) -> bool:
        """True if work is due that is done every so many decisions, and at the end.

        Args:
            every: Decisions between two times of the work.
            before: Decisions before the last step of the training.
            done: Decisions after it.
        """
        return done // every > before // every or done >= self.decisions

    @property
    def shares(self) -> list[tuple[str, int]]:
        """Number of worlds of each scenario; the first scenarios get the remainder.

        Raises:
            ConfigurationError: A scenario would have fewer than two.
        """
        count = len(self.scenarios)
        if self.worlds < 2 * count:
            problem = f"worlds must be at least two per scenario, {2 * count}, got {self.worlds}"
            raise ConfigurationError(problem)
        share, remainder = divmod(self.worlds, count)
        sizes = [share + (number < remainder) for number in range(count)]
        return list(zip(self.scenarios, sizes, strict=True))


def first_episode(seed: int) -> int:
    """Seed of the first episode that a training seed learns from."""
    return FIRST_TRAINING_SEED + _TRAINING_SEED_STRIDE * seed


def joints_of(worlds: Any) -> list[str]:
    """Names of the joints of the robot in training worlds."""
    return worlds.unwrapped.assumed_model.joint_names


def training_worlds(
    config: TrainConfig, shares: list[tuple[str, int]], threads: int
) -> ResidualVectorWrapper:
    """Worlds in which actions are residuals of the configuration's base.

    Args:
        config: Configuration of the training.
        shares: Scenarios with their numbers of worlds.
        threads: Threads of the physics, 0 for all cores; the results do not depend on it.

    Raises:
        ConfigurationError: A name or an option does not exist.
    """
    require_memory("worlds", sum(count for _, count in shares), _WORLD_BYTES)
    conditions = [config.training_condition(scenario) for scenario, _ in shares]
    weights = [config.weights.get(scenario, 1.0) for scenario, _ in shares]
    worlds = mixed_env(conditions, [count for _, count in shares], threads, weights)
    base = baselines.make(config.base, worlds, **config.base_options)
    settings = config.settings.model_dump()
    mode = AutoresetMode.SAME_STEP
    return ResidualVectorWrapper(
        worlds, base, autoreset_mode=mode, critic_sees=config.critic_sees, **settings
    )
