"""YAML for configurations: plain data of bounded size, without YAML 1.1's guesses.

`parse_yaml` reads what `yaml_of` and `yaml_line` write.

The limits are checked before anything is built, so that a small file cannot use much memory.
"""

import re
from typing import Any

import yaml
from yaml.composer import Composer

LARGEST_TEXT = 100_000
"""Largest number of characters of a text."""
DEEPEST_NESTING = 30
"""Largest depth of mappings and lists within one another."""
_TOO_DEEP = f"mappings and lists must be nested at most {DEEPEST_NESTING} deep"
MOST_VALUES = 20_000
"""Largest number of values of a text; an alias counts as all values that it repeats."""
LONGEST_NUMBER = 40
"""Largest number of characters of a number."""

_NO_FOLDING = 10**9  # characters of a line
_TAG = "tag:yaml.org,2002:"
_EXPONENT = re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$")
NO_TEXT = re.compile("[\x00\ud800-\udfff]")
"""Characters that no name and no file can hold: zero bytes and halves of characters."""


class _Loader(Composer, yaml.CSafeLoader):
    """PyYAML's loader with limits and the numbers of YAML 1.2 (1e3), without dates and tags.

    The composer is PyYAML's, which can be limited. The parser is libyaml's, several times as fast
    as PyYAML's.
    """

    # without the resolver of dates: they stay text
    yaml_implicit_resolvers = {
        first: [pair for pair in resolvers if pair[0] != f"{_TAG}timestamp"]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def __init__(self, text: str) -> None:
        yaml.CSafeLoader.__init__(self, text)
        Composer.__init__(self)
        self._depth = 0
        self._sizes: dict[int, int] = {}  # number of values of a node, by its id

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a node within the limits."""
        event: Any = self.peek_event()
        if isinstance(event, yaml.AliasEvent):
            node = super().compose_node(parent, index)
            if id(node) not in self._sizes:
                problem = f"the alias *{event.anchor} stands within what it names"
                raise _refusal(event, problem)
            return node
        _require_plain(event)
        self._depth += 1
        if self._depth > DEEPEST_NESTING:
            raise _refusal(event, _TOO_DEEP)
        node = super().compose_node(parent, index)
        self._depth -= 1
        if isinstance(node, yaml.MappingNode):
            _require_names(self, node)
        size = 1 + sum(self._sizes[id(part)] for part in _parts(node))
        self._sizes[id(node)] = size
        if size > MOST_VALUES:
            rule = f"it must hold at most {MOST_VALUES} values, aliases counted in full"
            raise _refusal(event, rule)
        return node

    def construct_number(self, node: Any) -> int | float:
        """Convert a number of bounded length."""
        text = self.construct_scalar(node)
        if len(text) > LONGEST_NUMBER:
            bound = f"at most {LONGEST_NUMBER} characters"
            raise _refusal(node, f"a number must have {bound}, got {len(text)}")
        try:
            if node.tag == f"{_TAG}int":
                return self.construct_yaml_int(node)
            return self.construct_yaml_float(node)
        except ValueError:
            problem = f"{text!r} is no number; put text that looks like one in quotes"
            raise _refusal(node, problem) from None


_Loader.add_implicit_resolver(f"{_TAG}float", _EXPONENT, list("-+.0123456789"))
for _kind in ("int", "float"):
    _Loader.add_constructor(f"{_TAG}{_kind}", _Loader.construct_number)


def parse_yaml(text: str) -> Any:
    """Parse a text in YAML into plain mappings with text as keys, lists and scalars.

    Raises:
        yaml.YAMLError: The text is not YAML, exceeds the limits of this module, or holds tags,
            dates as objects, zero bytes, or a key twice.
    """
    if len(text) > LARGEST_TEXT:
        needed = f"at most {LARGEST_TEXT} characters"
        raise yaml.YAMLError(f"it must have {needed}, got {len(text)}")
    loader = _Loader(text)
    try:
        return loader.get_single_data()
    except yaml.MarkedYAMLError as error:
        raise _add_quotes_cure(text, error) from None
    finally:
        loader.dispose()


_SEARCHED = 200
"""Characters on both sides of an error that are searched: a whole long line would take minutes."""
_PATTERN = re.compile(
    r"""(?P<key>[^\s{},:'"]*\*[^\s{},:'"]*)\s*(?::(?P<value>\s*\{[^}]*\}|[^,}#]*))?"""
)


def _add_quotes_cure(text: str, error: yaml.MarkedYAMLError) -> yaml.MarkedYAMLError:
    """Replace the error by one with the cure, where YAML read the star of a pattern as an alias."""
    is_clear = error.problem is None or error.problem.startswith("the alias")
    lines = [] if is_clear else text.splitlines()
    for mark in (error.context_mark, error.problem_mark):
        if mark is None or mark.line >= len(lines):
            continue
        begin = max(mark.column - _SEARCHED, 0)
        text_around = lines[mark.line][begin : mark.column + _SEARCHED]
        for match in _PATTERN.finditer(text_around):
            if not match.start() <= mark.column - begin < match.end("key"):
                continue
            key = match["key"][:40]
            key = key if "[" in key and "]" in key else key.strip("[]")
            value = "" if match["value"] is None else f": {match['value'].strip()[:40]}"
            return _refusal(mark, f'put the pattern in quotes: "{key}"{value}')
    return error


class _Dumper(yaml.SafeDumper):
    """PyYAML's dumper with quotes around text that `parse_yaml` would read as a number or fold."""

    def represent_text(self, text: str) -> yaml.ScalarNode:
        """Represent text, with escapes where it holds line ends or others that do not print."""
        style = None if text.isprintable() else '"'
        return self.represent_scalar(f"{_TAG}str", text, style)


_Dumper.add_representer(str, _Dumper.represent_text)
_Dumper.add_implicit_resolver(f"{_TAG}float", _EXPONENT, list("-+.0123456789"))


def yaml_of(content: Any) -> str:
    """Write plain data as YAML that `parse_yaml` reads."""
    return yaml.dump(content, Dumper=_Dumper, allow_unicode=True, sort_keys=False)


def yaml_line(name: str, value: Any, comment: str) -> str:
    """Write an entry of a mapping with a comment on one line; a long name takes two lines.

    Args:
        name: Key of the entry, any text that a file can hold.
        value: Plain data, at most one level of mappings or lists deep.
        comment: Comment; characters that do not print become spaces.
    """
    # None: flow style for a value that holds no mapping or list
    flow = None if isinstance(value, dict | list) else False
    style: dict[str, Any] = {"default_flow_style": flow, "width": _NO_FOLDING}
    text = yaml.dump({name: value}, Dumper=_Dumper, allow_unicode=True, **style)
    printed = "".join(char if char.isprintable() else " " for char in comment)
    return f"{text.rstrip()}  # {printed}"


def _require_plain(event: Any) -> None:
    """Refuse tags, and text that no file can hold."""
    if event.tag not in (None, "!", f"{_TAG}str"):
        tag = event.tag.replace(_TAG, "!!")[:100]
        raise _refusal(event, f"the tag {tag!r} has no meaning here; leave it out")
    if isinstance(event, yaml.ScalarEvent) and NO_TEXT.search(event.value):
        problem = "text must hold neither zero bytes nor halves of characters"
        raise _refusal(event, problem)


def _require_names(loader: _Loader, node: yaml.MappingNode) -> None:
    """Refuse keys of a mapping that are no text, and duplicate keys."""
    seen: set[str] = set()
    for key, _ in node.value:
        if key.tag == f"{_TAG}merge":
            continue
        if key.tag not in (f"{_TAG}str", f"{_TAG}value"):
            is_scalar = isinstance(key, yaml.ScalarNode)
            got = repr(loader.construct_object(key)) if is_scalar else f"a {key.id}"
            problem = f"the name of a parameter must be text, got {got}"
            raise _refusal(key, f"{problem}; put it in quotes if it is meant")
        if key.value in seen:
            problem = f"the key {key.value[:100]!r} stands twice in one mapping"
            raise _refusal(key, f"{problem}; keep one of them")
        seen.add(key.value)


def _parts(node: yaml.Node | None) -> list[yaml.Node]:
    """Return the nodes directly within a node."""
    if isinstance(node, yaml.MappingNode):
        return [part for pair in node.value for part in pair]
    return list(node.value) if isinstance(node, yaml.SequenceNode) else []


def _refusal(at: Any, problem: str) -> yaml.MarkedYAMLError:
    """Return an error at a place: a node, an event or a mark."""
    mark = getattr(at, "start_mark", at)
    return yaml.MarkedYAMLError(problem=problem, problem_mark=mark)
