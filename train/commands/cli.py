"""The command `elastic`, and what it does when something fails."""

import contextlib
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.text import Text

import elastic_env
from elastic_env.core.errors import shortened
from train.commands.guarding import Bench, Speed
from train.commands.hardware import Hardware
from train.commands.learning import Export, Iterate, Train
from train.commands.options import CONSOLE
from train.commands.playing import Compare, Demo, Evaluate, Identify, Play, Robot, View
from train.runs.console import PlainConsole, traceback_of, visible_warnings
from train.runs.failures import DEFECT, EndedError, explained
from train.runs.import_path import look_last_in
from train.runs.progress import say_what_is_compiled

Command = (
    Annotated[Identify, tyro.conf.subcommand("identify")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Iterate, tyro.conf.subcommand("iterate")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Speed, tyro.conf.subcommand("speed")]
    | Annotated[Play, tyro.conf.subcommand("play")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Robot, tyro.conf.subcommand("robot")]
    | Annotated[Hardware, tyro.conf.subcommand("hardware")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
)


def _with_notes(error: BaseException, said: str | None = None) -> str:
    """What an error says, and what was noted on its way here."""
    return "; ".join([str(error) if said is None else said, *getattr(error, "__notes__", [])])


def _told(error: Exception) -> int:
    """Say what failed; the exit code."""
    found = explained(error)
    if found is None:
        sys.stderr.write(traceback_of(error))
    said, code = found or (f"this is a defect of elastic-env, please report it: {type(error).__name__}", DEFECT)
    line = Text.assemble(("error:", "bold red"), f" {_with_notes(error, said)}")
    PlainConsole(stderr=True).print(line, highlight=False, soft_wrap=True)
    return code


_SAME_WISH_S = 2.0
"""How long a further signal does not interrupt what the first one asked for."""


@contextlib.contextmanager
def _ended_by(*numbers: int) -> Iterator[None]:
    """Signals that would end this program end what is within by an exception; ignored ones do not."""
    asked_s = -math.inf

    def end(number: int, _: Any) -> None:
        nonlocal asked_s
        now = time.monotonic()
        if now - asked_s > _SAME_WISH_S:
            asked_s = now
            raise EndedError(number)

    is_main = threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in numbers if is_main}
    taken = {n: handler for n, handler in before.items() if handler in (signal.SIG_DFL, signal.default_int_handler)}
    for number in taken:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in taken.items():
            signal.signal(number, handler)


def _command(arguments: list[str] | None) -> Any:
    given = sys.argv[1:] if arguments is None else arguments
    if given == ["--version"]:
        print(f"elastic-env {elastic_env.__version__}")
        sys.exit()
    short = [shortened(argument).replace("\n", " ") for argument in given]
    if short != given:
        _parsed(short)  # what is wrong with them is said without a flood
    return _parsed(given)


def _parsed(arguments: list[str]) -> Any:
    return tyro.cli(
        Command, prog="elastic", args=arguments,
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes),
        description="Elastic joints: simulate, identify, compensate, compare. `elastic COMMAND --help` explains each, "
        "`elastic --version` says which version this is.",
    )  # fmt: skip


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the command `elastic`."""
    with _ended_by(signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        try:
            look_last_in(Path.cwd())  # for --policy module:function
            command = _command(arguments)
            with say_what_is_compiled(CONSOLE), visible_warnings():
                command.run()
        except BrokenPipeError:
            raise  # nobody reads any more: not worth a word
        except Exception as error:
            sys.exit(_told(error))
        except KeyboardInterrupt as error:
            number = error.args[0] if isinstance(error, EndedError) else signal.SIGINT
            said = "interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"
            PlainConsole(stderr=True).print(_with_notes(error, said), highlight=False, soft_wrap=True)
            os._exit(128 + number)  # worker processes must not keep the terminal waiting
