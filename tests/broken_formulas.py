"""Thirty-two formulas, each broken once: the tests must notice.

    python -m tests.broken_formulas            the tests that every commit runs
    python -m tests.broken_formulas --all      all tests, also the slow ones
    python -m tests.broken_formulas 3 17       some of the formulas

Each formula is changed in a copy of the source, and the tests that concern it are played there
until one fails. The program prints the first test that fails for each formula, and ends with
the number of formulas that no test caught.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
_COPIED = ("elastic_env", "baselines", "train", "tests", "configs", "docs", "examples")
_FILES = ("pyproject.toml", "README.md", "CONTRIBUTING.md", "CHANGELOG.md", "Makefile")

JOINT = "elastic_joint elasticity model_file time_step simulation"
COMPENSATION = "compensators contact_torque gravity_torque policies position_compensator"
WALKING = "policy_inputs walking_controller posture zmp_offset published_controllers walk_policies"
PLAN = "preview_control gait walk_plan sway thormang"
STATISTICS = "comparison leaderboard bench robot_scores"


@dataclass(frozen=True)
class BrokenFormula:
    """A change of one formula that makes it wrong.

    Attributes:
        file: Source file.
        right: Text of the formula, which stands there once.
        wrong: What it is replaced by.
        tests: Files of tests that concern it, without `test_` and `.py`.
    """

    file: str
    right: str
    wrong: str
    tests: str


_ELASTICITY = "elastic_env/joint/elasticity.py"
_COMPENSATORS = "baselines/compensation/compensators.py"
_DYNAMIC = "baselines/compensation/dynamic_compensator.py"
_CONTACT = "baselines/compensation/contact_torque.py"
_GRAVITY = "baselines/compensation/gravity_torque.py"
_CONTROLLER = "baselines/walking/controller.py"
_SHARE = "shifted = share - 4.0 * share * (1.0 - share) * shift / spacing"
_PREVIEW = "elastic_env/motion/preview_control.py"
_PLAN = "elastic_env/motion/walk_plan.py"
_TRAJECTORY = "elastic_env/motion/trajectory.py"
_STATISTICS = "train/evaluate/statistics.py"

BROKEN = (
    BrokenFormula(
        _ELASTICITY, "np.abs(deflection) - backlash / 2.0", "np.abs(deflection) - backlash", JOINT
    ),
    BrokenFormula(_ELASTICITY, "wound + damping * deflection_rate", "wound + damping", JOINT),
    BrokenFormula(
        _ELASTICITY, "np.sign(torque) * backlash / 2.0", "np.sign(torque) * backlash", JOINT
    ),
    BrokenFormula(
        "elastic_env/joint/elastic_joint.py",
        "self.torque_limit + self.braking * self.speed_limit",
        "self.torque_limit + self.braking",
        f"{JOINT} sensors testbed",
    ),
    BrokenFormula(
        _ELASTICITY, "matrix = relative_gradient + np.eye(n)", "matrix = np.eye(n)", JOINT
    ),
    BrokenFormula(
        "elastic_env/joint/static_equilibrium.py",
        "K * (q - theta) + torque(q)",
        "K * (q - theta) - torque(q)",
        f"{JOINT} {COMPENSATION}",
    ),
    BrokenFormula(
        "elastic_env/joint/load_continuation.py",
        "q - self.theta + C * self.torque(q)",
        "q - self.theta - C * self.torque(q)",
        f"{JOINT} {COMPENSATION}",
    ),
    BrokenFormula(
        _COMPENSATORS,
        "+ servo_compliance * torque",
        "",
        f"{COMPENSATION} tree_compensation joint_settings arm_references robot",
    ),
    BrokenFormula(
        _COMPENSATORS,
        "return theta - _solve(gravity, theta",
        "return theta + _solve(gravity, theta",
        COMPENSATION,
    ),
    BrokenFormula(_DYNAMIC, "- 0.5 * period_s * theta_dot", "", COMPENSATION),
    BrokenFormula(
        _DYNAMIC,
        "drive.rotor_inertia * theta_ddot + torque[world, i]",
        "torque[world, i]",
        COMPENSATION,
    ),
    BrokenFormula(
        _DYNAMIC,
        "target + math.exp(-period_s / lag_s)",
        "target + (1.0 - period_s / lag_s)",
        COMPENSATION,
    ),
    BrokenFormula(
        "baselines/compensation/dry_friction.py",
        "full = coulomb * np.sign(displacement)",
        "full = -coulomb * np.sign(displacement)",
        COMPENSATION,
    ),
    BrokenFormula(
        "elastic_env/joint/friction.py",
        "1.0 - direction * load_ratio * np.sign(needed)",
        "1.0 - direction * load_ratio",
        "mujoco_friction dry_friction",
    ),
    BrokenFormula(
        "elastic_env/joint/mujoco_friction.py",
        "ends[1] - ends[0]",
        "ends[1]",
        "mujoco_friction",
    ),
    BrokenFormula(
        _COMPENSATORS,
        "self.stiffness, self.stiffness * theta_dot",
        "self.stiffness, theta_dot",
        COMPENSATION,
    ),
    BrokenFormula(
        _GRAVITY,
        "self._b * np.cos(q) - self._a * np.sin(q)",
        "self._b * np.cos(q) + self._a * np.sin(q)",
        f"{COMPENSATION} testbed",
    ),
    BrokenFormula(
        _CONTACT, "gravity * math.sin(pitch),", "-gravity * math.sin(pitch),", COMPENSATION
    ),
    BrokenFormula(
        _CONTACT,
        "-gravity * (cosine * math.sin(roll))",
        "gravity * (cosine * math.sin(roll))",
        COMPENSATION,
    ),
    BrokenFormula(_CONTACT, _SHARE, _SHARE.replace("4.0", "1.0"), f"{COMPENSATION} {WALKING}"),
    BrokenFormula(
        _CONTROLLER, "(1.0 - 2.0 * share) * memory.weight", "share * memory.weight", WALKING
    ),
    BrokenFormula(
        _CONTROLLER,
        "memory.velocity[i] / constants.omega",
        "memory.velocity[i] * constants.omega",
        WALKING,
    ),
    BrokenFormula(
        _CONTROLLER,
        "roll = -load * left",
        "roll = load * left",
        WALKING,
    ),
    BrokenFormula(
        _CONTROLLER,
        "share = obs.load_share if leg == 1 else 1.0 - obs.load_share",
        "share = obs.load_share if leg == 0 else 1.0 - obs.load_share",
        WALKING,
    ),
    BrokenFormula(
        "baselines/walking/zmp_shift.py",
        "np.exp(-omega * period_s)",
        "np.exp(-2.0 * omega * period_s)",
        WALKING,
    ),
    BrokenFormula(_PREVIEW, "-config.com_height_m / config.gravity", "config.com_height_m", PLAN),
    BrokenFormula(_PREVIEW, "np.array([T**3 / 6.0", "np.array([T**3 / 3.0", PLAN),
    BrokenFormula(_PLAN, "np.sqrt(self.gravity / self.com_height)", "np.sqrt(self.gravity)", PLAN),
    BrokenFormula(
        _TRAJECTORY, "samples[2:] - 2.0 * samples[1:-1]", "samples[2:] - samples[1:-1]", PLAN
    ),
    BrokenFormula(_STATISTICS, "np.mean(mine, axis=-1)", "np.median(mine, axis=-1)", STATISTICS),
    BrokenFormula(_STATISTICS, "0.5 * (mine == base)", "(mine == base)", STATISTICS),
    BrokenFormula(
        _STATISTICS, "n - np.maximum(WORST * n, 1.0), n", "0.0 * n, WORST * n", STATISTICS
    ),
)


def main() -> int:
    """Break the formulas one after another; the number of those that no test caught."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("numbers", nargs="*", type=int, help="formulas, from 1; default: all")
    parser.add_argument("--all", action="store_true", help="also the slow tests")
    options = parser.parse_args()
    numbers = options.numbers or range(1, len(BROKEN) + 1)
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in _COPIED:
            shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
        for name in _FILES:
            shutil.copy(ROOT / name, copy / name)
        chosen = [BROKEN[number - 1] for number in numbers]
        needed = list(dict.fromkeys(name for one in chosen for name in one.tests.split()))
        foreign = failures(copy, needed, with_slow=options.all, at_first=False)
        for number, formula in zip(numbers, chosen, strict=True):
            catcher = first_failure(copy, formula, foreign, with_slow=options.all)
            missed += catcher is None
            where = Path(formula.file).name
            print(
                f"{number:3} {where:22} {formula.right[:45]!r:48} {catcher or 'MISSED'}", flush=True
            )
    print(f"{len(numbers) - missed} of {len(numbers)} broken formulas were caught")
    return missed


def first_failure(
    copy: Path, formula: BrokenFormula, foreign: list[str], with_slow: bool
) -> str | None:
    """Name of the first test that fails with the broken formula; None where all pass.

    Args:
        copy: Copy of the source.
        formula: To be broken there.
        foreign: Tests that fail in any copy, as it is not what is installed.
        with_slow: Whether the slow tests count.
    """
    file = copy / formula.file
    text = file.read_text()
    if text.count(formula.right) != 1:
        raise SystemExit(f"{formula.file} must have {formula.right!r} once")
    file.write_text(text.replace(formula.right, formula.wrong))
    try:
        found = failures(copy, formula.tests.split(), foreign, with_slow=with_slow, at_first=True)
    finally:
        file.write_text(text)
    return found[0] if found else None


def failures(
    copy: Path, names: list[str], foreign: Sequence[str] = (), *, with_slow: bool, at_first: bool
) -> list[str]:
    """Tests of some files that fail in a copy; with `at_first` one at most."""
    # a marker in addopts leaves the slow tests out; an empty one takes them all
    options = ["-m", ""] if with_slow else []
    options += ["-x"] if at_first else []
    for name in foreign:
        options += ["--deselect", f"tests/{name}"]
    played = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *options]
        + [f"tests/test_{name}.py" for name in names],
        cwd=copy,
        env={**os.environ, "PYTHONPATH": str(copy)},
        capture_output=True,
        text=True,
    )
    if played.returncode not in (0, 1):
        raise SystemExit(f"pytest ended with {played.returncode}: {played.stdout[-2000:]}")
    pattern = r"^(?:FAILED|ERROR) tests/(.*?)(?: - .*)?$"
    return re.findall(pattern, played.stdout, flags=re.MULTILINE)


if __name__ == "__main__":
    raise SystemExit(main())
