"""YAML of configurations: its limits, and what it does not make of text."""

import math
import time

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from elastic_env.core.yaml_text import (
    DEEPEST_NESTING,
    LARGEST_TEXT,
    parse_yaml,
    yaml_line,
    yaml_of,
)

LAUGHS = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 9)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LAUGHS, "at most 20000 values, aliases counted"),
        ("&a [*a]", r"alias \*a stands within what it names"),
        ("[" * 5000, "nested at most 30 deep"),
        ("a: " + "9" * 5000, "at most 40 characters, got 5000"),
        ("x" * 200_000, "at most 100000 characters, got 200000"),
        ("a: !!timestamp x", "the tag '!!timestamp' has no meaning here"),
        ("a: !!binary aGk=", "the tag '!!binary' has no meaning here"),
        ("a: 0b_", "'0b_' is no number"),
        ("a: 1\nb: 2\na: 3", "the key 'a' stands twice in one mapping"),
        ("a: {[1]: 2}", "name of a parameter must be text, got a sequence"),
        ("on: 2", "name of a parameter must be text, got True"),
        ('a: "\\0"', "zero bytes"),
        ('a: "\\ud800"', "invalid Unicode character escape code"),
    ],
)
def test_what_is_beyond_the_limits_is_refused_at_once(text: str, message: str) -> None:
    """Catches gigabytes from 400 bytes, a RecursionError, integers that cannot be printed, and
    keys that are lost."""
    began = time.process_time()
    with pytest.raises(yaml.YAMLError, match=message):
        parse_yaml(text)
    assert time.process_time() - began < 5.0


@pytest.mark.parametrize("text", ["2001-99-99", "2001-01-01", "2001-01-01 10:00:00"])
def test_dates_are_text(text: str) -> None:
    """Catches YAML's dates, which are no configuration's, and a traceback for those of no
    calendar."""
    assert parse_yaml(f"a: {text}") == {"a": text}


def test_what_is_within_the_limits_is_read() -> None:
    """Catches limits that take aliases, merges and nesting with them."""
    assert parse_yaml("a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}\nc: [*a, *a]") == {
        "a": {"x": 1, "y": 2},
        "b": {"x": 1, "y": 3},
        "c": [{"x": 1, "y": 2}] * 2,
    }
    depth = DEEPEST_NESTING - 1
    assert parse_yaml("[" * depth + "1" + "]" * depth) is not None


@pytest.mark.parametrize(
    ("text", "cure"),
    [
        ("*: 400", '"*": 400'),
        ("a: 3\n*_joint: {stiffness: 4}\n", '"*_joint": {stiffness: 4}'),
        ("{a: 3, *_b: 400}", '"*_b": 400'),
        ("[ab]*: 400", '"[ab]*": 400'),
        ("*:400", '"*": 400'),
        ("joints: *", '"*"'),
        ("joints: [a, *b]", '"*b"'),
    ],
)
def test_a_star_without_quotes_gets_its_cure(text: str, cure: str) -> None:
    """Catches the words of a parser for what the documentation itself recommends."""
    with pytest.raises(yaml.YAMLError) as said:
        parse_yaml(text)
    assert f"put the pattern in quotes: {cure}\n" in f"{said.value}"


NAMES = st.text(
    st.characters(exclude_categories=["Cs"], exclude_characters="\0"), min_size=1, max_size=200
) | (
    st.sampled_from(
        [
            "0",
            "no",
            "null",
            "~",
            "1e3",
            "-1E-3",
            "0x1f",
            "1_0",
            ".inf",
            "2020-01-01",
            "<<",
            "=",
            'x"y',
            "#",
        ]
    )
)


@given(
    names=st.lists(NAMES, min_size=1, max_size=4, unique=True),
    number=st.floats(1e-9, 1e12) | st.just(math.inf),
)
def test_names_and_numbers_are_read_as_they_were_written(names: list[str], number: float) -> None:
    """Catches a name without quotes that is read as a number or a truth value, and one that ends
    its line."""
    content = {name: {"stiffness": number} for name in names}
    lines = [yaml_line(name, own, f"± 2 % beside {names[0]}") for name, own in content.items()]
    assert parse_yaml("\n".join(["# a head", *lines])) == content
    assert parse_yaml(yaml_of(content)) == content
    assert parse_yaml(yaml_line(names[0], "held", "not in the log")) == {names[0]: "held"}


@pytest.mark.parametrize("sign", ["[", "[a, ", "{a: ", "- ", "*[", "[*"])
def test_a_long_line_is_refused_at_once(sign: str) -> None:
    """Catches a search for the cure that takes a time with the square of the line."""
    text = (sign * LARGEST_TEXT)[:LARGEST_TEXT]
    begin = time.process_time()
    with pytest.raises(yaml.YAMLError):
        parse_yaml(text)
    assert time.process_time() - begin < 2.0
