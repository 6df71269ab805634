"""The class of the controller for ros2_control that is free of ROS: equal to Python."""

import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.test_c_export import seven
from train.export.c_arm import c_header

FOLDER = Path("ros2/elastic_controller")
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
STRICT = "-std=c++17 -O1 -Wall -Wextra -Wpedantic -Werror -fsanitize=undefined"
FOUND = [name for name in ("g++", "clang++") if shutil.which(name)]
DRIVER = r"""
#include "elastic_controller/compensation.hpp"
#include <cstdio>

int main()
{
  using elastic_controller::Compensation;
  Compensation one;
  Compensation::Values values{};
  values.fill(0.25);
  one.begin(values);
  if (!one.set_payload(0.3, {0.0, 0.0, 0.1}) || one.set_payload(-1.0, {})) {return 1;}
  while (std::fread(values.data(), sizeof(double), values.size(), stdin) == values.size()) {
    Compensation::Values links{};
    const bool is_taken = one.update(values);
    if (is_taken != std::isfinite(values[0]) || !one.link_angle(one.command(), links)) {return 2;}
    std::fwrite(one.command().data(), sizeof(double), values.size(), stdout);
    std::fwrite(links.data(), sizeof(double), values.size(), stdout);
  }
  return 0;
}
"""


@pytest.mark.skipif(not FOUND, reason="no compiler of C++: apt-get install g++")
@pytest.mark.parametrize("compiler", FOUND or ["none"])
def test_the_class_commands_what_python_does(compiler: str, tmp_path: Path) -> None:
    """Catches a header that is none in C++, a bad reference that is commanded, and a start away
    from where the servos stand."""
    shutil.copytree(FOLDER / "include", tmp_path, dirs_exist_ok=True)
    compensator = seven()
    (tmp_path / "elastic_controller" / "arm.h").write_text(c_header(compensator, "arm"))
    (tmp_path / "driver.cpp").write_text(DRIVER)
    made = [compiler, *STRICT.split(), "-I.", "driver.cpp", "-o", "driver", "-lm"]
    done = subprocess.run(made, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    n = len(compensator.joints)
    path = np.cumsum(np.random.default_rng(0).normal(0.0, 0.01, (50, n)), axis=0)
    path[[0, 20], 0] = np.nan
    played = subprocess.run(
        [tmp_path / "driver"], input=path.tobytes(), capture_output=True, check=True, timeout=60
    )
    found = np.frombuffer(played.stdout).reshape(-1, 2, n)
    compensator.set_payload(0.3, (0.0, 0.0, 0.1))
    expected = np.full(n, 0.25)
    for row, desired in zip(found, path, strict=True):
        if np.isfinite(desired).all():
            expected = compensator.command(desired)
        np.testing.assert_allclose(row[0], expected, rtol=0.0, atol=1e-12)
        link = compensator.link_angle(expected)
        np.testing.assert_allclose(row[1], link, rtol=0.0, atol=1e-12)


def test_names_of_the_package_agree() -> None:
    """Catches a plugin that ROS would not find: it is not built here."""
    plugin = ET.parse(FOLDER / "elastic_controller.xml").getroot()
    one = plugin.find("class")
    assert one is not None
    source = (FOLDER / "src" / "elastic_controller.cpp").read_text()
    exported = re.findall(r"EXPORT_CLASS\(\s*(\S+), (\S+)\)", source)
    assert exported == [(one.get("type"), one.get("base_class_type"))]
    package = ET.parse(FOLDER / "package.xml").getroot()
    assert package.findtext("name") == plugin.get("path")
    needed = {depend.text for depend in package.findall("depend")}
    cmake = (FOLDER / "CMakeLists.txt").read_text()
    listed = re.search(r"set\(DEPENDENCIES (.*)\)", cmake)
    assert listed is not None
    assert set(listed[1].split()) == needed
    settings = yaml.safe_load((FOLDER / "config" / "elastic_controller.yaml").read_text())
    types = settings["controller_manager"]["ros__parameters"]
    assert types["elastic_controller"]["type"] == one.get("name")
    assert "never compiled or run" in (FOLDER / "README.md").read_text()
