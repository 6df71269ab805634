"""`elastic train`: residuals on base policies, for every training seed of configurations."""

from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from elastic_env.core.config import Model, load_yaml
from elastic_env.core.errors import ConfigurationError
from train.commands.options import name_options
from train.learn.run_training import ONE_BY_ONE, resume, start
from train.learn.train_config import TrainConfig
from train.runs.presets import find_configuration, print_presets
from train.workers.executors import Executors


class Train(Model):
    """Train a residual on top of a base policy, for every training seed of a configuration.

    Each configuration has its own run. For every seed the run has checkpoint/ to continue from,
    best/ and last/ as policies for elastic evaluate and compare (residual:PATH), progress.csv, and
    files for TensorBoard. The seeds of several configurations share the workers.

    Example: elastic train train_walker_3s

    To continue it: elastic train --resume runs/NAME

    Several configurations: elastic train a.yaml b.yaml --jobs 4
    """

    config: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """YAML files or names of presets, one or more."""
    list_presets: Annotated[bool, tyro.conf.arg(name="list")] = False
    """List the presets, which are the configurations of the package, and train none."""
    resume: tuple[Path, ...] = ()
    """Folders of runs to continue."""
    seeds: list[int] | None = None
    """Training seeds instead of the configurations' own."""
    decisions: int | None = None
    """Decisions of all worlds together instead of the configurations' own."""
    output: Path | None = None
    """Folder for the run, new or empty, or for the folders of several; default runs/<name>,
    numbered if taken.
    """
    trust_code: bool = False
    """With --resume: run the code that the run's algorithm names, if it is not from
    Stable-Baselines3.
    """
    executors: Executors = ONE_BY_ONE

    def run(self, console: Console) -> None:
        """Train, continue runs, or list the presets."""
        if self.list_presets:
            print_presets("training", console)
            return
        if bool(self.config) == bool(self.resume):
            raise ConfigurationError(
                "name either configurations or presets, which --list shows, or, with --resume, the"
                " runs to go on with"
            )
        given = {"seeds": self.seeds, "decisions": self.decisions}
        changes = {name: value for name, value in given.items() if value is not None}
        if self.resume and (changes or self.output is not None):
            raise ConfigurationError(
                "a run goes on as it was begun: --resume takes no --seeds, --decisions or --output"
            )
        if self.resume:
            folders = resume(self.resume, console, self.executors, self.trust_code)
        else:
            files = [find_configuration(file, "training") for file in self.config]
            configs = [load_yaml(file, TrainConfig) for file in files]
            with name_options():
                configs = [config.replace(**changes) for config in configs]
            folders = start(configs, console, self.output, self.executors)
        for folder in folders:
            console.print(f"policies in {folder}/seed_*/best and last")
