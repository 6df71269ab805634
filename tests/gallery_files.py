"""Kinematics and inertias of the robots of the gallery, so that tests need neither the package nor
a network.

python -m tests.gallery_files       # writes tests/gallery anew from the installed package
"""

import shutil
import xml.etree.ElementTree as ET
from pathlib import Path

from elastic_env.robots.gallery import GALLERY, gallery_file

FOLDER = Path(__file__).parent / "gallery"
"""What is here of the package's robots."""
PACKAGED = [name for name, robot in GALLERY.items() if not robot.file.startswith("gymnasium")]
_KEPT = {
    "link": ("inertial",),
    "joint": ("parent", "child", "origin", "axis", "limit", "dynamics", "mimic"),
}


def excerpt(path: Path) -> str:
    """A URDF without its shapes, materials, transmissions and plugins."""
    root = ET.parse(path).getroot()
    for part in list(root):
        if part.tag not in _KEPT:
            root.remove(part)
    for part in root:
        for detail in [detail for detail in part if detail.tag not in _KEPT[part.tag]]:
            part.remove(detail)
    ET.indent(root, " ")
    return ET.tostring(root, encoding="unicode") + "\n"


def main() -> None:
    """Write all of them, and the licences that lie beside them."""
    for name in PACKAGED:
        source = gallery_file(name)
        file = FOLDER / GALLERY[name].file
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(excerpt(source), encoding="utf-8")
        licence = source.parents[1] / "LICENSE"
        if licence.is_file():
            shutil.copy(licence, file.parents[1])


if __name__ == "__main__":
    main()
