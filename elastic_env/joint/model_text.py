"""Reader of the XML of a model in MJCF or URDF, within bounds, before MuJoCo reads it.

Undeclared prefixes are accepted, as MuJoCo and ROS do. Text that must be expanded first (xacro,
entities) is refused.
"""

import codecs
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.parsers import expat

from elastic_env.core.errors import ConfigurationError, quote
from elastic_env.core.files import read_bounded

LARGEST_BYTES = 50_000_000
"""Largest size of a model's file, and of its text."""
DEEPEST = 200
"""Largest depth of elements within one another."""
LONGEST_NAME = 200
"""Characters of a name or path that an error shows."""

_BLANK = "\ufeff \t\r\n"
_KINDS = ("mujoco", "robot")
_FILE = "give a file of MJCF (.xml) or URDF (.urdf)"
_DECLARED = re.compile(rb"""^\s*<\?xml[^>]{0,200}?encoding\s*=\s*["']([A-Za-z0-9._-]{1,40})["']""")
_DECLARATION = re.compile(r"^<\?xml[^>]*\?>")
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_NO_ENCODINGS = "idna punycode unicode_escape raw_unicode_escape undefined mbcs oem"
_XACRO = "xacro"
_EXPAND = "expand it first: xacro arm.urdf.xacro > arm.urdf"
_XACRO_PARTS = {"property", "macro", "include", "insert_block", "if", "unless", "arg"}
"""Children of <robot> that old files of xacro have without prefix."""
_PLACEHOLDER = re.compile(r"\$[{(]")


@dataclass(frozen=True)
class ModelText:
    """A model as XML.

    Attributes:
        root: Its root, <mujoco> or <robot>. Prefixes are part of the tags.
        name: Its name in errors.
        folder: Folder of the files that it names.
        file: Its file; None for a text.
        text: The decoded text, without byte order mark.
        is_utf8: True if the file is in UTF-8, which MuJoCo reads by itself.
    """

    root: ET.Element
    name: str
    folder: Path
    file: Path | None
    text: str
    is_utf8: bool

    @property
    def is_urdf(self) -> bool:
        """True for a URDF, False for MJCF."""
        return self.root.tag == "robot"


def read_model_text(model: str | Path) -> ModelText:
    """Read a file of MJCF or URDF, or the text of one.

    Raises:
        ConfigurationError: There is no such file, it is too large, no XML or no model, or it must
            be expanded first.
    """
    if is_text(model):
        name = "the text of the model"
        text = str(model).lstrip(_BLANK)
        if len(text) > LARGEST_BYTES:
            raise ConfigurationError(
                f"{name} must have at most {LARGEST_BYTES} characters, it has {len(text)}"
            )
        root = parse_xml(text, name)
        model_text = ModelText(root, name, Path.cwd(), None, text, is_utf8=True)
    else:
        path = Path(model)
        name = name_of(path)
        text, is_utf8 = decode_xml(read_bytes(path), name)
        root = parse_xml(text, name)
        model_text = ModelText(root, name, path.resolve().parent, path, text, is_utf8)
    _require_model(model_text)
    return model_text


def is_text(model: object) -> bool:
    """Return True for the text of a model, False for a file."""
    return isinstance(model, str) and model.lstrip(_BLANK).startswith("<")


def without_declaration(text: str) -> str:
    """Return the text of a model without byte order mark and declared encoding, for UTF-8."""
    return _DECLARATION.sub("", text.lstrip(_BLANK), count=1)


def name_of(path: str | Path) -> str:
    """Return a path as errors show it: as it is, or shortened and escaped."""
    text = str(path)
    return text if len(text) <= LONGEST_NAME and text.isprintable() else quote(text)


def read_bytes(path: Path, what: str = "model") -> bytes:
    """Read a regular file of bounded size; nothing else is opened.

    Raises:
        ConfigurationError: It is no regular file, is too large, or cannot be read.
    """
    try:
        if path.exists() and not path.is_file():
            problem = f"no {what} at {name_of(path)}: it is no regular file"
            raise ConfigurationError(f"{problem}; {_FILE}")
        return read_bounded(path, LARGEST_BYTES)
    except ConfigurationError:
        raise
    except PermissionError as error:
        problem = f"{name_of(path)} cannot be read: {error.strerror}"
    except (OSError, ValueError):
        problem = f"no {what} at {name_of(path)}"
    raise ConfigurationError(f"{problem}; {_FILE}")


def parse_xml(text: str, name: str) -> ET.Element:
    """Parse an XML text of bounded depth; `name` is its name in errors.

    Raises:
        ConfigurationError: It is no XML, is nested too deeply, or declares entities.
    """
    tree = ET.TreeBuilder()
    depth = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > DEEPEST:
            needed = f"must be nested at most {DEEPEST} elements deep"
            line = f"line {parser.CurrentLineNumber} is deeper"
            raise ConfigurationError(f"{name} {needed}; {line}")
        tree.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        tree.end(tag)

    def refuse_entity(entity: str, *_: Any) -> None:
        raise ConfigurationError(
            f"{name} declares the entity {quote(entity)}, which is not read; write its text out"
        )

    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.EntityDeclHandler = refuse_entity
    try:
        parser.Parse(text, True)
        return tree.close()
    except (expat.ExpatError, AssertionError, ValueError) as error:
        if isinstance(error, ConfigurationError):
            raise
        raise ConfigurationError(f"{name} is no XML: {error}; {_FILE}") from None


def decode_xml(content: bytes, name: str) -> tuple[str, bool]:
    """Decode a file by its byte order mark or declared encoding; True if that is UTF-8."""
    encoding = next((name for mark, name in _MARKS if content.startswith(mark)), None)
    if encoding is None:
        declared = _DECLARED.match(content)
        encoding = declared.group(1).decode("ascii") if declared else "utf-8"
        if content[:4] in (b"<\0?\0", b"\0<\0?"):
            encoding = "utf-16-le" if content[0] else "utf-16-be"
    try:
        codec = codecs.lookup(encoding)
        is_for_text = codec._is_text_encoding  # type: ignore[attr-defined]
        if not is_for_text or codec.name.replace("-", "_") in _NO_ENCODINGS.split():
            raise LookupError
        text = content.decode(encoding)
    except LookupError:
        raise ConfigurationError(
            f"{name} declares the encoding {encoding!r}, which is not known; save the file in UTF-8"
        ) from None
    except (UnicodeError, ValueError):
        raise ConfigurationError(
            f"{name} is no XML: it is not in its encoding, {encoding}; save the file in UTF-8"
        ) from None
    return text.lstrip("\ufeff"), codec.name in ("utf-8", "utf-8-sig", "ascii")


def _require_model(model: ModelText) -> None:
    """Refuse XML that is neither MJCF nor URDF, and text that xacro has to expand."""
    root = model.root
    name = model.name
    aliases = {_XACRO} | {
        key.removeprefix("xmlns:")
        for key, value in root.attrib.items()
        if key.startswith("xmlns:") and _XACRO in value
    }
    for element in root.iter():
        for key in (element.tag, *element.attrib):
            prefix, colon, _ = key.partition(":")
            if colon and prefix in aliases:
                part = f"<{key}>" if key == element.tag else f"the attribute {key}"
                problem = f"{name} is a file of xacro, it has {quote(part)[1:-1]}"
                raise ConfigurationError(f"{problem}; {_EXPAND}")
    if root.tag not in _KINDS:
        raise ConfigurationError(
            f"the root of {name} must be <mujoco> or <robot>, got {quote(root.tag)}; {_FILE}"
        )
    if model.is_urdf:
        for element in _robot_parts(root):
            values = element.attrib.values()
            first = next((text for text in values if _PLACEHOLDER.search(text)), None)
            if first is not None:
                problem = f"{name} has {quote(first)} in <{element.tag}>, of xacro"
                raise ConfigurationError(f"{problem}; {_EXPAND}")
        old = next((part.tag for part in root if part.tag in _XACRO_PARTS), None)
        if old is not None:
            problem = f"{name} is a file of xacro, it has <{old}>"
            raise ConfigurationError(f"{problem}; {_EXPAND}")


def _robot_parts(robot: ET.Element) -> Iterator[ET.Element]:
    """Yield the elements of a URDF that describe the robot, not a simulator."""
    yield robot
    for part in robot:
        if part.tag in ("link", "joint"):
            yield from part.iter()
