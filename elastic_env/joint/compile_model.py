"""MuJoCo's reading and compiling of models, with errors that teach."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import mujoco
import numpy as np
from mujoco import MjModel, MjSpec

from elastic_env.core.errors import ConfigurationError, quote

_Result = TypeVar("_Result")

_CURES = {
    "mass and inertia of moving bodies": (
        "every link that moves needs a mass [kg] and an inertia [kg·m²] above zero"
    ),
    "inertia m": (
        "the inertia must be that of a body: positive, no main value above the sum of the others"
    ),
    "Error opening file": (
        "put the mesh where the model names it, or take its shape out and give the link's inertia"
    ),
    "no decoder found": (
        "MuJoCo reads meshes of STL, OBJ and MSH; convert it, or take its shape out"
    ),
    "bad format in attribute": "it must be a number",
    "range[0] should be smaller": "the lower limit must be below the upper one",
    "Could not allocate memory": "make the sizes in <size> smaller",
}
"""Cures of MuJoCo's errors, by a part of their text."""
_LONGEST_ERROR = 400
"""Largest number of characters of MuJoCo's own text in an error."""


def compile_spec(spec: MjSpec, name: str) -> MjModel:
    """Compile a specification; `name` is its name in errors.

    Raises:
        ConfigurationError: MuJoCo cannot compile it, or the compiled model contradicts itself.
    """
    model = call_mujoco(spec.compile, name, "compile")
    require_sound(model, name)
    return model


def require_sound(model: MjModel, name: str) -> None:
    """Refuse numbers that MuJoCo accepts and that no robot has.

    Raises:
        ConfigurationError: A mass, an inertia or a property of a joint is not finite or negative,
            or a joint's lower limit is above its upper one.
    """
    for field, values, element in (
        ("mass", model.body_mass, model.body),
        ("inertia", model.body_inertia, model.body),
        ("armature", model.dof_armature[model.jnt_dofadr], model.joint),
        ("damping", model.dof_damping[model.jnt_dofadr], model.joint),
        ("frictionloss", model.dof_frictionloss[model.jnt_dofadr], model.joint),
        ("stiffness", model.jnt_stiffness, model.joint),
    ):
        is_sound = np.isfinite(values) & (np.asarray(values) >= 0.0)
        is_row_sound = is_sound.all(axis=1) if is_sound.ndim > 1 else is_sound
        wrong = np.flatnonzero(~is_row_sound)
        if wrong.size:
            kind = "body" if element == model.body else "joint"
            raise ConfigurationError(
                f"{field} of {kind} {element(int(wrong[0])).name!r} of {name} must be"
                f" finite and >= 0, got {quote(np.ravel(values[wrong[0]]).tolist())}"
            )
    if not np.isfinite(model.opt.gravity).all():
        raise ConfigurationError(
            f"gravity of {name} must be finite [m/s²], got {quote(model.opt.gravity.tolist())}"
        )
    for j in range(model.njnt):
        low, high = map(float, model.jnt_range[j])
        if low > high or np.isnan(low + high):
            raise ConfigurationError(
                f"the limits of joint {model.joint(j).name!r} of {name} contradict themselves:"
                f" {low:g} to {high:g}; the lower limit must be below the upper one"
            )


@contextmanager
def without_log_file(without_console: bool = False) -> Iterator[None]:
    """Keep MuJoCo from writing to MUJOCO_LOG.TXT, and on request to the console."""
    before = mujoco.MjLogConfig.get()
    silent = mujoco.MjLogConfig.get()
    silent.logto_file = False
    silent.logto_console &= not without_console
    silent.set()
    try:
        yield
    finally:
        before.set()


def call_mujoco(action: Callable[[], _Result], name: str, verb: str) -> _Result:
    """Return the result of an action of MuJoCo, whose errors become ours, with their cures.

    The action runs in a thread of its own, so that Ctrl-C reaches this one.
    """
    results: list[_Result] = []
    errors: list[Exception] = []

    def work() -> None:
        try:
            results.append(action())
        except Exception as error:
            # MuJoCo raises errors of nearly every type, and "unknown exception"
            errors.append(error)

    thread = threading.Thread(target=work, daemon=True)
    with without_log_file():
        thread.start()
        thread.join()
    if errors:
        problem = _describe(errors[0])
        raise ConfigurationError(f"MuJoCo cannot {verb} {name}: {problem}") from None
    return results[0]


def _describe(error: Exception) -> str:
    """Write MuJoCo's error in one line, with the cure where we know one."""
    lines = [line.strip() for line in str(error).splitlines()]
    text = ", ".join(filter(None, lines)) or type(error).__name__
    cures = [cure for part, cure in _CURES.items() if part in text]
    if len(text) > _LONGEST_ERROR:
        text = f"{text[:_LONGEST_ERROR]}..."
    return "; ".join([text, *cures])
