"""The command `elastic`, and what it does when something fails."""

import ast
import contextlib
import dataclasses
import functools
import importlib
import io
import math
import operator
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.text import Text

import elastic_env
from elastic_env.core.config_problems import ModelError
from elastic_env.core.errors import shorten
from train.runs.annotations import annotation, runs_in_workflow
from train.runs.console import PlainConsole, traceback_text, visible_warnings
from train.runs.failures import DEFECT, SignalError, explain
from train.runs.import_path import remove_from_path
from train.runs.progress import announce_compilation

COMMANDS = (
    "identify evaluate compare train iterate export bench speed margins play view robot hardware"
    " lerobot hub demo"
)
"""Modules of this folder, each with a class of its name: options, and `run` with a console."""

CONSOLE = PlainConsole()
"""The console on which the commands say what they do."""


def _print_last(said: str, error: BaseException, before: str = "") -> None:
    """Say how the program ends, with the notes that its error got on the way."""
    notes = getattr(error, "__notes__", [])
    text = "; ".join([said.removesuffix(".") if notes else said, *notes])
    PlainConsole(stderr=True).print(Text.assemble((before, "bold red"), text))


def _print_failure(error: Exception) -> int:
    """Say what failed; the exit code."""
    found = explain(error)
    if found is None:
        sys.stderr.write(traceback_text(error))
        kind = type(error).__name__
        found = f"this is a defect of elastic-env, please report it: {kind}", DEFECT
    said, code = found
    _print_last(said, error, "error: ")
    if runs_in_workflow():
        CONSOLE.print(annotation(said))
    return code


_SAME_WISH_S = 2.0
"""How long a further signal does not interrupt what the first one asked for."""


@contextlib.contextmanager
def _ended_by(*numbers: int) -> Iterator[None]:
    """Turn signals that would end this program into an exception within; ignored ones stay so."""
    asked_s = -math.inf

    def end(number: int, _: Any) -> None:
        nonlocal asked_s
        now = time.monotonic()
        if now - asked_s > _SAME_WISH_S:
            asked_s = now
            raise SignalError(number)

    handled = {}
    is_main = threading.current_thread() is threading.main_thread()
    try:
        for number in numbers if is_main else ():
            before = signal.getsignal(number)
            if before in (signal.SIG_DFL, signal.default_int_handler):
                handled[number] = before
                signal.signal(number, end)
        yield
    finally:
        for number, before in handled.items():
            signal.signal(number, before)


def parse(arguments: list[str]) -> Any:
    """The command that arguments name, with its options.

    Raises:
        ConfigurationError: An option is not what it has to be.
        SystemExit: Help was asked for, or an option does not exist.
    """
    if arguments == ["--version"]:
        print(f"elastic-env {elastic_env.__version__}")
        sys.exit()
    short = [shorten(argument).replace("\n", " ") for argument in arguments]
    if short != arguments:
        _parse(short)  # what is wrong with them is said without a flood
    return _parse(arguments)


def _parse(arguments: list[str]) -> Any:
    if not arguments or arguments[0] not in COMMANDS.split():
        return _parse_overview(arguments)

    from train.commands.options import name_options

    name = arguments[0]
    module = importlib.import_module(f"train.commands.{name}")
    options = getattr(module, name.capitalize())

    def command(given: Any) -> Any:
        return given

    command.__doc__ = options.__doc__
    # without a name of its own, what is wrong with an option is an error of this program, and no
    # box of tyro's
    command.__annotations__["given"] = Annotated[options, tyro.conf.arg(name="")]
    said = io.StringIO()
    try:
        with name_options(), contextlib.redirect_stderr(said):
            return tyro.cli(command, prog=f"elastic {name}", args=arguments[1:], config=_STYLE)
    except SystemExit as ended:
        # what is wrong with a group of options ends in a box of tyro's, in the words of Python
        problem = ended.__context__ and ended.__context__.__context__
        if isinstance(problem, ModelError):
            said = io.StringIO()
            with name_options():
                raise problem from None
        raise
    finally:
        sys.stderr.write(said.getvalue())


_STYLE = (tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes)


def _parse_overview(arguments: list[str]) -> Any:
    """Print the help of all commands, which are not loaded for it, or refuse an unknown command."""
    members: Any = []
    for name in COMMANDS.split():
        kind = dataclasses.make_dataclass(name, [], namespace={"__doc__": _help_of(name)})
        members.append(Annotated[kind, tyro.conf.subcommand(name)])
    union = functools.reduce(operator.or_, members)
    cli = functools.partial(tyro.cli, description=_OVERVIEW, config=_STYLE)
    return cli(union, prog="elastic", args=arguments)


_OVERVIEW = (
    "Elastic joints: simulate, identify, compensate, compare. `elastic COMMAND --help`"
    " explains each, `elastic --version` says which version this is."
)


def _help_of(name: str) -> str | None:
    """The docstring of a command, from its source."""
    source = Path(__file__).with_name(f"{name}.py").read_text(encoding="utf-8")
    for node in ast.parse(source).body:
        if isinstance(node, ast.ClassDef) and node.name == name.capitalize():
            return ast.get_docstring(node)
    raise AssertionError


def main(arguments: list[str] | None = None) -> None:
    """The command `elastic`."""

    def work() -> None:
        command = parse(sys.argv[1:] if arguments is None else arguments)
        with announce_compilation(CONSOLE), visible_warnings():
            command.run(CONSOLE)

    run_program(work)


def run_program(work: Callable[[], None]) -> None:
    """Do the work of a program; say what fails, and end the program with its exit code.

    Raises:
        SystemExit: Something failed, and it was said.
        BrokenPipeError: Nobody reads what the program says.
    """
    with _ended_by(signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        try:
            remove_from_path(Path.cwd())
            work()
        except BrokenPipeError:
            raise  # nobody reads any more: not worth a word
        except Exception as error:
            sys.exit(_print_failure(error))
        except KeyboardInterrupt as error:
            number = error.args[0] if isinstance(error, SignalError) else signal.SIGINT
            said = f"ended by {signal.Signals(number).name}"
            _print_last("interrupted" if number == signal.SIGINT else said, error)
            # worker processes must not keep the terminal waiting
            os._exit(128 + number)
