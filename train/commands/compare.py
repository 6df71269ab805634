"""`elastic compare`: policies × scenarios × references × seeds under one protocol."""

from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from elastic_env.core.config import Locator, Model, load_yaml
from elastic_env.core.errors import ConfigurationError
from train.commands.compare_config import CompareConfig
from train.commands.comparison import compare
from train.commands.options import HardwareOptions, name_options
from train.figures.plots import FigureFormat
from train.report.leaderboard import find_published, read_leaderboard
from train.runs.console import print_files
from train.runs.presets import find_configuration, print_presets
from train.runs.user_code import recorded_config
from train.workers.executors import Executors


class Compare(Model):
    """Compare policies × scenarios × references × seeds of a configuration.

    Writes episodes.csv (one row per episode), statistics.csv (paired changes), report.html (charts
    and tables, works offline), report.md, summary.md and figures, with the resolved configuration,
    seed, versions and commit.

    A policy residual:PATH may have a * in its path, such as residual:runs/NAME/seed_*/last: all
    training seeds of a residual, compared with their base on the same episodes. The base is added
    if it is not among the policies. The package has trained residuals, such as
    residual:walker_3s/seed_*. Intervals are over training seeds, and over the robots of scenarios
    that draw them.

    Example, one joint: elastic compare testbed

    Example, the paper's walks: elastic compare paper

    Example, trained residuals: elastic compare learned_testbed

    Example, all policies in tracks by their needs: elastic compare leaderboard

    Example, your policy next to published rows, which are not played again: elastic compare
        leaderboard --policies mine.py:make --published leaderboard

    Example, heat maps over two axes: elastic compare map_payload_slope
    """

    config: Annotated[Path | None, tyro.conf.Positional] = None
    """YAML file, or name of a preset; with --resume the configuration of the run unless another is
    named.
    """
    list_presets: Annotated[bool, tyro.conf.arg(name="list")] = False
    """List the presets, which are the configurations of the package, and play none."""
    output: Path | None = None
    """Folder for the results, new or empty; default runs/<name>, numbered if taken."""
    episodes: int | None = None
    """Episodes per cell, instead of the configuration's own: 1 for a first look."""
    policies: tuple[Locator, ...] = ()
    """Policies instead of the configuration's own: baselines, or FILE.py:function."""
    published: Path | None = None
    """leaderboard.csv to which your rows are appended, and which is not played again; `leaderboard`
    is the one of the package. Version and protocol must be the same.
    """
    resume: Path | None = None
    """Folder of a run to continue: missing and changed cells are played."""
    figure_format: FigureFormat = "png"
    """Of the figures: pdf and svg have no resolution, and png has 300 dpi."""
    fresh: bool = False
    """With --resume: play all cells again."""
    trust_code: bool = False
    """With --resume and no configuration: run the code that the run's own names."""
    executors: Executors = Executors()
    hardware: HardwareOptions = HardwareOptions()

    def run(self, console: Console) -> None:
        """Run the comparison, or list the presets."""
        if self.list_presets:
            print_presets("comparison", console)
            return
        if self.resume is not None and self.output is not None:
            raise ConfigurationError("a run goes on in its own folder: --resume takes no --output")
        if self.resume is None and self.fresh:
            raise ConfigurationError("--fresh needs --resume; a new run plays all of its cells")
        if self.config is not None:
            config = load_yaml(find_configuration(self.config, "comparison"), CompareConfig)
        elif self.resume is not None:
            config = recorded_config(self.resume, CompareConfig, self.trust_code)
        else:
            raise ConfigurationError(
                "name a configuration or a preset, which --list shows, or, with --resume, the run"
                " to go on with"
            )
        with name_options():
            if self.episodes is not None:
                config = config.replace(episodes=self.episodes, scenario_episodes={})
            if self.policies:
                config = config.replace(policies=list(self.policies), figure_policies=[])
        published = ()
        if self.published is not None:
            published = read_leaderboard(find_published(self.published))
        if self.hardware.arguments:
            real = self.hardware.environment(config.env)
            real["env_options"] = {**config.env_options, **real["env_options"]}
            real |= {"scenarios": ["hardware"], "scenario_episodes": {}, "groups": {}}
            config = config.replace(**real)
        finished = compare(
            config,
            console,
            self.resume or self.output,
            self.executors,
            resumes=self.resume is not None,
            fresh=self.fresh,
            figure_format=self.figure_format,
            published=published,
        )
        print_files(finished.folder, finished.files, console)
