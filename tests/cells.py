"""Cells of comparisons without physics: episodes with given figures, and training seeds of
residuals as folders."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from baselines.residual.settings import ResidualDescription
from train.evaluate.conditions import Condition, Member, PolicySpec
from train.evaluate.episodes import Evaluation
from train.evaluate.statistics import Estimate, estimate

METRIC = "pelvis_error_rms_rad"


def records(values: Sequence[float | None], first: int = 0) -> list[dict[str, Any]]:
    """Episodes with one metric; None is a fall, with a figure that must not count."""
    return [
        {
            "seed": first + i,
            "termination": "" if value is not None else "fell",
            METRIC: 9.0 if value is None else value,
        }
        for i, value in enumerate(values)
    ]


def over_seeds(values: Any) -> Estimate:
    """Interquartile mean over training seeds, with its interval."""
    return estimate(lambda _: np.asarray(values, dtype=np.float64)[None], ())


def episode_rows(episodes: Sequence[dict[str, Any]]) -> pd.DataFrame:
    """Episodes of one cell as rows of the table of episodes."""
    frame = pd.DataFrame(episodes)
    failed = frame["termination"] != ""
    return frame.assign(
        member="",
        cell=0,
        robot=frame["seed"],
        failed=failed,
        **{METRIC: frame[METRIC].where(~failed)},
    )


def describe(folder: Path, seed: int | None = None, **values: Any) -> Path:
    """A folder that says of itself what a residual does, without weights."""
    config = {
        "scenarios": ["ideal", "soft", "ideal+soft", "ideal+spread"],
        "reference": 3,
        "seeds": [1, 2, 10],
        **values.pop("config", {}),
    }
    training = {"config": config} if seed is None else {"config": config, "seed": seed}
    description = ResidualDescription(
        **{"robot": "walker", "base": "input_output", "training": training, **values}
    )
    folder.mkdir(parents=True)
    (folder / "residual.json").write_text(description.model_dump_json())
    return folder


def cell(
    title: str,
    values: dict[str, Sequence[float | None]],
    scenario: str,
    member: Member | None = None,
    reference: Any = 3,
    time: int = 400,
) -> Evaluation:
    """A cell of the walker without physics: metrics, and a trace that any signal may be drawn
    from."""
    spec = PolicySpec(name="zero" if member is None else f"residual:{member.folder}", label=title)
    condition = Condition(
        env="walker", policy=spec, member=member, scenario=scenario, reference=reference
    )
    episodes = [
        {**record, "pelvis_error_rms_rad": value, "zmp_deviation_rms_m": value, "policy": title}
        for key in values
        for record, value in zip(records(values[key]), values[key], strict=True)
    ]
    t = 0.004 * np.arange(time)
    trace = {name: np.sin(t) for name in condition.environment.traced} | {
        "time_s": t,
        "single_support": (t > 0.5).astype(float),
    }
    trace["zmp_y"] = np.where(t < 0.1, np.nan, trace["zmp_y"])
    return Evaluation(condition, episodes, trace)


def family(
    values: Sequence[Sequence[float | None]], scenario: str = "soft", **more: Any
) -> list[Evaluation]:
    """Cells of the training seeds of a residual, whose folders are made if they are not there."""
    cells = []
    for seed, own in enumerate(values):
        folder = Path(f"seed_{seed}")
        if not folder.exists():
            describe(folder, seed)
        member = Member(folder=str(folder), training_seed=seed, base="base")
        cells.append(cell("learned", {"all": own}, scenario, member, **more))
    return cells
