"""Parameter models and YAML files: what is wrong must be named, with what would be right."""

import re
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from baselines.policies import PolicyOptions
from elastic_env.core.config import Model, load_yaml, quantity
from elastic_env.core.errors import ConfigurationError, ElasticError, missing_extra, unknown_name
from elastic_env.core.yaml_text import parse_yaml
from elastic_env.robots.testbed.config import TestbedConfig
from elastic_env.robots.testbed.environment import configure_testbed
from elastic_env.robots.thormang.environment import configure_walk

ROOT = Path(__file__).parents[1]
CONFIGS = sorted((ROOT / "configs").glob("*.yaml"))


class Inner(Model):
    """A nested model."""

    length: float = quantity("m", 1.0, gt=0, le=2)
    """A length [m]."""


class Outer(Model):
    """A model with every kind of field."""

    rate: float = quantity("Hz", gt=0)
    """A rate [Hz]."""
    count: int = quantity("1", 3, ge=1)
    """A number [1]."""
    offset: float = quantity("rad", 0.0)
    """An unbounded angle [rad]."""
    inner: Inner = Inner()
    name: str = "x"
    way: tuple[float, float] = (0.0, 1.0)
    file: Path | None = None


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, r"Outer needs the parameter 'rate' \[Hz\]"),
        ({"rate": -1.0}, r"Outer\.rate must be a finite number > 0 \[Hz\], got -1\.0"),
        ({"rate": np.nan}, r"Outer\.rate must be a finite number > 0 \[Hz\], got nan"),
        ({"rate": np.inf}, r"Outer\.rate must be a finite number > 0 \[Hz\], got inf"),
        ({"rate": "fast"}, r"Outer\.rate must be .*number.* \[Hz\], got 'fast'"),
        ({"rate": None}, r"Outer\.rate must be .*number.* \[Hz\], got None"),
        (
            {"rate": 1.0, "offset": np.nan},
            r"Outer\.offset must be a finite number \[rad\], got nan",
        ),
        ({"rate": 1.0, "count": 0}, r"Outer\.count must be .*>= 1, got 0"),
        ({"rate": 1.0, "count": 2.5}, r"Outer\.count must be a whole number >= 1, got 2\.5"),
        (
            {"rate": 1.0, "raet": 2.0},
            r"unknown parameter of Outer 'raet'; choose one of: rate, count.*'rate'",
        ),
        (
            {"rate": 1.0, "inner": {"length": 3.0}},
            r"Outer\.inner\.length must be a finite number > 0 and <= 2 \[m\], got 3\.0",
        ),
        (
            {"rate": 1.0, "inner": {"lenght": 1.0}},
            r"unknown parameter of inner 'lenght'; choose one of: length.*'length'",
        ),
        ({"rate": 1.0, "inner": 5}, r"Outer\.inner must be a mapping of parameters, got 5"),
        ({"rate": 1.0, "way": [2.0]}, r"Outer\.way must have an entry 2, got \[2\.0\]"),
        ({"rate": 1.0, "file": 5}, r"Outer\.file must be a path, got 5"),
    ],
)
def test_a_wrong_value_names_parameter_unit_bound_and_itself(
    values: dict[str, object], message: str
) -> None:
    """Catches an error message without one of the four, also where models are nested."""
    with pytest.raises(ConfigurationError, match=message):
        Outer(**values)


class Numbers(Model):
    """A model with numbers in every arrangement, and with fields that are no numbers alone."""

    one: float | None = None
    count: int = 1
    several: list[float] = []
    fixed: tuple[float, ...] = ()
    named: dict[str, int] = {}
    switch: bool = False
    anything: Any = None
    path_or_number: str | float = 0.0


@pytest.mark.parametrize(
    "values",
    [
        {"one": "1"},
        {"one": True},
        {"one": np.True_},
        {"one": b"1"},
        {"count": "2"},
        {"count": True},
        {"several": [1.0, "2"]},
        {"several": np.array([True, True])},
        {"fixed": (True, 1.0)},
        {"fixed": np.array(["1", "2"])},
        {"named": {"a": "1"}},
        {"named": {"a": False}},
    ],
)
def test_text_and_truth_are_no_numbers(values: dict[str, object]) -> None:
    """Catches "2" taken for 2, and True for 1, also where numbers stand in lists and mappings."""
    (name,) = values
    with pytest.raises(
        ConfigurationError,
        match=rf"^Numbers\.{name}[.\w]* must be a valid (number|integer), got (b?['\"]|True|False)",
    ):
        Numbers(**values)


def test_numbers_may_be_those_of_numpy() -> None:
    """Catches arrays that are refused, and a float32 that becomes a neighbour of what is
    written."""
    model = Numbers(
        one=np.float32(1.6),
        count=np.int64(3),
        several=np.array([0.8, 0.6], dtype=np.float32),
        fixed=np.arange(2),
        named={"a": np.uint8(4)},
        path_or_number="1",
        anything="2",
    )
    assert (model.one, model.count, model.several, model.fixed) == (1.6, 3, [0.8, 0.6], (0.0, 1.0))
    assert (model.named, model.path_or_number, model.anything) == ({"a": 4}, "1", "2")
    assert type(model.one) is float
    assert Numbers(one=np.array(2.5)).one == 2.5
    with pytest.raises(ConfigurationError, match=r"Numbers\.one must be a finite number, got nan"):
        Numbers(one=np.float32("nan"))


@pytest.mark.parametrize(
    "text", ["1e3", "1E3", "+1e+3", "1.0e3", "10.e2", ".1e4", "1000", "1e3 # a remark"]
)
def test_numbers_with_an_exponent_are_numbers(text: str) -> None:
    """Catches the YAML of 2005, in which 1e3 is text."""
    assert parse_yaml(text) == 1000
    assert parse_yaml("1e3.json") == "1e3.json"
    assert parse_yaml("'1e3'") == "1e3"


def test_every_problem_is_reported_at_once() -> None:
    """Catches a configuration that must be mended error by error."""
    with pytest.raises(ConfigurationError) as error:
        Outer(rate=-1.0, count=0, offst=1.0)
    assert len(str(error.value).splitlines()) == 3
    for name in ("rate", "count", "offst"):
        assert name in str(error.value)


def test_models_are_frozen_and_their_copies_validated() -> None:
    """Catches a parameter that changes under the simulation, and a copy that skips the bounds."""
    outer = Outer(rate=2.0)
    with pytest.raises(ValueError, match="frozen"):
        outer.rate = 3.0  # type: ignore[misc]
    assert outer.replace(count=5) == Outer(rate=2.0, count=5)
    assert outer.count == 3
    with pytest.raises(
        ConfigurationError, match=r"Outer\.rate must be a finite number > 0 \[Hz\], got -3\.0"
    ):
        outer.replace(rate=-3.0)
    with pytest.raises(ConfigurationError, match="unknown parameter of Outer 'rte'"):
        outer.replace(rte=3.0)


def test_errors_are_value_errors() -> None:
    """Catches an error that callers of the standard library's kind would miss."""
    assert issubclass(ConfigurationError, ElasticError)
    assert issubclass(ElasticError, ValueError)


def test_unknown_names_list_the_choices_and_suggest_the_closest() -> None:
    """Catches a hint that is no choice, and one where nothing is close."""
    assert (
        str(unknown_name("policy", "inptu", ["zero", "input"]))
        == "unknown policy 'inptu'; choose one of: zero, input. Did you mean 'input'?"
    )
    assert (
        str(unknown_name("policy", "xyz", ["zero", "input"]))
        == "unknown policy 'xyz'; choose one of: zero, input."
    )
    assert "pip install -c constraints.txt '.[train]'" in str(
        missing_extra("torch", "train", "training")
    )


def test_a_yaml_file_becomes_the_model(tmp_path: Path) -> None:
    """Catches numbers that YAML reads as text, such as 1e3, and nested parameters that are lost."""
    file = tmp_path / "outer.yaml"
    file.write_text("rate: 1e3\ncount: 4\ninner:\n  length: 1.5\nname: tëst\n", encoding="utf-8")
    assert load_yaml(file, Outer) == Outer(
        rate=1000.0, count=4, inner=Inner(length=1.5), name="tëst"
    )
    assert load_yaml(str(file), Outer).rate == 1000.0


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", r"outer\.yaml must hold a mapping of parameters, .* got an empty file"),
        ("- 1\n- 2\n", r"outer\.yaml must hold a mapping of parameters, .* got list"),
        ("rate: [1, 2\n", r"(?s)outer\.yaml is not valid YAML.* in .*outer\.yaml, line 1"),
        ("rate: 1\n  count: 2\n", r"outer\.yaml is not valid YAML"),
        ("rate: !!python/object/apply:os.getcwd []\n", r"outer\.yaml is not valid YAML"),
        ("rate: -1\n", r"in .*outer\.yaml: rate must be a finite number > 0 \[Hz\], got -1"),
        ("rate: .nan\n", r"in .*outer\.yaml: rate must be a finite number > 0 \[Hz\], got nan"),
        (
            "rate: 1\nspeed: 2\n",
            r"in .*outer\.yaml: unknown parameter 'speed'; choose one of: rate, count",
        ),
        (
            "rate: 1\ninner: {width: 1}\n",
            r"in .*outer\.yaml: .*unknown parameter of inner 'width'; choose one of: length",
        ),
        ("rate: 1\n2: 3\n", r"outer\.yaml.*parameter.*2"),
        ("rate: 1\nnull: 3\n", r"outer\.yaml.*parameter.*None"),
    ],
)
def test_a_wrong_yaml_file_names_itself_and_the_problem(
    tmp_path: Path, content: str, message: str
) -> None:
    """Catches a traceback in place of an explanation, code in a file that runs, and keys that
    are no names."""
    file = tmp_path / "outer.yaml"
    file.write_text(content)
    with pytest.raises(ConfigurationError, match=message):
        load_yaml(file, Outer)


def test_a_file_that_is_no_text_is_an_explained_error(tmp_path: Path) -> None:
    """Catches a decoding error without the name of the file."""
    file = tmp_path / "outer.yaml"
    file.write_bytes(b"\xff\xfe\x00rate: 1")
    with pytest.raises(ConfigurationError, match=r"outer\.yaml"):
        load_yaml(file, Outer)


def test_a_missing_file_lists_those_beside_it(tmp_path: Path) -> None:
    """Catches a mistyped path that leaves one searching."""
    (tmp_path / "compare.yaml").write_text("rate: 1\n")
    with pytest.raises(
        ConfigurationError,
        match=r"no configuration file at .*cmpare\.yaml; found beside it: .*compare\.yaml",
    ):
        load_yaml(tmp_path / "cmpare.yaml", Outer)
    with pytest.raises(ConfigurationError, match="no configuration file at"):
        load_yaml(tmp_path / "no" / "such.yaml", Outer)
    with pytest.raises(ConfigurationError, match="is a folder"):
        load_yaml(tmp_path, Outer)


def test_a_configuration_of_the_testbed_survives_its_own_dump() -> None:
    """Catches a resolved configuration, stored beside results, that cannot be read back."""
    config = TestbedConfig(
        reference={"kind": "multisine", "seed": 4}, scenario={"name": "own", "stiffness": 0.5}
    )
    assert TestbedConfig(**config.model_dump()) == config


def test_every_parameter_has_a_unit_or_is_no_number() -> None:
    """Catches a number that nobody can read: all numeric parameters of the testbed carry their
    unit."""

    def numbers_without_unit(model: type[Model], seen: set[type]) -> list[str]:
        missing = []
        for name, field in model.model_fields.items():
            extra = field.json_schema_extra
            has_unit = isinstance(extra, dict) and "unit" in extra
            default = field.default
            if isinstance(default, Model) and type(default) not in seen:
                missing += numbers_without_unit(type(default), seen | {type(default)})
            elif (
                isinstance(default, int | float) and not isinstance(default, bool) and not has_unit
            ):
                missing.append(f"{model.__name__}.{name}")
        return missing

    assert numbers_without_unit(TestbedConfig, {TestbedConfig}) == []


def test_every_argument_of_an_environment_is_documented() -> None:
    """Catches an argument that docs/options.md does not have, or that it has and nothing takes;
    `tests/test_lookup.py` compares the keys of policies and configurations."""
    arguments = {*signature(configure_testbed).parameters, *signature(configure_walk).parameters}
    text = (ROOT / "docs" / "options.md").read_text(encoding="utf-8")
    assert arguments <= set(re.findall(r"`(\w+)`", text))
    first_cells = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    named = {name for cell in first_cells for name in re.findall(r"`(\w+)`", cell)}
    assert named <= arguments | PolicyOptions.model_fields.keys()


MANY = {str(number): number for number in range(2000)}


@pytest.mark.parametrize(
    "argument", [{"reward": MANY}, {"reward": [1] * 2000}, {"gait": [1] * 2000}, {"robot": MANY}]
)
def test_an_error_is_short_whatever_was_given(argument: dict[str, Any]) -> None:
    """Catches an error that repeats all of a long list, or names each of two thousand unknown
    parameters."""
    with pytest.raises(ConfigurationError) as raised:
        configure_walk(**argument)
    assert len(str(raised.value)) < 2000
    assert ("and 19" in str(raised.value)) == isinstance(next(iter(argument.values())), dict)
