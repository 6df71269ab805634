"""Named conditions: what the true plant has that the assumed model does not know of.

Two grounds, `ideal` (linear springs, no friction, exact sensors) and `nominal` (the paper's robot:
friction, sensor noise, encoder counts), and changes on top of either. A change alone is meant on
top of `nominal`; `ideal+soft` puts it on `ideal`, and changes can be joined: `soft+payload`.

`scenarios.yaml` beside this file says what grounds and changes set.

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
from elastic_env.core.robot_ranges import LOAD_PLACE, WALKER_FIELDS, RobotRanges
from elastic_env.world.sensors import AttitudeSensor, InertialSensor

MOST_RANGES = 100
"""Ranges that the robots of a scenario come from."""


class Scenario(RobotRanges):
    """Difference between the true plant and the assumed model, and the quality of the sensors.

    The intervals of `RobotRanges` say in what robots differ; a number is what all of them have.
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
    """IMU of robots whose IMU computes its attitude, see `inertial_share`. Other errors of
    `pelvis_imu` or `imu` are then those of the mounting, without their noise."""
    gyro_noise_rad_s: float = quantity("rad/s", 0.0, ge=0)
    """Walker: standard deviation of the gyroscope [rad/s]."""
    force_noise_n: float = quantity("N", 0.0, ge=0)
    """Walker: standard deviation of the foot forces [N]."""
    moment_noise_nm: float = quantity("N·m", 0.0, ge=0)
    """Walker: standard deviation of the foot moments [N·m]."""
    sensor_noise: float = quantity("1", 0.0, ge=0)
    """Factor on the errors of further sensors [1]."""
    mixture: tuple[RobotRanges, ...] = Field(default=(), max_length=MOST_RANGES)
    """Ranges in place of the scenario's own, each of an equal share of the robots."""

    def _check(self) -> None:
        super()._check()
        if self.mixture and self.changes:
            raise ValueError(
                f"mixture says in what robots differ; leave out {', '.join(self.changes)}, or give"
                " it to the ranges of the mixture"
            )

    @property
    def parts(self) -> tuple[RobotRanges, ...]:
        """Ranges of the parameters; each supplies an equal share of the robots."""
        return self.mixture or (self,)

    @property
    def has_one_robot(self) -> bool:
        """True if episodes differ in noise and in what an inertial IMU draws alone."""
        return len(self.parts) == 1 and self.parts[0].is_one_robot

    @property
    def shoulder_load_kg(self) -> float:
        """Load that all robots have on their shoulders, part of the true model [kg]."""
        return 0.0 if {*LOAD_PLACE} & {*self.changes} else self.fixed_value("load_kg")

    @property
    def places_loads(self) -> bool:
        """True if robots carry other loads than that of all of them on the shoulders."""
        heaviest = max(own.load_kg[1] for own in self.parts)
        return self.shoulder_load_kg == 0.0 and heaviest > 0.0

    @property
    def draws_robots(self) -> bool:
        """True if episodes of the same motion differ in more than noise.

        That is in joints, offsets of sensors, push or slope.
        """
        acts = [own.push_n[1] + own.inertial_share > 0.0 for own in self.parts]
        return not self.has_one_robot or any(acts)

    @property
    def is_random(self) -> bool:
        """True if episodes of the same motion differ, be it by noise alone."""
        noise = (self.gyro_noise_rad_s, self.force_noise_n, self.moment_noise_nm)
        imus = (self.imu.noise_rad, self.pelvis_imu.noise_rad)
        return self.draws_robots or any(noise + imus)

    @property
    def homing_width_rad(self) -> float:
        """Largest homing error of encoders [rad]."""
        return max(abs(end) for own in self.parts for end in own.homing_rad)


_DATA = read_mapping(Path(__file__).with_name("scenarios.yaml"))
GROUNDS = {name: Scenario(name=name, **own) for name, own in _DATA["grounds"].items()}
CHANGES: dict[str, dict[str, Any]] = _DATA["changes"]
"""Parameters that a change sets on its ground."""
TRAINING_RANGES = RobotRanges(**_DATA["training_ranges"])
"""Ranges of `drawn`."""
RANGES_BEYOND: list[dict[str, Any]] = _DATA["ranges_beyond"]
"""Intervals beyond those of `drawn`, each of a ninth of the robots of `drawn_beyond`."""
_LONGEST_JOINED = 1000
"""Characters of a joined name that are looked at."""
DISTRIBUTIONS = ("drawn", "drawn_beyond")
"""Changes that draw every episode's robot from ranges: those to learn from, and for tests robots
that have one quantity beyond these."""
WALKER_ONLY = [name for name, own in CHANGES.items() if own.keys() <= {*WALKER_FIELDS}]
"""Changes that set quantities of walkers alone."""

RangeChanges = Mapping[str, Any] | Sequence[Mapping[str, Any]]
"""Intervals of `drawn` that differ from `TRAINING_RANGES`; of several such mappings each makes
ranges of its own, which have equal shares of the robots."""


def _distribution(name: str, ranges: RangeChanges) -> dict[str, Any]:
    """Parameters of one of `DISTRIBUTIONS`."""
    each = RANGES_BEYOND if name == "drawn_beyond" else ranges
    if not isinstance(each, Mapping):
        return {"mixture": [TRAINING_RANGES.replace(**own) for own in each]}
    named = TRAINING_RANGES.model_fields_set | each.keys()
    drawn = TRAINING_RANGES.replace(**each)
    return {field: getattr(drawn, field) for field in named}


def _without_walking(parameters: dict[str, Any]) -> dict[str, Any]:
    """Parameters of a change for a robot that does not walk."""
    kept = {name: own for name, own in parameters.items() if name not in WALKER_FIELDS}
    if "mixture" in kept:
        kept["mixture"] = [own.without_walker_fields() for own in kept["mixture"]]
    return kept


def _require_ranges(ranges: Any, walks: bool) -> None:
    """Refuse what is no mapping or list of mappings, and intervals of walkers elsewhere."""
    each = [ranges] if isinstance(ranges, Mapping) else ranges
    is_list = isinstance(each, list | tuple)
    if not is_list or not all(isinstance(own, Mapping) for own in each):
        needed = "a mapping of intervals, or a list of such"
        raise ConfigurationError(f"ranges must be {needed}, got {quote(ranges)}")
    of_walkers = sorted({field for own in each for field in own} & {*WALKER_FIELDS})
    if of_walkers and not walks:
        here = ", ".join(name for name in RobotRanges.model_fields if name not in WALKER_FIELDS)
        problem = f"ranges: only a walker has {', '.join(of_walkers)}"
        raise ConfigurationError(f"{problem}; here choose from: {here}")


def _in_each_part(parameters: dict[str, Any], name: str) -> dict[str, Any]:
    """Parameters of a mixture whose ranges also hold the intervals that stand beside it."""
    fields = parameters.keys() & RobotRanges.model_fields
    beside = {field: parameters.pop(field) for field in fields}
    parts: list[RobotRanges] = parameters["mixture"]
    twice = sorted({field for own in parts for field in own.changes} & fields)
    if twice:
        raise ConfigurationError(f"scenario {name!r} sets {', '.join(twice)} a second time")
    return parameters | {"mixture": [own.replace(**beside) for own in parts]}


def scenario_names(walks: bool = True) -> list[str]:
    """Named conditions without joined names and distributions.

    On request only those of robots that do not walk.
    """
    return [*GROUNDS, *(name for name in CHANGES if walks or name not in WALKER_ONLY)]


def make_scenario(
    name: "str | Scenario", walks: bool = True, ranges: RangeChanges | None = None
) -> Scenario:
    """The scenario of a name such as "nominal", "soft", "ideal+soft" or "soft+payload".

    Args:
        name: Name, or the scenario itself.
        walks: Whether the robot walks. For one that does not, changes leave out what only a walker
            has, and an unknown name is answered without the changes of walkers.
        ranges: Intervals in place of those of `drawn`; other changes stay as they are.

    Raises:
        ConfigurationError: A part of the name does not exist, a ground stands behind another part,
            or two changes set the same parameter.
    """
    if isinstance(name, Scenario):
        return name
    _require_ranges(ranges or {}, walks)
    changes = str(name)[:_LONGEST_JOINED].split("+")
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
            added = _without_walking(added)
        twice = sorted(parameters.keys() & added.keys())
        if twice:
            problem = f"{change!r} sets {', '.join(twice)} a second time"
            raise ConfigurationError(f"scenario {name!r}: {problem}")
        parameters |= added
    if "mixture" in parameters:
        parameters = _in_each_part(parameters, str(name))
    return ground.replace(**parameters, name=str(name))
