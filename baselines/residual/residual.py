"""Trained residuals as policies: a NumPy forward pass of weights from a folder, on top of the base
they belong to.

A folder holds `residual.json` (base, settings, network, how it was trained) and
`weights.safetensors`. Loading it runs no code from it and needs no torch. The observation is
normalised in here; the base policy sees it as it is.
"""

from hashlib import sha256
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import ConfigDict, Field, field_validator
from safetensors.numpy import save
from typing_extensions import override

from baselines.compensation.policy import BatchPolicy, Policy, PolicyInputs, put_rows, select_rows
from baselines.residual.correction import Corrected, CorrectedMemory
from baselines.residual.evidence import caution
from baselines.residual.features import Features, FeaturesMemory
from baselines.residual.network import Network, Tensors
from baselines.residual.settings import ResidualSettings
from elastic_env.core.config import MOST_ENTRIES, Model, Title, load_json, quantity
from elastic_env.core.errors import ConfigurationError, quote, shorten
from elastic_env.core.files import write_whole
from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.core.tensors import read_tensors

RESIDUAL = "residual:"
"""Before the folder of a trained residual, where policies are named."""
DESCRIPTION = "residual.json"
WEIGHTS = "weights.safetensors"
_SHIPPED = Path(__file__).parents[1] / "trained"


class TrainedOn(Model):
    """Part of the configuration of a training that comparisons read."""

    model_config = ConfigDict(extra="ignore")

    seeds: list[Annotated[int, Field(ge=0, lt=2**32)]] = Field(default=[], max_length=MOST_ENTRIES)
    scenarios: list[Title] | None = Field(default=None, max_length=MOST_ENTRIES)
    reference: str | float | list[float] | dict[str, Any] | None = None


class Origin(Model):
    """Part of the origin of a residual that comparisons read; the rest of it is for people."""

    model_config = ConfigDict(extra="ignore")

    config: TrainedOn = TrainedOn()
    seed: Annotated[int, Field(ge=0, lt=2**32)] | None = None
    commit: Title | None = None


class ResidualDescription(Model):
    """Content of `residual.json`, about the weights beside it."""

    robot: Title
    """Task of the environment, walker or testbed."""
    joints: list[Title] = Field(default=[], max_length=MOST_ENTRIES)
    """Joints of the robot that it was trained on; none in folders from before they were written."""
    base: Title
    """Name of the base policy."""
    base_options: dict[str, Any] = {}
    settings: ResidualSettings = ResidualSettings()
    activation: Literal["tanh", "relu"] = "tanh"
    """Between the layers."""
    output: Literal["clip", "tanh"] = "clip"
    """How the last layer comes to [−1, 1]: clipped (PPO), or by tanh (SAC)."""
    clip: float = quantity("1", 10.0, gt=0, le=1e6)
    """Bound of normalised features, in standard deviations [1]."""
    weights_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    """Digest of the weights; None for those of folders from before it was written."""
    training: dict[str, Any] = {}
    """How it was trained: configuration, seed, versions, commit."""

    @field_validator("base")
    @classmethod
    def _base_is_no_residual(cls, value: str) -> str:
        return require_plain_base(value)

    @field_validator("training")
    @classmethod
    def _origin_is_readable(cls, value: dict[str, Any]) -> dict[str, Any]:
        Origin(**value)
        return value

    @property
    def origin(self) -> Origin:
        """How it was trained, as far as comparisons read it."""
        return Origin(**self.training)


def require_plain_base(name: str) -> str:
    """The name of a base policy.

    Raises:
        ValueError: It is itself a residual, which could name another, or itself; or it is code,
            which a folder from elsewhere must not run.
    """
    if name.startswith(RESIDUAL):
        raise ValueError(
            f"the base of a residual must be no residual itself, got {name!r}; name a baseline"
        )
    if ":" in name:
        raise ValueError(
            f"the base of a residual must be no residual and no code, got {quote(name)}; name a "
            "baseline, as a residual plays without code of its own"
        )
    return name


class ResidualMemory(NamedTuple):
    """Memory of a residual policy.

    Attributes:
        wait: Control steps until the next decision, (num_worlds,); -1 before the first.
        residual: What was decided, (num_worlds, k).
        features: Memory of the features.
        caution: Memory of the evidence, None without caution.
        inner: Memory of the corrected base.
    """

    wait: IntArray
    residual: Array
    features: FeaturesMemory
    caution: Any
    inner: CorrectedMemory


class ResidualPolicy(BatchPolicy):
    """A base policy with a network that corrects it.

    Args:
        corrected: The base and its correction.
        network: What decides.

    Raises:
        ConfigurationError: The network does not fit the settings, or they do not fit the robot.
    """

    def __init__(self, corrected: Corrected, network: Network) -> None:
        model = corrected.model
        super().__init__(model.observation_table, model.control_period_s)
        self.corrected = corrected
        self._network = network
        self._features = Features(corrected)
        self._period = corrected.settings.decision_period
        expected = (self._features.width, corrected.num_residuals)
        if (network.num_features, network.num_outputs) != expected:
            raise ConfigurationError(
                f"the network must take {expected[0]} features and give {expected[1]} residuals for"
                f" these settings, it has {network.num_features} and {network.num_outputs}"
            )
        self._caution = caution(corrected)

    @override
    def begin(self, rows: Array) -> ResidualMemory:
        return ResidualMemory(
            wait=np.full(len(rows), _UNDECIDED),
            residual=np.zeros((len(rows), self.corrected.num_residuals)),
            features=self._features.begin(len(rows)),
            caution=self._caution.begin(len(rows)) if self._caution is not None else None,
            inner=self.corrected.begin(rows),
        )

    @override
    def act(
        self, rows: Array, memory: ResidualMemory, inputs: PolicyInputs
    ) -> tuple[Array, ResidualMemory]:
        due = memory.wait <= 0
        if np.count_nonzero(due) > 0:
            memory = put_rows(memory, due, select_rows(self._decide(rows, memory, due), due))
        action, inner = self.corrected.correct(rows, memory.residual, memory.inner, inputs)
        return action, memory._replace(wait=memory.wait - 1, inner=inner)

    @override
    def link_angles(self, rows: Array, memory: ResidualMemory) -> Array:
        return self.corrected.base.link_angles(rows, memory.inner.inner)

    def _decide(self, rows: Array, memory: ResidualMemory, due: BoolArray) -> ResidualMemory:
        """Memory after a decision, of the worlds that are due."""
        seen, features = self._features.at(
            rows, memory.features, memory.wait == _UNDECIDED, memory.inner, None
        )
        known = None
        residual = memory.residual.copy()
        residual[due] = self._features.turn_back(rows[due], self._network(seen[due]))
        if self._caution is not None and memory.caution is not None:
            trust, known = self._caution.observe(rows, memory.caution)
            residual[due] *= trust[due]
        wait = np.full_like(memory.wait, self._period)
        return ResidualMemory(wait, residual, features, known, memory.inner)


_UNDECIDED = -1


def save_residual(folder: Path, description: ResidualDescription, tensors: Tensors) -> None:
    """Write a residual that `load_residual` reads; the network must be valid.

    Raises:
        ConfigurationError: Tensors that do not fit.
    """
    Network(description, tensors)
    folder.mkdir(parents=True, exist_ok=True)
    weights = save({name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()})
    write_whole(folder / WEIGHTS, weights)
    description = description.replace(weights_sha256=sha256(weights).hexdigest())
    write_whole(folder / DESCRIPTION, description.model_dump_json(indent=2) + "\n")


def shipped() -> list[str]:
    """Names of the residuals that come with the package, such as testbed/seed_0."""
    return sorted(
        path.parent.relative_to(_SHIPPED).as_posix() for path in _SHIPPED.glob(f"*/*/{DESCRIPTION}")
    )


def located(folder: Path) -> Path:
    """A residual's folder: the path itself, or where nothing lies there, the one of that name in
    the package.
    """
    own = _SHIPPED / folder
    try:
        return own if not folder.exists() and own.exists() else folder
    except OSError:  # too long for a path, or within a folder that cannot be read
        return folder


def read_description(folder: Path) -> ResidualDescription:
    """Description of a residual; `folder` is a path or the name of a shipped one.

    Raises:
        ConfigurationError: There is none, or it is not valid.
    """
    folder = located(folder)
    return load_json(
        folder / DESCRIPTION,
        ResidualDescription,
        what="residual",
        missing=lambda why: _none_at(folder, why),
        within=folder,
    )


def _none_at(folder: Path, why: str) -> str:
    """Sentence that says what to do where no residual is."""
    try:
        inside = [
            path.parent for depth in ("*", "*/*") for path in folder.glob(f"{depth}/{DESCRIPTION}")
        ]
    except OSError:  # a name that is too long, or a folder that cannot be read
        inside = []
    if inside:
        inside.sort(
            key=lambda path: (path.name != "last", path)
        )  # the last policy, for the best one flatters itself
        return (
            f"{folder} is no residual but has some inside; give one of them:"
            f" {', '.join(map(str, inside))}"
        )
    families = {
        name: [at.partition("/")[2] for at in own] for name, own in groupby(shipped(), _family)
    }
    names = ", ".join(f"{name}/{own[0]} to {own[-1]}" for name, own in families.items())
    return (
        f"no residual at {quote(str(folder))[1:-1]}: a folder with {DESCRIPTION} and {WEIGHTS} is"
        f" needed ({why}), or the name of one that comes with the package: {names}"
    )


def _family(name: str) -> str:
    return name.partition("/")[0]


def load_residual(folder: Path) -> tuple[ResidualDescription, Network]:
    """A residual from its folder.

    Raises:
        ConfigurationError: There is none, or it is damaged.
    """
    folder = located(folder)
    description = read_description(folder)
    tensors, content = read_tensors(folder / WEIGHTS)
    try:
        network = Network(description, tensors)
    except ConfigurationError as error:
        raise ConfigurationError(f"{shorten(folder / WEIGHTS)} holds no network: {error}") from None
    found = sha256(content).hexdigest()
    if description.weights_sha256 not in (None, found):
        raise ConfigurationError(
            f"{folder / WEIGHTS} was changed: {DESCRIPTION} names the SHA-256 digest"
            f" {description.weights_sha256}, it has {found}; copy it anew, or leave weights_sha256"
            " out if you mean these weights"
        )
    return description, network


def residual_policy(folder: Path, base: Policy, model: Any) -> ResidualPolicy:
    """The policy of a residual's folder around its base."""
    description, network = load_residual(folder)
    return ResidualPolicy(Corrected(base, model, description.settings), network)
