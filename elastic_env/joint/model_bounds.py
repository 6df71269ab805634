"""Bounds of a model, checked on its XML before MuJoCo builds it.

A small file must not use much time or memory.
"""

import math
import stat
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path

from elastic_env.core.errors import ConfigurationError, quote
from elastic_env.core.files import read_rows
from elastic_env.joint import model_text
from elastic_env.joint.model_text import ModelText, name_of

MOST_JOINTS = 500
MOST_BODIES = 2_000
MOST_ELEMENTS = 20_000
"""Elements of a model, with the copies that <replicate> and <attach> make."""
MOST_PIXELS = 2**28
"""Pixels of all pictures of a model together."""
MOST_ASSET_BYTES = 500_000_000
"""Size of all meshes and pictures of a model together."""

FOLDERS = ("meshdir", "texturedir", "assetdir")
"""Attributes of <compiler> that name a folder of files."""
Files = tuple[Path, ...]
_JOINTS = ("joint", "freejoint")
_WORLD = ("worldbody", "body")
_SOFT = ("flexcomp", "composite", "flex")
_LARGEST = [
    (row["tag"], row["attributes"].split(), int(row["most"]))
    for row in read_rows(Path(__file__).with_suffix(".csv"))
]
"""Elements, some of their attributes, and the largest product of the magnitudes of these."""
_PREFIXES = ("nuser_", "iterations", "_iterations", "_initpoints")
_LARGEST_PRODUCT = 10_000
_UNITS = {"K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40, "P": 2**50, "E": 2**60}
_MOST_MEMORY = 2**30
_FINEST_MESH = 300
"""Largest resolution of a mesh that MuJoCo makes: the vertices grow with its square."""
_SHORTEST_STEP_S = 1e-5
_PNG = b"\x89PNG\r\n\x1a\n"


def require_bounds(model: ModelText) -> None:
    """Refuse a model that is larger than any robot.

    Raises:
        ConfigurationError: A count, a size or a file exceeds its bound, or files include one
            another in a circle.
    """
    counts = _Counts(model)
    if model.is_urdf:
        counts.add_urdf(model.root)
    else:
        counts.add(model.root, (() if model.file is None else (model.file.resolve(),)))


@dataclass
class _Counts:
    """Running counts of a model."""

    model: ModelText
    elements: float = 0.0
    bodies: float = 0.0
    joints: float = 0.0
    pixels: float = 0.0
    asset_bytes: int = 0
    _counted_assets: set[Path] = field(default_factory=set)
    _attached: dict[str, ET.Element] = field(default_factory=dict)
    _folders: list[str] = field(default_factory=lambda: [""])

    def add_urdf(self, robot: ET.Element) -> None:
        """Count the parts of a URDF."""
        self._limit("elements", sum(1 for _ in robot.iter()), MOST_ELEMENTS)
        self._limit("bodies", len(robot.findall("link")), MOST_BODIES)
        joints = robot.findall("joint")
        moving = [joint for joint in joints if joint.get("type") != "fixed"]
        self._limit("joints", len(moving), MOST_JOINTS)
        for element in robot.iter():
            self._check_attributes(element)
        for mesh in robot.iter("mesh"):
            self._add_asset(mesh.get("filename", "").removeprefix("file://"))

    def add(self, root: ET.Element, files: Files) -> None:
        """Count the parts of a document of MJCF; `files` are those that include it."""
        self._note_folders(root)
        self._count(root, files, 1.0, in_world=False, depth=len(files))

    def _note_folders(self, root: ET.Element) -> None:
        for compiler in root.iter("compiler"):
            self._folders += [compiler.get(key, "") for key in FOLDERS]

    def _count(
        self, element: ET.Element, files: Files, copies: float, in_world: bool, depth: int
    ) -> None:
        tag = element.tag
        if depth > model_text.DEEPEST:
            raise ConfigurationError(
                f"{self.model.name} must be nested at most {model_text.DEEPEST}"
                " elements deep, with includes"
            )
        if tag in _SOFT:
            raise ConfigurationError(
                f"{self.model.name} has a deformable body (<{tag}>), whose forces on"
                " the links are not known in advance; take it out of the model"
            )
        if tag == "replicate":
            copies *= max(_number(element.get("count", "1")), 1.0)
        in_world = in_world or tag in _WORLD
        self.elements += copies
        self._limit("elements", self.elements, MOST_ELEMENTS)
        if tag == "body":
            self.bodies += copies
            self._limit("bodies", self.bodies, MOST_BODIES)
        if in_world and tag in _JOINTS:
            self.joints += copies
            self._limit("joints", self.joints, MOST_JOINTS)
        self._check_attributes(element)
        if tag == "include":
            self._include(element.get("file", ""), files, copies, in_world, depth)
        elif tag == "model":
            self._add_attachable(element, files)
        elif tag == "attach":
            self._attach(element, files, copies, depth)
        else:
            is_asset = tag in ("mesh", "texture", "hfield", "skin")
            for key, value in element.items():
                if is_asset and key.startswith("file"):
                    self._add_asset(value)
        for part in element:
            self._count(part, files, copies, in_world, depth + 1)

    def _include(self, name: str, files: Files, copies: float, in_world: bool, depth: int) -> None:
        root, path = self._read_document(name, files)
        if root is not None:
            self._note_folders(root)
            for part in root:
                self._count(part, (*files, path), copies, in_world, depth + 1)

    def _add_attachable(self, element: ET.Element, files: Files) -> None:
        name = element.get("file", "")
        root, path = self._read_document(name, files)
        if root is not None:
            self._attached[element.get("name") or Path(name).stem] = root
            self._count(root, (*files, path), 1.0, in_world=False, depth=len(files) + 1)

    def _attach(self, element: ET.Element, files: Files, copies: float, depth: int) -> None:
        root = self._attached.get(element.get("model", ""))
        if root is not None:
            name = element.get("body")
            bodies = [body for body in root.iter("body") if body.get("name") == name]
            for body in bodies or root.findall("worldbody"):
                self._count(body, files, copies, in_world=True, depth=depth + 1)

    def _read_document(self, name: str, files: Files) -> tuple[ET.Element | None, Path]:
        """Read a further file of the model; None for a missing one, which MuJoCo refuses later."""
        folders = [self.model.folder, *(file.parent for file in files[-1:])]
        paths = [folder / name for folder in folders if _exists(folder / name)]
        if not paths or not name:
            return None, self.model.folder
        path = paths[0].resolve()
        if path in files:
            raise ConfigurationError(
                f"{self.model.name} includes {name_of(path)} within itself; take the circle out"
            )
        content = model_text.read_bytes(path, "included model")
        text, _ = model_text.decode_xml(content, name_of(path))
        return model_text.parse_xml(text, name_of(path)), path

    def _add_asset(self, name: str) -> None:
        """Count a mesh or picture, which must be a regular file of bounded size, or missing."""
        for folder in self._folders:
            path = self.model.folder / folder / name
            if not name or path in self._counted_assets or not _exists(path):
                continue
            self._counted_assets.add(path)
            status = path.stat()
            if stat.S_ISDIR(status.st_mode):
                continue
            if not stat.S_ISREG(status.st_mode):
                problem = f"names {name_of(path)}, which is no regular file"
                raise ConfigurationError(f"{self.model.name} {problem}")
            self._limit(f"bytes of {name_of(name)}", status.st_size, model_text.LARGEST_BYTES)
            self.asset_bytes += status.st_size
            what = "bytes of meshes and pictures"
            self._limit(what, self.asset_bytes, MOST_ASSET_BYTES)
            self.pixels += _pixels(path)
            self._limit("pixels of pictures", self.pixels, MOST_PIXELS)

    def _check_attributes(self, element: ET.Element) -> None:
        """Refuse attributes that are too large or NaN."""
        tag = element.tag
        values = element.attrib
        for of_tag, names, most in _LARGEST:
            if of_tag in ("", tag) and any(name in values for name in names):
                numbers = [n for name in names for n in _numbers(values.get(name, ""))]
                what = f"{' times '.join(names)} of <{tag}>"
                self._limit(what, _product(numbers), most)
        for name, value in values.items():
            if name.startswith(_PREFIXES[:1]) or name.endswith(_PREFIXES[1:]):
                product = _product(_numbers(value))
                self._limit(f"{name} of <{tag}>", product, _LARGEST_PRODUCT)
            if name != "name" and _has_nan(value):
                raise ConfigurationError(
                    f"{name} of <{tag}> in {self.model.name} must be numbers, got {quote(value)}"
                )
        if tag == "texture" and {"width", "height"} <= set(values):
            sizes = [*_numbers(values["width"]), *_numbers(values["height"])]
            self.pixels += _product(sizes)
            self._limit("pixels of pictures", self.pixels, MOST_PIXELS)
        if tag == "mesh" and "params" in values:
            resolution = max(_numbers(values["params"]), default=0.0)
            self._limit("as params of a mesh", resolution, _FINEST_MESH)
        if tag == "size" and "memory" in values:
            memory = _bytes(values["memory"])
            self._limit("memory of <size> [bytes]", memory, _MOST_MEMORY)
        if tag == "lengthrange" and "timestep" in values:
            step = _number(values["timestep"])
            if not step >= _SHORTEST_STEP_S:
                needed = f"must be at least {_SHORTEST_STEP_S:g} s, got {step:g}"
                name = self.model.name
                raise ConfigurationError(f"timestep of <lengthrange> in {name} {needed}")

    def _limit(self, what: str, value: float, most: float) -> None:
        """Refuse a count or size above its bound."""
        if not value <= most:
            raise ConfigurationError(
                f"{self.model.name} must have at most {most:.15g} {what}, copies"
                f" counted, it has {value:.15g} or more; give a smaller model"
            )


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def _number(text: str) -> float:
    """Convert an attribute to a number; 0 where it is none, which MuJoCo refuses."""
    try:
        value = float(text)
    except ValueError:
        return 0.0
    return math.inf if math.isnan(value) else value


def _numbers(text: str) -> list[float]:
    return [abs(_number(part)) for part in text.split()[:100]]


def _product(numbers: list[float]) -> float:
    """Return the product of magnitudes; those below one count as one."""
    return math.prod(max(number, 1.0) for number in numbers)


def _has_nan(text: str) -> bool:
    if "nan" not in text.lower():
        return False
    try:
        return any(math.isnan(float(part)) for part in text.split())
    except ValueError:
        return False


def _bytes(text: str) -> float:
    """Convert a size such as "64M" to bytes."""
    text = text.strip()
    unit = _UNITS.get(text[-1:].upper(), 1)
    return abs(_number(text[:-1] if unit > 1 else text)) * unit


def _pixels(path: Path) -> int:
    """Return the pixels that a PNG declares; 0 for other files."""
    with path.open("rb") as file:
        head = file.read(24)
    if not head.startswith(_PNG) or len(head) < 24:
        return 0
    return int.from_bytes(head[16:20], "big") * int.from_bytes(head[20:24], "big")
