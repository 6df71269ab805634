"""Commands that learn: train, export, iterate."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from elastic_env.core.config import load_yaml
from elastic_env.core.errors import ConfigurationError
from train.commands.options import CONSOLE, DEFAULT_SCENARIO, motion, options_named


@dataclass
class Train:
    """Train a residual on top of a base policy, for every training seed of a configuration.

    Example: elastic train configs/train_walker_3s.yaml, and if it was interrupted: elastic train --resume runs/NAME.
    The seeds of several configurations share the workers: elastic train a.yaml b.yaml --jobs 4.
    Each configuration has a run of its own. It keeps, for every seed, checkpoint/ to go on from, best/ and last/ as
    policies, which elastic evaluate and compare take as residual:PATH, progress.csv, and files for TensorBoard.
    """

    config: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Configurations, one or more; those in configs/train_*.yaml are examples."""
    resume: tuple[Path, ...] = ()
    """Folders of runs to go on with."""
    seeds: list[int] | None = None
    """Training seeds instead of the configurations' own."""
    decisions: int | None = None
    """Decisions of all worlds together instead of the configurations' own."""
    output: Path | None = None
    """Folder for the run, new or empty, or for the folders of several; default runs/<name>, numbered if taken."""
    trust_code: bool = False
    """With --resume: run the code that the run's algorithm names, where it is none of Stable-Baselines3's."""
    jobs: int = 1
    """Seeds at a time, 0 for one per core; several share the cores, and all of them end sooner than one by one."""
    on: str = "local"
    """Where seeds run: local, dask://HOST:PORT of a scheduler, slurm, or slurm:FILE.yaml; see docs/cluster.md."""

    def run(self) -> None:
        """Train, or go on with it."""
        if bool(self.config) == bool(self.resume):
            raise ConfigurationError("name either configurations or, with --resume, the runs to go on with")
        given = {"seeds": self.seeds, "decisions": self.decisions}
        changes = {name: value for name, value in given.items() if value is not None}
        if self.resume and (changes or self.output is not None):
            raise ConfigurationError(
                "a run goes on as it was begun: --resume takes no --seeds, --decisions or --output"
            )
        from train.learn.run_training import resume, start
        from train.learn.train_config import TrainConfig
        from train.workers.places import Place

        place = Place(self.on, self.jobs)
        if self.resume:
            folders = resume(self.resume, CONSOLE, place, self.trust_code)
        else:
            configs = [load_yaml(file, TrainConfig) for file in self.config]
            with options_named():
                configs = [config.replace(**changes) for config in configs]
            folders = start(configs, CONSOLE, self.output, place)
        for folder in folders:
            CONSOLE.print(f"policies in {folder}/seed_*/best and last", soft_wrap=True)


@dataclass
class Export:
    """Turn a model that Stable-Baselines3 saved into a residual folder, which plays without torch and runs no code.

    Example: elastic export model.zip configs/train_walker_3s.yaml --normaliser normaliser.pkl --trust-pickle
    """

    model: Annotated[Path, tyro.conf.Positional]
    """Zip of model.save()."""
    config: Annotated[Path, tyro.conf.Positional]
    """Configuration of its training: algorithm, base, settings."""
    normaliser: Path | None = None
    """File of VecNormalize.save(); leave it out where observations were not normalised."""
    trust_pickle: bool = False
    """SB3 keeps models as pickles: loading one runs code from it."""
    output: Path | None = None
    """Folder for the residual, new or empty; default runs/<name of the zip>, numbered if taken."""

    def run(self) -> None:
        """Export."""
        from train.learn.export import export_zip
        from train.learn.train_config import TrainConfig
        from train.runs.folders import own_folder

        config = load_yaml(self.config, TrainConfig)
        with own_folder(self.model.stem, self.output) as folder:
            export_zip(self.model, config, folder, self.normaliser, self.trust_pickle)
        CONSOLE.print(f"play it as residual:{folder}", soft_wrap=True)


@dataclass
class Iterate:
    """Learn on the robot itself, from walk to walk: iterative learning control, without any training in simulation.

    After each trial the offsets of the next one are corrected by what IMU and foot sensors, or on the testbed the IMU
    of the link, have shown at the same time. Prints a table trial by trial; trial 0 is the base, the last one has all
    that was learned. Writes the learned offsets as a policy iterative:FOLDER, trials.csv and a picture.

    Example: elastic iterate --scenario soft --trials 10

    Example, one joint: elastic iterate --env testbed --reference sine --scenario soft
    """

    env: str = "walker"
    """Environment: walker, testbed, robot, ROBOT.yaml (a file of any robot, see docs/robots.md),
    or "FILE.py:ROBOT", a JointRobot."""
    scenario: str = DEFAULT_SCENARIO
    """Scenario, see elastic evaluate --help."""
    reference: str | None = None
    """Motion, as in elastic evaluate; it must be the same in every trial."""
    trials: int = 10
    """Trials that it learns from."""
    base: str | None = None
    """Policy whose offsets are learned; default adaptive_posture, on the testbed input."""
    seed: int = 0
    """Seed of the robot, where the scenario draws one."""
    robots: int = 1
    """Robots, each of which learns by itself; their seeds follow --seed."""
    output: Path | None = None
    """Folder for the run, new or empty; default runs/iterate, numbered if taken."""

    def run(self) -> None:
        """Learn."""
        from baselines.adaptation.learned_signals import LearningGains
        from train.experiments.iterate import IterateConfig, iterate

        with options_named():
            config = IterateConfig(
                env=self.env, scenario=self.scenario, reference=motion(self.env, self.reference), base=self.base,
                learning=LearningGains(trials=self.trials), seed=self.seed, robots=self.robots,
            )  # fmt: skip
        iterate(config, CONSOLE, self.output)
