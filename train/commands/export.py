"""`elastic export`: a model of Stable-Baselines3 as a residual folder."""

from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from elastic_env.core.config import Model, load_yaml
from train.learn.train_config import TrainConfig
from train.runs.folders import own_folder
from train.runs.presets import find_configuration


class Export(Model):
    """Turn a model of Stable-Baselines3 into a residual folder, which plays without torch.

    Loading that folder runs no code.

    Example: elastic export model.zip train_walker_3s --normaliser normaliser.pkl
        --trust-pickle
    """

    model: Annotated[Path, tyro.conf.Positional]
    """Zip of model.save()."""
    config: Annotated[Path, tyro.conf.Positional]
    """Configuration of its training, a file or a preset: algorithm, base, settings."""
    normaliser: Path | None = None
    """File of VecNormalize.save(); leave it out where observations were not normalised."""
    trust_pickle: bool = False
    """SB3 keeps models as pickles: loading one runs code from it."""
    output: Path | None = None
    """Folder for the residual, new or empty; default runs/<name of the zip>, numbered if taken."""

    def run(self, console: Console) -> None:
        """Export."""
        from train.learn.export import export_zip  # help comes without torch

        config = load_yaml(find_configuration(self.config, "training"), TrainConfig)
        with own_folder(self.model.stem, self.output) as folder:
            export_zip(self.model, config, folder, self.normaliser, self.trust_pickle)
        console.print(f"play it as residual:{folder}")
