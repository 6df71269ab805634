"""The table of all measurements: `python -m tests.hardware_trials`, about half an hour; `--help`
has the options.

Exit code 3 if something is not as it must be.
"""

import json
import sys
from dataclasses import asdict
from pathlib import Path

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from elastic_env.core.errors import ConfigurationError, unknown_name
from elastic_env.hardware.errors import HardwareError
from tests.hardware_trials.trials import TRIALS, Trial
from train.runs.folders import run_folder


def prove(share: float = 1.0, only: tuple[str, ...] = (), output: Path | None = None) -> bool:
    """Measure, print the table, write hardware.json; whether everything is as it must be.

    Args:
        share: Share of repetitions and durations, above 0 and at most 1; 0.02 makes a short one.
        only: Names of the measurements; default all.
        output: Folder for hardware.json; default runs/prove, numbered if taken.

    Raises:
        ConfigurationError: A name does not exist, or the share is none.
    """
    if not 0.0 < share <= 1.0:
        raise ConfigurationError(f"share must be above 0 and at most 1, got {share}")
    for name in only:
        if name not in TRIALS:
            raise unknown_name("measurement", name, TRIALS)
    trials = list[Trial]()
    console = Console()
    with run_folder("prove", {"share": share, "only": only}, None, output) as folder:
        for name in only or TRIALS:
            trials.append(_measured(name, share))
            console.print(f"{trials[-1].name}: {escape(trials[-1].measured)}", soft_wrap=True)
            (folder / "hardware.json").write_text(
                json.dumps([asdict(trial) for trial in trials], indent=2) + "\n"
            )
    table = Table("required", "measured", "", title="hardware against an emulated bus")
    for trial in trials:
        table.add_row(
            escape(trial.required),
            escape(trial.measured),
            "met" if trial.is_met else "[bold red]NOT MET[/]",
        )
    console.print(table)
    console.print(f"wrote {folder / 'hardware.json'}", soft_wrap=True)
    return all(trial.is_met for trial in trials)


def _measured(name: str, share: float) -> Trial:
    """A measurement; one that a fault ends is not met, and the others go on."""
    try:
        return TRIALS[name](share)
    except HardwareError as error:
        return Trial(name, name, f"ended by a fault: {error}", False, {})


if __name__ == "__main__":
    sys.exit(0 if tyro.cli(prove) else 3)
