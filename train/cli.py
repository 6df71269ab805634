"""The command `elastic`: identify, evaluate, compare, train, export, bench, speed, play, hardware, demo."""

import os
import sys
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.markup import escape

from elastic_env.errors import ElasticError
from train.commands.guarding import Bench, Speed
from train.commands.hardware import Hardware
from train.commands.learning import Export, Train
from train.commands.playing import Compare, Demo, Evaluate, Identify, Play

Command = (
    Annotated[Identify, tyro.conf.subcommand("identify")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Speed, tyro.conf.subcommand("speed")]
    | Annotated[Play, tyro.conf.subcommand("play")]
    | Annotated[Hardware, tyro.conf.subcommand("hardware")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
)


def _with_notes(error: BaseException, said: str | None = None) -> str:
    """What an error says, and what was noted on its way here."""
    return "; ".join([str(error) if said is None else said, *getattr(error, "__notes__", [])])


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the command `elastic`."""
    if "" not in sys.path and str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))  # as with python -m, for --policy module:function
    command: Any = tyro.cli(
        Command, prog="elastic", args=arguments,
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes),
        description="Elastic joints: simulate, identify, compensate, compare. `elastic COMMAND --help` explains each.",
    )  # fmt: skip
    try:
        command.run()
    except ElasticError as error:
        Console(stderr=True).print(f"[bold red]error:[/] {escape(_with_notes(error))}", highlight=False, soft_wrap=True)
        sys.exit(2)
    except KeyboardInterrupt as error:
        Console(stderr=True).print(_with_notes(error, "interrupted"), highlight=False, markup=False, soft_wrap=True)
        os._exit(130)  # worker processes must not keep the terminal waiting
