"""YAML as configurations need it: plain data of bounded size, and nothing that YAML 1.1 makes of
text.

What `yaml_of` and `yaml_line` write, `parse_yaml` reads.

The limits hold before anything is built, so that a small file cannot ask for much memory.
"""

import re
from typing import Any

import yaml
from yaml.composer import Composer

LARGEST_TEXT = 100_000
"""Characters of a text in YAML."""
DEEPEST_NESTING = 30
"""Mappings and lists within one another."""
MOST_VALUES = 20_000
"""Values of a text, with every alias counted as what it stands for."""
LONGEST_NUMBER = 40
"""Characters of a number."""

_NO_FOLDING = 10**9  # characters of a line
_TAG = "tag:yaml.org,2002:"
_EXPONENT = re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$")
NO_TEXT = re.compile("[\x00\ud800-\udfff]")
"""Characters that stand in no name and no file: zero bytes and halves of characters."""


class _Loader(Composer, yaml.CSafeLoader):
    """PyYAML's, with limits, without dates and tags, and with the numbers of YAML 1.2: 1e3 is one
    too.

    PyYAML's composer, in which limits can be set, is above libyaml's parser, several times as fast
    as PyYAML's.
    """

    # dates stay text: a list of the resolvers of its own
    yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in resolvers if tag != f"{_TAG}timestamp"]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def __init__(self, text: str) -> None:
        yaml.CSafeLoader.__init__(self, text)
        Composer.__init__(self)
        self._depth = 0
        self._sizes: dict[int, int] = {}  # values that a node stands for, by its id

    def compose_node(self, parent: Any, index: Any) -> Any:
        """A node within the limits."""
        event: Any = self.peek_event()
        if isinstance(event, yaml.AliasEvent):
            node = super().compose_node(parent, index)
            if id(node) not in self._sizes:
                raise _refusal(event, f"the alias *{event.anchor} stands within what it names")
            return node
        _require_plain(event)
        self._depth += 1
        if self._depth > DEEPEST_NESTING:
            raise _refusal(
                event, f"mappings and lists must be nested at most {DEEPEST_NESTING} deep"
            )
        node = super().compose_node(parent, index)
        self._depth -= 1
        if isinstance(node, yaml.MappingNode):
            _require_names(self, node)
        self._sizes[id(node)] = size = 1 + sum(self._sizes[id(part)] for part in _parts(node))
        if size > MOST_VALUES:
            raise _refusal(
                event,
                f"it must hold at most {MOST_VALUES} values, aliases counted as what they"
                " stand for",
            )
        return node

    def construct_number(self, node: Any) -> int | float:
        """A number of bounded length."""
        text = self.construct_scalar(node)
        if len(text) > LONGEST_NUMBER:
            raise _refusal(
                node, f"a number must have at most {LONGEST_NUMBER} characters, got {len(text)}"
            )
        try:
            return (
                self.construct_yaml_int(node)
                if node.tag == f"{_TAG}int"
                else self.construct_yaml_float(node)
            )
        except ValueError:
            raise _refusal(
                node, f"{text!r} is no number; put text that looks like one in quotes"
            ) from None


_Loader.add_implicit_resolver(f"{_TAG}float", _EXPONENT, list("-+.0123456789"))
for _kind in ("int", "float"):
    _Loader.add_constructor(f"{_TAG}{_kind}", _Loader.construct_number)


def parse_yaml(text: str) -> Any:
    """Content of a text in YAML: mappings with text as keys, lists, text, numbers, truth values,
    and None.

    Raises:
        yaml.YAMLError: It is not YAML, beyond the limits of this module, or holds tags, dates as
            objects, zero bytes, or a key twice.
    """
    if len(text) > LARGEST_TEXT:
        raise yaml.YAMLError(f"it must have at most {LARGEST_TEXT} characters, got {len(text)}")
    loader = _Loader(text)
    try:
        return loader.get_single_data()
    except yaml.MarkedYAMLError as error:
        raise _with_quotes(text, error) from None
    finally:
        loader.dispose()


_NEAR = 200
"""Characters around an error that are looked at: all of a long line would take minutes."""
_PATTERN = re.compile(
    r"""(?P<key>[^\s{},:'"]*\*[^\s{},:'"]*)\s*(?::(?P<value>\s*\{[^}]*\}|[^,}#]*))?"""
)


def _with_quotes(text: str, error: yaml.MarkedYAMLError) -> yaml.MarkedYAMLError:
    """The error with its cure, where a star, as in a pattern, is taken for YAML's sign of an
    alias.
    """
    lines = (
        [] if error.problem is None or error.problem.startswith("the alias") else text.splitlines()
    )
    for mark in (error.context_mark, error.problem_mark):
        if mark is None or mark.line >= len(lines):
            continue
        begin = max(mark.column - _NEAR, 0)
        near = lines[mark.line][begin : mark.column + _NEAR]
        for found in _PATTERN.finditer(near):
            if not found.start() <= mark.column - begin < found.end("key"):
                continue
            key = found["key"][:40]
            key = key if "[" in key and "]" in key else key.strip("[]")
            value = "" if found["value"] is None else f": {found['value'].strip()[:40]}"
            return _refusal_at(mark, f'put the pattern in quotes: "{key}"{value}')
    return error


class _Dumper(yaml.SafeDumper):
    """PyYAML's, with quotes around text that `parse_yaml` would read as a number, such as 1e3,
    or would fold.
    """

    def represent_text(self, text: str) -> yaml.ScalarNode:
        """Text; with escapes where it holds line ends or other characters that do not print."""
        return self.represent_scalar(f"{_TAG}str", text, style=None if text.isprintable() else '"')


_Dumper.add_representer(str, _Dumper.represent_text)
_Dumper.add_implicit_resolver(f"{_TAG}float", _EXPONENT, list("-+.0123456789"))


def yaml_of(content: Any) -> str:
    """Plain data as YAML that `parse_yaml` reads: mappings with text as keys, lists, text,
    numbers and the like.
    """
    return yaml.dump(content, Dumper=_Dumper, allow_unicode=True, sort_keys=False)


def yaml_line(name: str, value: Any, comment: str) -> str:
    """An entry of a mapping with a comment behind it, on a line of its own; a long name takes two
    lines.

    Args:
        name: Key of the entry, any text that a file can hold.
        value: Plain data without a mapping or list in it that holds another one.
        comment: Its characters that do not print become spaces.
    """
    flow = (
        None if isinstance(value, dict | list) else False
    )  # None: only what holds no mapping or list
    text = yaml.dump(
        {name: value},
        Dumper=_Dumper,
        allow_unicode=True,
        default_flow_style=flow,
        width=_NO_FOLDING,
    )
    printed = "".join(char if char.isprintable() else " " for char in comment)
    return f"{text.rstrip()}  # {printed}"


def _require_plain(event: Any) -> None:
    """Refuse tags, and text that no file can hold."""
    if event.tag not in (None, "!", f"{_TAG}str"):
        raise _refusal(
            event,
            f"the tag {event.tag.replace(_TAG, '!!')[:100]!r} has no meaning here; leave it out",
        )
    if isinstance(event, yaml.ScalarEvent) and NO_TEXT.search(event.value):
        raise _refusal(event, "text must hold neither zero bytes nor halves of characters")


def _require_names(loader: _Loader, node: yaml.MappingNode) -> None:
    """Refuse keys of a mapping that are no text, and those that stand there twice."""
    seen: set[str] = set()
    for key, _ in node.value:
        if key.tag == f"{_TAG}merge":
            continue
        if key.tag not in (f"{_TAG}str", f"{_TAG}value"):
            what = (
                repr(loader.construct_object(key))
                if isinstance(key, yaml.ScalarNode)
                else f"a {key.id}"
            )
            raise _refusal(
                key,
                f"the name of a parameter must be text, got {what}; put it in quotes if it is"
                " meant",
            )
        if key.value in seen:
            raise _refusal(
                key, f"the key {key.value[:100]!r} stands twice in one mapping; keep one of them"
            )
        seen.add(key.value)


def _parts(node: yaml.Node | None) -> list[yaml.Node]:
    """Nodes directly within a node."""
    if isinstance(node, yaml.MappingNode):
        return [part for pair in node.value for part in pair]
    return list(node.value) if isinstance(node, yaml.SequenceNode) else []


def _refusal(at: Any, problem: str) -> yaml.MarkedYAMLError:
    """An error that names the place."""
    return _refusal_at(at.start_mark, problem)


def _refusal_at(mark: Any, problem: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=mark)
