"""Every residual of the package trained anew from its configuration, and compared with the one of
the package.

    make residuals                                       # or, for some of them:
    python -m tests.residuals_anew testbed walker_3s --seeds 0 1 --jobs 2

Training and comparison of each are runs in runs/residuals. A call goes on where the last one was
interrupted.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from elastic_env.core.config import load_yaml
from elastic_env.core.errors import ConfigurationError, require_known
from train.commands.cli import CONSOLE, run_program
from train.commands.compare_config import CompareConfig
from train.commands.comparison import Comparison, compare
from train.commands.entry import start as start_program
from train.evaluate.conditions import PolicySpec
from train.learn.run_training import resume, start
from train.learn.train_config import TrainConfig
from train.runs.folders import CONFIG, RUNS
from train.workers.executors import Executors

RESIDUALS = {
    "testbed": "learned_testbed",
    "testbed_friction": "learned_testbed_friction",
    "robot": "learned_robot",
    "walker_3s": "learned_walker",
    "walker_1600ms": "learned_walker_1600ms",
    "walker_1100ms": "learned_walker_1100ms",
}
"""Residuals of the package: configs/train_NAME.yaml trains them, and this configuration compares
them.
"""

CONFIGS = Path("configs")
_SHIPPED = Path("baselines/trained")


def shipped_seeds(name: str) -> list[int]:
    """Training seeds of a residual that the package has."""
    folders = (_SHIPPED / name).glob("seed_*")
    return sorted(int(folder.name.removeprefix("seed_")) for folder in folders)


def beside_the_shipped(config: CompareConfig, name: str, trained: Path) -> CompareConfig:
    """A comparison in which the residual of the package stands beside the one that was trained
    anew.

    Args:
        config: Comparison with `residual:NAME/seed_*` among its policies.
        name: Residual of the package.
        trained: Run of its training.

    Raises:
        ConfigurationError: The residual is not among the policies.
    """
    others = [one for one in config.policies if not one.name.startswith(f"residual:{name}/")]
    shipped = [one for one in config.policies if one not in others]
    if not shipped:
        raise ConfigurationError(
            f"{config.name} does not compare residual:{name}/seed_*; add it to its policies"
        )
    own = shipped[0].replace(label="of the package")
    anew = PolicySpec(name=f"residual:{trained}/seed_*/last", label="trained anew")
    return config.replace(
        name=f"residuals_{name}", policies=[*others, own, anew], figure_policies=[]
    )


def reproduce(
    name: str,
    folder: Path,
    console: Console,
    seeds: Sequence[int],
    executors: Executors,
    configs: Path = CONFIGS,
) -> Comparison:
    """Train a residual of the package anew, and compare it with that of the package.

    Args:
        name: Of the residual.
        folder: For both runs.
        console: Where progress and tables go.
        seeds: Training seeds.
        executors: Where training seeds and cells run, and how many at a time.
        configs: Folder of both configurations.
    """
    training = folder / name / "training"
    comparison = folder / name / "comparison"
    config = load_yaml(configs / f"train_{name}.yaml", TrainConfig).replace(seeds=list(seeds))
    if (training / CONFIG).is_file():
        resume([training], console, executors)
    else:
        start([config], console, training, executors)
    compared = load_yaml(configs / f"{RESIDUALS[name]}.yaml", CompareConfig)
    both = beside_the_shipped(compared, name, training)
    is_begun = (comparison / CONFIG).is_file()
    return compare(both, console, comparison, executors, resumes=is_begun)


def main(
    names: Annotated[tuple[str, ...], tyro.conf.Positional] = (),
    seeds: tuple[int, ...] = (),
    output: Path = RUNS / "residuals",
    jobs: int = 0,
) -> None:
    """Train residuals of the package anew and compare them with those of the package; all takes
    hours.

    Args:
        names: Residuals of the package; all if none is named.
        seeds: Training seeds; by default those that the package has.
        output: Folder for the runs; runs that are there are gone on with.
        jobs: Training seeds and cells at the same time, 0 for one per core.
    """
    require_known("residual of the package", names, RESIDUALS)
    for name in names or RESIDUALS:
        reproduce(name, output, CONSOLE, seeds or shipped_seeds(name), Executors(jobs=jobs))


if __name__ == "__main__":
    start_program(lambda: run_program(lambda: tyro.cli(main)))
