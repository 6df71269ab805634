"""Settings of a residual, and the content of `residual.json`."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field

from baselines.compensation.inputs import DEFLECTION, INPUTS
from elastic_env.core.config import MOST_ENTRIES, Model, Title, quantity
from elastic_env.core.errors import quote, require_known

Bound = float | dict[str, float]
"""Value at a residual of 1: for all columns of an input, or by joint or axis."""

RESIDUAL = "residual:"
"""Prefix of the folder of a trained residual, in names of policies."""

TRUE_QUANTITIES = ("stiffness", "load", "slope", "backlash", "friction", "mounting")
"""Quantities of the true robot that a teacher or a critic can see."""

_Titles = Annotated[tuple[Title, ...], Field(min_length=1, max_length=MOST_ENTRIES)]
_Seed = Annotated[int, Field(ge=0, lt=2**32)]


class ResidualSettings(Model):
    """Settings of a residual: its inputs, decisions and features."""

    acts_on: dict[Title, Bound | None] = Field(
        default={DEFLECTION: None}, min_length=1, max_length=MOST_ENTRIES
    )
    """Inputs of the base that it acts on (`baselines.compensation.inputs`), and the value of each
    at a residual of 1. This is a number for all columns, or a mapping by the end of the joints'
    names or by axis, as in {deflection: {ankle_roll: 0.6}, zmp: {x: 0.02}}: then it does not act on
    other columns. None takes the input's default."""
    decision_period: int = quantity("1", 25, ge=1, le=100_000)
    """Control steps between decisions [1]."""
    cutoff_hz: float = quantity("Hz", 2.0, gt=0, le=1e6)
    """Cut-off of the first-order low-pass of the correction [Hz]."""
    joints: _Titles | None = None
    """Joints in which it acts, where an input has one column per joint, by the end of their names
    (ankle_roll means both); None for all."""
    shared: bool = False
    """True for one residual per pair of left and right joints of the same name: there are half as
    many to explore. A residual that follows the steps can still act on one leg at a time."""
    mirror: bool = False
    """True to show it steps on the right foot in the mirror, as steps on the left, and to turn its
    decision back (`baselines.residual.mirror`). For a walker."""
    observe: _Titles = ("observation",)
    """Features that it sees: groups of the observation such as (clock, load_share), or all of it,
    and the features in `baselines.residual.features`."""
    history: int = quantity("1", 0, ge=0, le=1000)
    """Number of earlier decisions whose measurements it sees as well [1]."""
    privileged: tuple[Title, ...] = Field(default=(), max_length=MOST_ENTRIES)
    """Quantities of the true robot that a teacher sees (`baselines.residual.true_robot`); empty for
    a residual that a robot can play. For a walker in simulation."""

    def _check(self) -> None:
        require_known("input", self.acts_on, INPUTS)
        require_known("quantity that a teacher sees", self.privileged, TRUE_QUANTITIES)
        for name, bound in self.acts_on.items():
            kind = INPUTS[name]
            values = kind.default if bound is None else bound
            values = list(values.values()) if isinstance(values, dict) else [values]
            if not values or not all(0.0 < value < kind.limit for value in values):
                limit = f"{kind.limit:g} {kind.unit}".removesuffix(" 1")
                raise ValueError(
                    f"the bound of {name} must be positive and below {limit}, got {quote(bound)}"
                )

    @property
    def bounds(self) -> dict[str, Bound]:
        """`acts_on` with its defaults."""
        items = self.acts_on.items()
        return {k: INPUTS[k].default if bound is None else bound for k, bound in items}


class TrainedOn(Model):
    """Part of the configuration of a training that comparisons read."""

    model_config = ConfigDict(extra="ignore")

    seeds: Annotated[list[_Seed], Field(max_length=MOST_ENTRIES)] = []
    scenarios: list[Title] | None = Field(default=None, max_length=MOST_ENTRIES)
    reference: str | float | list[float] | dict[str, Any] | None = None


class Origin(Model):
    """Part of the origin of a residual that comparisons read; the rest of it is for people."""

    model_config = ConfigDict(extra="ignore")

    config: TrainedOn = TrainedOn()
    seed: _Seed | None = None
    commit: Title | None = None


def require_plain_base(name: str) -> str:
    """Check the name of a base policy, and return it.

    Raises:
        ValueError: The base is itself a residual, which could name another, or itself; or it is
            code, which a folder from elsewhere must not run.
    """
    if name.startswith(RESIDUAL):
        raise ValueError(f"a base must be no residual itself, got {name!r}; name a baseline")
    if ":" in name:
        raise ValueError(
            f"the base of a residual must be no residual and no code, got {quote(name)}; name a "
            "baseline, as a residual plays without code of its own"
        )
    return name


def _require_origin(training: dict[str, Any]) -> dict[str, Any]:
    """Check that comparisons can read how a residual was trained."""
    Origin(**training)
    return training


class ResidualDescription(Model):
    """Content of `residual.json`, which describes the weights in the same folder."""

    robot: Title
    """Task of the environment, walker or testbed."""
    joints: list[Title] = Field(default=[], max_length=MOST_ENTRIES)
    """Joints of the robot that it was trained on; none in folders of older versions."""
    base: Annotated[Title, AfterValidator(require_plain_base)]
    """Name of the base policy."""
    base_options: dict[str, Any] = {}
    settings: ResidualSettings = ResidualSettings()
    activation: Literal["tanh", "relu"] = "tanh"
    """Function between the layers."""
    output: Literal["clip", "tanh"] = "clip"
    """Function of the last layer to [−1, 1]: clip (PPO), or tanh (SAC)."""
    clip: float = quantity("1", 10.0, gt=0, le=1e6)
    """Bound of normalised features, in standard deviations [1]."""
    weights_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    """Digest of the weights; None in folders of older versions."""
    training: Annotated[dict[str, Any], AfterValidator(_require_origin)] = {}
    """Training: configuration, seed, versions, commit."""

    @property
    def origin(self) -> Origin:
        """Part of `training` that comparisons read."""
        return Origin(**self.training)
