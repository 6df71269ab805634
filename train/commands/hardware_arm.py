"""Options of commands that move an arm, and the setup of the arm that its files describe."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from baselines import PositionCompensator
from elastic_env.core.config import Locator, Model, load_yaml, quantity, read_mapping
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.hardware.arm_settings import ArmSettings
from elastic_env.hardware.buses.servo_models import model_number
from elastic_env.hardware.settings import PATIENT_LIMITS
from elastic_env.joint.model_file import compiled_model
from elastic_env.joint.model_joints import held_positions
from elastic_env.joint.small_servos import SMALL_SERVOS
from elastic_env.rigid.tree.end_effector import EndEffector, outermost_body

RAMP_S = 1.0
"""Time in which the compensation grows from zero [s]."""
_MAX_DEFLECTION_RAD = 1.0
"""Largest deflection that can be compensated, which is the largest `limit_rad` [rad]."""


class ArmOptions(Model):
    """Options of commands that move an arm."""

    robot: Locator
    """Rigid model of the arm, MJCF (.xml) or URDF (.urdf)."""
    mounting: Path
    """YAML file of ids, signs, zeros and limits, see docs/hardware.md."""
    port: str | None = None
    """Port of the servos, such as /dev/ttyACM0; default that of the mounting."""
    end_effector: str | None = None
    """Site or body whose motion is given in questions; default the outermost body."""
    check: bool = True
    """Move every joint a little first, to check its sign and its load; then all together, so that
    dry friction acts from a known side."""
    nudge_rad: float = quantity("rad", 0.08, ge=0.02, le=0.2)
    """How far, to either side; near a stop, up to three times as far away from it [rad]."""
    dry_run: bool = False
    """Play against an emulated arm, in simulated time, and print the true error of its tip."""
    yes: bool = False
    """Begin to move without asking."""
    patient: bool = False
    """Tolerate ten missing replies in a row: for emulators, whose pseudo-terminals stall when the
    computer is busy."""
    output: Path | None = None
    """Folder for logs and configuration, new or empty; default runs/hardware, numbered if taken."""


class ArmSetup:
    """An arm as its files describe it: model, joints, servos and limits.

    Args:
        options: Files of its model and its mounting.
        joints: File of its joints; None for typical values of the servos that the mounting names.
        limit_rad: Largest offset between command and target [rad].

    Raises:
        ConfigurationError: A file cannot be used.
    """

    def __init__(self, options: ArmOptions, joints: Path | None, limit_rad: float = 0.3) -> None:
        self.options = options
        model = compiled_model(options.robot)
        if options.dry_run and options.port is not None:
            raise ConfigurationError("--dry-run plays against an emulated arm: leave --port out")
        port = "emulated" if options.dry_run else options.port
        overrides = {} if port is None else {"port": port}
        self.settings = load_yaml(options.mounting, ArmSettings, overrides)
        if options.patient:
            limits = self.settings.limits.replace(**PATIENT_LIMITS)
            self.settings = self.settings.replace(limits=limits)
        require_known_servos(self.settings, model)
        self.mapping = dict(read_mapping(joints)) if joints else typical_joints(self.settings)
        """Settings of the joints by name, as in a file of joints."""
        self.compensator = PositionCompensator.from_model(
            model,
            self.mapping if joints is None else joints,
            limit_rad=limit_rad,
            ramp_s=RAMP_S,
            period_s=1.0 / self.settings.rate_hz,
        )
        self.joints = self.compensator.joints
        needed = self.compensator.needed
        if needed.max() > _MAX_DEFLECTION_RAD:
            raise ConfigurationError(
                f"joint {self.joints[needed.argmax()]!r} would give way by {needed.max():.3g} rad"
                f" under the weight, and at most {_MAX_DEFLECTION_RAD:g} rad can be compensated:"
                " give stiffness and position_gain in N·m/rad"
            )
        self.servos = self.settings.servos(self.joints)
        self.lowest = self.compensator.constants.lowest
        self.highest = self.compensator.constants.highest
        self.ranges = self.servos.servo_ranges(self.lowest, self.highest, self.settings.limits)
        self.links = self.compensator.constants.body
        tip = options.end_effector or outermost_body(model)
        held = held_positions(model, self.joints)
        self.tip = EndEffector(model, self.joints, tip, held)

    def tip_error(self, desired: Array, links: Array) -> float:
        """Distance of the tip at link angles from that at desired angles, rms over rows [m].

        Args:
            desired: Desired link angles, (N, n) [rad].
            links: Link angles, (N, n) [rad].
        """
        return float(np.sqrt(np.mean(self.tip.errors(desired, links)[0] ** 2)))

    @property
    def middle(self) -> Array:
        """Middles of the joints' ranges, (n,) [rad]; zero for a joint without a range."""
        ends = np.stack([self.lowest, self.highest])
        return np.where(np.isfinite(ends).all(axis=0), ends, 0.0).mean(axis=0)


def require_known_servos(settings: ArmSettings, model: mujoco.MjModel) -> None:
    """Check that the model has the joints of a mounting, and that its servos are known.

    Raises:
        ConfigurationError: A joint or a servo is unknown.
    """
    names = [model.joint(j).name for j in range(model.njnt)]
    for name, place in settings.joints.items():
        if name not in names:
            raise ConfigurationError(
                f"the mounting names joint {name!r}, which the model does not have; it"
                f" has {', '.join(names)}"
            )
        if place.model is not None:
            model_number(place.model)


def typical_joints(settings: ArmSettings) -> dict[str, Any]:
    """Settings of the joints by name: names of servos, which give typical values.

    Raises:
        ConfigurationError: A joint has no servo whose typical values are known.
    """
    models = {name: place.model for name, place in settings.joints.items()}
    for name, model in models.items():
        if model not in SMALL_SERVOS:
            raise ConfigurationError(
                f"the servo of joint {name!r} is {model}, of which nothing is known; give its"
                f" `model` in the mounting ({', '.join(SMALL_SERVOS)}), or give --joints"
            )
    return models
