"""The command `elastic`: its options, and its messages and exit codes after failures."""

import ast
import contextlib
import dataclasses
import functools
import importlib
import io
import math
import operator
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

import tyro
from rich.text import Text
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
    UnsupportedTypeAnnotationError,
)

import elastic_env
from elastic_env.core.config import Model
from elastic_env.core.config_problems import ModelError
from elastic_env.core.errors import shorten
from train.runs.console import PlainConsole, traceback_text, warn_once
from train.runs.failures import DEFECT, SignalError, explain
from train.runs.github_annotations import annotation, runs_in_workflow
from train.runs.import_path import remove_from_path
from train.runs.progress import announce_compilation

COMMANDS = (
    "identify evaluate compare train iterate export bench speed margins play view robot hardware"
    " lerobot hub demo"
)
"""Modules of this folder; each has a class of its name, with fields for options and `run`."""

CONSOLE = PlainConsole()
"""The console of the commands."""
_REPEAT_S = 2.0
"""Time after a signal in which further signals do not interrupt the end of the program."""


def _print_end(message: str, error: BaseException, prefix: str = "") -> None:
    """Print why the program ends, with the notes of its error."""
    notes = getattr(error, "__notes__", [])
    text = "; ".join([message.removesuffix(".") if notes else message, *notes])
    PlainConsole(stderr=True).print(Text.assemble((prefix, "bold red"), text))


def _print_failure(error: Exception) -> int:
    """Print the message of a failure, and return its exit code."""
    result = explain(error)
    if result is None:
        sys.stderr.write(traceback_text(error))
        kind = type(error).__name__
        result = f"this is a defect of elastic-env, please report it: {kind}", DEFECT
    message, code = result
    _print_end(message, error, "error: ")
    if runs_in_workflow():
        CONSOLE.print(annotation(message))
    return code


@contextlib.contextmanager
def _raise_signals(*numbers: int) -> Iterator[None]:
    """Raise signals that would end this program as exceptions; ignored signals stay ignored."""
    last_s = -math.inf

    def end(number: int, _: Any) -> None:
        nonlocal last_s
        now_s = time.monotonic()
        if now_s - last_s > _REPEAT_S:
            last_s = now_s
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
    """Return the command that arguments name, with its options.

    Raises:
        ConfigurationError: The value of an option is invalid.
        SystemExit: The user asked for help, or an option does not exist.
    """
    if arguments == ["--version"]:
        print(f"elastic-env {elastic_env.__version__}")
        sys.exit()
    short = [shorten(argument).replace("\n", " ") for argument in arguments]
    if short != arguments:
        _parse(short)  # if it fails, its message is short
    return _parse(arguments)


def _parse(arguments: list[str]) -> Any:
    if not arguments or arguments[0] not in COMMANDS.split():
        return _parse_overview(arguments)

    from train.commands.options import name_options

    name = arguments[0]
    module = importlib.import_module(f"train.commands.{name}")
    for kind in vars(module).values():
        if isinstance(kind, type) and issubclass(kind, Model) and hasattr(kind, "run"):
            kind.__doc__ = _set_examples_apart(kind.__doc__ or "")
    options = getattr(module, name.capitalize())

    def command(values: Any) -> Any:
        return values

    command.__doc__ = options.__doc__
    # with an empty name, a wrong option raises an error of this program instead of tyro's box
    command.__annotations__["values"] = Annotated[options, tyro.conf.arg(name="")]
    messages = io.StringIO()
    try:
        with name_options(), contextlib.redirect_stderr(messages):
            return tyro.cli(
                command,
                prog=f"elastic {name}",
                args=arguments[1:],
                config=_STYLE,
                registry=_REGISTRY,
            )
    except SystemExit as end:
        # tyro turns a wrong group of options into a box with the words of Python
        problem = end.__context__ and end.__context__.__context__
        if isinstance(problem, ModelError):
            messages = io.StringIO()
            with name_options():
                raise problem from None
        raise
    finally:
        sys.stderr.write(messages.getvalue())


def _set_examples_apart(text: str) -> str:
    """Put each command that ends a paragraph on a line of its own, from which it can be copied."""
    paragraphs = (" ".join(paragraph.split()) for paragraph in text.split("\n\n"))
    parts = [re.sub(": (elastic .*)", r":\n    \1", paragraph) for paragraph in paragraphs]
    # tyro hides a section called Example
    return "\n\n".join(parts).replace("Example:\n", "For example:\n")


_STYLE = (tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes)
_REGISTRY = ConstructorRegistry()


@_REGISTRY.primitive_rule
def _optional_rule(
    info: PrimitiveTypeInfo,
) -> PrimitiveConstructorSpec | UnsupportedTypeAnnotationError | None:
    """Show an option that may be None as `--port STR`; tyro shows `--port {None}|STR`."""
    kinds = get_args(info.type)
    if type(None) not in kinds:
        return None
    kind = functools.reduce(operator.or_, (kind for kind in kinds if kind is not type(None)))
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kind, info.markers))
    if isinstance(spec, UnsupportedTypeAnnotationError):
        return spec
    return dataclasses.replace(
        spec,
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: (
            ["None"] if value is None else spec.str_from_instance(value)
        ),
    )


@_REGISTRY.struct_rule
def _model_rule(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Show no default that is None or empty; the description of such an option has its meaning."""
    if not (isinstance(info.type, type) and issubclass(info.type, Model)):
        return None
    types = get_type_hints(info.type, include_extras=True)
    hint = tyro.conf.arg(help_behavior_hint=_default_hint)
    fields = []
    for name, field in info.type.model_fields.items():
        kind: Any = Annotated[types[name], hint]
        own = tyro.MISSING if field.is_required() else field.get_default(call_default_factory=True)
        default = getattr(info.default, name, own)
        fields.append(StructFieldSpec(name, kind, default, field.description))
    return StructConstructorSpec(info.type, tuple(fields))


def _default_hint(default: str) -> str:
    return "" if default in ("", "None") else f"(default: {default})"


def _parse_overview(arguments: list[str]) -> Any:
    """Print the help of all commands without loading them, or refuse an unknown command."""
    members: Any = []
    for name in COMMANDS.split():
        content = {"__doc__": _help_of(name)}
        kind = dataclasses.make_dataclass(name, [], namespace=content)
        members.append(Annotated[kind, tyro.conf.subcommand(name)])
    union = functools.reduce(operator.or_, members)
    return tyro.cli(union, prog="elastic", description=_OVERVIEW, args=arguments, config=_STYLE)


_OVERVIEW = (
    "Elastic joints: simulate, identify, compensate, compare. `elastic COMMAND --help`"
    " explains each, `elastic --version` says which version this is."
)


def _help_of(name: str) -> str:
    """Return the first paragraph of the docstring of a command from its source."""
    source = Path(__file__).with_name(f"{name}.py").read_text(encoding="utf-8")
    for node in ast.parse(source).body:
        if isinstance(node, ast.ClassDef) and node.name == name.capitalize():
            return (ast.get_docstring(node) or "").partition("\n\n")[0]
    raise AssertionError


def main(arguments: list[str] | None = None) -> None:
    """Run the command `elastic`."""

    def work() -> None:
        command = parse(sys.argv[1:] if arguments is None else arguments)
        with announce_compilation(CONSOLE), warn_once():
            command.run(CONSOLE)

    run_program(work)


def run_program(work: Callable[[], None]) -> None:
    """Do the work of a program; print a failure, and end the program with its exit code.

    Raises:
        SystemExit: The work failed, and the message was printed.
        BrokenPipeError: The reader of the output has ended.
    """
    with _raise_signals(signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        try:
            remove_from_path(Path.cwd())
            work()
        except BrokenPipeError:
            raise  # nobody would read a message
        except Exception as error:
            sys.exit(_print_failure(error))
        except KeyboardInterrupt as error:
            number = error.args[0] if isinstance(error, SignalError) else signal.SIGINT
            message = f"ended by {signal.Signals(number).name}"
            _print_end("interrupted" if number == signal.SIGINT else message, error)
            # worker processes must not keep the terminal waiting
            os._exit(128 + number)
