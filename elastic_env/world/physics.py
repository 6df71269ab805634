"""Protocol of the physics: N worlds of one model, in MuJoCo or in hardware.

Arrays are (num_worlds, ...) views of the live state. One call makes all sub-steps of a control
period.
"""

from typing import Protocol

from mujoco import MjModel

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray


class Simulation(Protocol):
    """Physics of a task.

    The state arrays are live views; values written to `ctrl` command the next advance.
    """

    model: MjModel
    num_worlds: int
    qpos: Array
    qvel: Array
    act: Array
    ctrl: Array

    def bind(self, field: str) -> Array:
        """Return a live (num_worlds, ...) view of a field of `MjData`.

        Inputs such as `xfrc_applied` can be written. Derived fields and sensors lag one physics
        step behind the state, as after `mj_step`. Only calls after the first `bind` fill them, so
        bind them before `refresh`.
        """
        ...

    def views(self, fields: tuple[str, ...]) -> tuple[Array, ...]:
        """Bind several fields."""
        ...

    def vary(self, field: str) -> Array:
        """Return a live (num_worlds, ...) array of a field of `MjModel`, one row per world."""
        ...

    def set_model(self, world: int, model: MjModel) -> None:
        """Replace the model of a world, including its varied fields.

        The model must have the same numbers of bodies, joints and sensors. The state of the world
        stays.
        """
        ...

    def advance(self, num_substeps: int) -> None:
        """Step every world by `num_substeps` physics steps under its current `ctrl`."""
        ...

    def refresh(self, worlds: BoolArray) -> None:
        """Compute derived fields and sensors of some worlds, a (num_worlds,) mask."""
        ...

    def restart(self, worlds: BoolArray) -> None:
        """Reset some worlds, a (num_worlds,) mask, to the model's defaults.

        Write their state afterwards.
        """
        ...

    def divergence(self) -> BoolArray:
        """Mask of worlds with a bad number in state, acceleration or control since their restart.

        The mask has the shape (num_worlds,).
        """
        ...

    def close(self) -> None:
        """Release all resources; hardware switches its torque off."""
        ...


DIVERGED_RAD_S = 1e3
"""Speed of a joint that counts as divergence [rad/s]: two hundred times the no-load speed of the
servos.
"""

MOST_SUBSTEPS = 1000
"""Largest number of physics steps in a control period."""


def substeps(control_period_s: float, timestep_s: float) -> int:
    """Physics steps in a control period.

    Raises:
        ConfigurationError: The control period is no multiple of the physics step, or contains too
            many of them.
    """
    ratio = control_period_s / timestep_s
    if ratio > MOST_SUBSTEPS:
        raise ConfigurationError(
            f"timestep_s must be at least {control_period_s / MOST_SUBSTEPS:g} s, a"
            f" {MOST_SUBSTEPS}th of the control period, got {timestep_s:g} s"
        )
    if abs(ratio - round(ratio)) > 1e-9 or round(ratio) < 1:
        needed = f"must divide the control period of {control_period_s:g} s"
        raise ConfigurationError(f"timestep_s {needed}, got {timestep_s:g} s")
    return round(ratio)
