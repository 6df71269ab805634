"""Starts the processes of the hardware such that nothing from the working directory runs in them.

`python -m` puts the working directory first on the import path: a `serial.py` that lies there would run in the process
that is to switch torque off. Here a child

* has no working directory on its path: by `-P`, and by a PYTHONPATH without it in whatever spelling. Everything else
  of PYTHONPATH and the user's own packages stay, since the driver's packages may be installed there (`-I` would drop
  them);
* loads our packages from where this program has them, which may be the working directory, without looking for them.

This file is the first that a child runs: it imports the standard library alone.
"""

import importlib
import importlib.util
import os
import runpy
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

_PACKAGE, _PATH = "elastic_env", "PYTHONPATH"


def child_command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module of ours in a process of its own.

    Args:
        module: Such as elastic_env.hardware.safety.supervisor.
        *arguments: What it finds in `sys.argv`.
    """
    names = dict.fromkeys((_PACKAGE, module.partition(".")[0]))
    folders = os.pathsep.join(str(_folder(name)) for name in names)
    return [sys.executable, "-P", str(Path(__file__).resolve()), folders, module, *arguments]


def child_environment(environment: Mapping[str, str] = os.environ) -> dict[str, str]:
    """The environment of a child: that of this program, its PYTHONPATH without the working directory.

    Args:
        environment: Variables by name, default those of this program.
    """
    kept = [entry for entry in environment.get(_PATH, "").split(os.pathsep) if not _is_here(entry)]
    others = {name: value for name, value in environment.items() if name != _PATH}
    return {**others, _PATH: os.pathsep.join(kept)} if kept else others


def _is_here(entry: str) -> bool:
    """Whether an entry of PYTHONPATH is the working directory, which an empty one means too."""
    return not entry or os.path.realpath(entry) == os.path.realpath(".")


def _folder(package: str) -> Path:
    """Where this program has a package from."""
    file = importlib.import_module(package).__file__
    assert file is not None
    return Path(file).resolve().parent


def _load(folder: Path) -> None:
    """Import a package from its folder."""
    spec = importlib.util.spec_from_file_location(
        folder.name, folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    assert spec is not None
    assert spec.loader is not None
    package = importlib.util.module_from_spec(spec)
    sys.modules[folder.name] = package
    spec.loader.exec_module(package)


def _run(folders: str, module: str, arguments: Sequence[str]) -> None:
    """Run a module as `python -m` would."""
    for folder in folders.split(os.pathsep):
        _load(Path(folder))
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    _run(sys.argv[1], sys.argv[2], sys.argv[3:])
