"""Named conditions: differences between the true plant and the assumed model.

There are two grounds: `ideal` (linear springs, no friction, exact sensors) and `nominal` (the
paper's robot: friction, sensor noise, encoder counts). Changes are added to a ground. A change
alone is added to `nominal`; `ideal+soft` adds it to `ideal`; changes can be joined: `soft+payload`.

The file `scenarios.yaml` in this folder lists the fields that grounds and changes set.

[AndradeChavez2019] F. J. Andrade Chavez, S. Traversaro, D. Pucci, "Six-Axis Force Torque Sensor
Model-Based In Situ Calibration Method and Its Impact in Floating-Based Robot Dynamic Performance",
Sensors 19(24), 5521.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import Field

from elastic_env.core.config import Title, quantity, read_mapping
from elastic_env.core.errors import ConfigurationError, quote, unknown_name
from elastic_env.world.robot_ranges import LOAD_PLACE, WALKER_FIELDS, RobotRanges
from elastic_env.world.sensors import AttitudeSensor, InertialSensor

MOST_RANGES = 100
"""Largest number of ranges in a scenario's mixture."""


class Scenario(RobotRanges):
    """Difference between the true plant and the assumed model, and the quality of the sensors.

    The intervals of `RobotRanges` are drawn per robot; a plain number is the same for all robots.
    """

    name: Title = "custom"
    friction_scale: float = quantity("1", 1.0, ge=0)
    """Share of the joints' friction that acts, 0 for none; policies of the walker know it [1]."""
    pendulum_mass_scale: float = quantity("1", 1.0, gt=0)
    """Testbed: true over assumed mass of pendulum [1]."""
    push_s: float = quantity("s", 0.1, gt=0, le=600)
    """Walker: duration of the push [s]."""
    encoder_counts: bool = True
    """True if the encoders have whole counts."""
    imu: AttitudeSensor = AttitudeSensor()
    """IMU on the link of the testbed."""
    pelvis_imu: AttitudeSensor = AttitudeSensor(rate_hz=500.0)
    """IMU in the pelvis of the walker, the same for roll and pitch."""
    inertial: InertialSensor = InertialSensor()
    """IMU of robots whose IMU computes its attitude, see `inertial_share`. The other errors of
    `pelvis_imu` or `imu` are then its mounting errors; their noise does not apply."""
    gyro_noise_rad_s: float = quantity("rad/s", 0.0, ge=0)
    """Walker: standard deviation of the gyroscope [rad/s]."""
    force_noise_n: float = quantity("N", 0.0, ge=0)
    """Walker: standard deviation of the foot forces [N]."""
    moment_noise_nm: float = quantity("N·m", 0.0, ge=0)
    """Walker: standard deviation of the foot moments [N·m]."""
    sensor_noise: float = quantity("1", 0.0, ge=0)
    """Factor on the errors of further sensors [1]."""
    mixture: tuple[RobotRanges, ...] = Field(default=(), max_length=MOST_RANGES)
    """Ranges that replace the scenario's own; each supplies an equal share of the robots."""

    def _check(self) -> None:
        super()._check()
        if self.mixture and self.changes:
            raise ValueError(
                f"mixture sets the robots' ranges; leave out {', '.join(self.changes)},"
                " or give it to the ranges of the mixture"
            )

    @property
    def parts(self) -> tuple[RobotRanges, ...]:
        """Ranges of the parameters; each supplies an equal share of the robots."""
        return self.mixture or (self,)

    @property
    def has_one_robot(self) -> bool:
        """True if episodes differ only in noise and in the draws of an inertial IMU."""
        return len(self.parts) == 1 and self.parts[0].is_one_robot

    @property
    def shoulder_load_kg(self) -> float:
        """Load on the shoulders of all robots, which is part of the true model [kg]."""
        return 0.0 if {*LOAD_PLACE} & {*self.changes} else self.fixed_value("load_kg")

    @property
    def places_loads(self) -> bool:
        """True if robots carry other loads than the common one on their shoulders."""
        heaviest = max(part.load_kg[1] for part in self.parts)
        return self.shoulder_load_kg == 0.0 and heaviest > 0.0

    @property
    def draws_robots(self) -> bool:
        """True if episodes of the same motion differ in more than noise.

        They differ in joints, offsets of sensors, push or slope.
        """
        draws = [part.push_n[1] + part.inertial_share > 0.0 for part in self.parts]
        return not self.has_one_robot or any(draws)

    @property
    def is_random(self) -> bool:
        """True if episodes of the same motion differ, even if only in noise."""
        noise = (self.gyro_noise_rad_s, self.force_noise_n, self.moment_noise_nm)
        imus = (self.imu.noise_rad, self.pelvis_imu.noise_rad)
        return self.draws_robots or any(noise + imus)

    @property
    def homing_width_rad(self) -> float:
        """Largest homing error of encoders [rad]."""
        return max(abs(end) for part in self.parts for end in part.homing_rad)


_DATA = read_mapping(Path(__file__).with_name("scenarios.yaml"))
GROUNDS = {name: Scenario(name=name, **sets) for name, sets in _DATA["grounds"].items()}
CHANGES: dict[str, dict[str, Any]] = _DATA["changes"]
"""Parameters that a change sets on its ground."""
TRAINING_RANGES = RobotRanges(**_DATA["training_ranges"])
"""Ranges of `drawn`."""
RANGES_BEYOND: list[dict[str, Any]] = _DATA["ranges_beyond"]
"""Intervals beyond those of `drawn`; each supplies a ninth of the robots of `drawn_beyond`."""
_LONGEST_NAME = 1000
"""Characters of a joined name that are read."""
DISTRIBUTIONS = ("drawn", "drawn_beyond")
"""Changes that draw every episode's robot from ranges: `drawn` to learn from; `drawn_beyond` for
tests, where each robot has one quantity beyond the ranges of `drawn`."""
WALKER_ONLY = [key for key, sets in CHANGES.items() if sets.keys() <= {*WALKER_FIELDS}]
"""Changes that set only quantities of walkers."""

RangeChanges = Mapping[str, Any] | Sequence[Mapping[str, Any]]
"""Intervals of `drawn` that differ from `TRAINING_RANGES`. In a list each mapping defines separate
ranges, which supply equal shares of the robots."""


def _distribution(name: str, ranges: RangeChanges) -> dict[str, Any]:
    """Parameters of one of `DISTRIBUTIONS`."""
    changes = RANGES_BEYOND if name == "drawn_beyond" else ranges
    if not isinstance(changes, Mapping):
        return {"mixture": [TRAINING_RANGES.replace(**change) for change in changes]}
    fields = TRAINING_RANGES.model_fields_set | changes.keys()
    drawn = TRAINING_RANGES.replace(**changes)
    return {field: getattr(drawn, field) for field in fields}


def _fixed_base_parameters(parameters: dict[str, Any]) -> dict[str, Any]:
    """Parameters of a change that apply to a robot on a fixed base."""
    rest = {key: value for key, value in parameters.items() if key not in WALKER_FIELDS}
    if "mixture" in rest:
        rest["mixture"] = [part.without_walker_fields() for part in rest["mixture"]]
    return rest


def _require_ranges(ranges: Any, walks: bool) -> None:
    """Refuse ranges of a wrong type, and intervals of walkers for other robots."""
    mappings = [ranges] if isinstance(ranges, Mapping) else ranges
    is_list = isinstance(mappings, list | tuple)
    if not is_list or not all(isinstance(mapping, Mapping) for mapping in mappings):
        needed = "a mapping of intervals, or a list of such"
        raise ConfigurationError(f"ranges must be {needed}, got {quote(ranges)}")
    fields = {field for mapping in mappings for field in mapping}
    walker_fields = sorted(fields & {*WALKER_FIELDS})
    if walker_fields and not walks:
        choices = [key for key in RobotRanges.model_fields if key not in WALKER_FIELDS]
        problem = f"ranges: only a walker has {', '.join(walker_fields)}"
        raise ConfigurationError(f"{problem}; here choose from: {', '.join(choices)}")


def _merge_into_mixture(parameters: dict[str, Any], name: str) -> dict[str, Any]:
    """Move intervals beside a mixture into each of its ranges."""
    fields = parameters.keys() & RobotRanges.model_fields
    common = {field: parameters.pop(field) for field in fields}
    parts: list[RobotRanges] = parameters["mixture"]
    twice = sorted({field for part in parts for field in part.changes} & fields)
    if twice:
        raise ConfigurationError(f"scenario {name!r} sets {', '.join(twice)} a second time")
    return parameters | {"mixture": [part.replace(**common) for part in parts]}


def scenario_names(walks: bool = True) -> list[str]:
    """Names of the grounds and of single changes, without distributions.

    With walks=False changes of walkers are left out.
    """
    return [*GROUNDS, *(name for name in CHANGES if walks or name not in WALKER_ONLY)]


def make_scenario(
    name: "str | Scenario", walks: bool = True, ranges: RangeChanges | None = None
) -> Scenario:
    """Make the scenario of a name such as "nominal", "soft", "ideal+soft" or "soft+payload".

    Args:
        name: Name, or the scenario itself.
        walks: True if the robot walks. For other robots changes do not set quantities of walkers,
            and the error for an unknown name does not list changes of walkers.
        ranges: Intervals that replace those of `drawn`; other changes stay the same.

    Raises:
        ConfigurationError: A part of the name does not exist, a ground is not the first part, or
            two changes set the same parameter.
    """
    if isinstance(name, Scenario):
        return name
    _require_ranges(ranges or {}, walks)
    changes = str(name)[:_LONGEST_NAME].split("+")
    ground = GROUNDS[changes.pop(0) if changes[0] in GROUNDS else "nominal"]
    parameters: dict[str, Any] = {}
    for change in changes:
        if change in GROUNDS:
            problem = f"{change!r} is a ground and can only stand first"
            raise ConfigurationError(f"scenario {name!r}: {problem}")
        if change not in (*CHANGES, *DISTRIBUTIONS):
            choices = [*scenario_names(walks), *DISTRIBUTIONS]
            raise unknown_name("scenario", change, choices)
        added = CHANGES.get(change) or _distribution(change, ranges or {})
        if not walks and change not in WALKER_ONLY:
            added = _fixed_base_parameters(added)
        twice = sorted(parameters.keys() & added.keys())
        if twice:
            problem = f"{change!r} sets {', '.join(twice)} a second time"
            raise ConfigurationError(f"scenario {name!r}: {problem}")
        parameters |= added
    if "mixture" in parameters:
        parameters = _merge_into_mixture(parameters, str(name))
    return ground.replace(**parameters, name=str(name))
