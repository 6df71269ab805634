"""Compensators as headers in C99: equal to Python for random states, without heap and warnings."""

import math
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from baselines import PositionCompensator
from elastic_env.core.errors import ActionError, ConfigurationError, ElasticError
from elastic_env.core.signals import Array
from elastic_env.joint.motor import Motor
from tests.benchmarks.test_arm import arm as seven_joints
from tests.test_position_compensator import ARM, JOINTS, URDF
from tests.trees import ORDER, TREE
from train.commands.cli import main
from train.export.c_arm import c_header, payload_frames
from train.export.c_text import c_example

# poses beyond limits are meant
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
STRICT = "-std=c99 -O1 -Wall -Wextra -Wpedantic -Werror -fsanitize=undefined"
CHECKED = f"{STRICT} -fno-sanitize-recover=undefined"
QUICKLY = CHECKED.replace("-O1", "-O0")
"""As strict, and compiled in half the time."""
RELEASED = "-std=c99 -O3 -Wall -Wextra -Wpedantic -Wconversion -Wshadow -Werror"
AS_RELEASED = [
    pytest.param(RELEASED.replace("-O3", "-O0"), id="quickly"),
    pytest.param(RELEASED, id="released", marks=pytest.mark.slow),
]
"""With all warnings on every commit, and optimized at night."""
COMPILERS = {"gcc": ["gcc"]}
if shutil.which("clang"):
    COMPILERS["clang"] = ["clang"]
if find_spec("ziglang"):
    COMPILERS["zig"] = [sys.executable, "-m", "ziglang", "cc"]
TOLERANCE = 1e-12
# of records: whether there is a payload, frame, mass, place; whether there are rates
HEAD = 7
DRIVER = r"""
#include "arm.h"
#include <stdio.h>

int main(int count, char **paths) {
    double in[7 + 4 * ARM_JOINTS], out[2 + 4 * ARM_JOINTS];
    FILE *from = fopen(paths[1], "rb"), *to = fopen(paths[2], "wb");
    arm_state arm;
    arm_begin(&arm);
    while (count == 3 && fread(in, sizeof in, 1, from) == 1) {
        const double *q = in + 7;
        const double *rates = in[6] > 0.0 ? q + ARM_JOINTS : 0;
        const double *accelerations = in[6] > 0.0 ? q + 2 * ARM_JOINTS : 0;
        double *command = out + 1, *clipped = command + ARM_JOINTS;
        double *torque = clipped + ARM_JOINTS, *link = torque + ARM_JOINTS + 1;
        int k;
        for (k = 0; k < 2 + 4 * ARM_JOINTS; k++) out[k] = 0.0;
        if (in[0] > 0.0) arm_set_payload(&arm, (arm_frame)in[1], in[2], in + 3);
        arm_torque(&arm, q, rates, accelerations, torque);
        out[0] = arm_command(&arm, q, rates, accelerations, command);
        for (k = 0; k < ARM_JOINTS; k++) clipped[k] = arm.clipped[k];
        link[-1] = arm_link_angle(&arm, q + 3 * ARM_JOINTS, link);
        fwrite(out, sizeof out, 1, to);
    }
    fclose(from);
    return fclose(to);
}
"""
FRICTION: dict[str, Any] = {
    "coulomb_friction": 0.4,
    "load_friction": 0.3,
    "static_friction": 0.2,
    "stribeck_speed": 0.1,
    "viscous_friction": 0.5,
}
MOTOR = Motor(torque_constant=2.0, back_emf=2.0, resistance=1.5, voltage=24.0)
SERVO: dict[str, Any] = {"position_gain": 900.0, "velocity_gain": 3.0, "motor": MOTOR}
UPRIGHT = """<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
  <body pos="0 0 1"><joint name="shoulder" axis="0 1 0"/>
  <inertial mass="1" pos="0 0 0.25" diaginertia="0.01 0.01 0.01"/>
  <body name="hand" pos="0 0 0.5"><joint name="wrist" axis="0 1 0" range="-3 3"/>
  <inertial mass="0.5" pos="0 0 0.2" diaginertia="0.01 0.01 0.01"/></body></body>
</worldbody></mujoco>"""


def tree() -> PositionCompensator:
    """Branches, references and tilted gravity; a rigid joint, and servos that give way."""
    stiffness = {"*": 900.0, "twist": math.inf, "elbow": 300.0}
    model = mujoco.MjModel.from_xml_string(TREE)
    return PositionCompensator(model, stiffness, joints=ORDER, position_gain=2500.0)


def springs() -> PositionCompensator:
    """Springs of joints, gravity compensation, a held gripper, ranges, a ramp."""
    stiffness = {"*": 400.0, "shoulder": 900.0}
    model = mujoco.MjModel.from_xml_string(ARM)
    limits = {"limit_rad": 0.03, "ramp_s": 0.25, "period_s": 0.01}
    return PositionCompensator(model, stiffness, joints=JOINTS, **limits)


def seven() -> PositionCompensator:
    """Seven joints whose friction varies, and servos that lag."""
    joint = {"stiffness": 1000.0, "servo": SERVO, **FRICTION}
    return PositionCompensator(seven_joints(), {"*": joint}, ramp_s=0.1, period_s=0.005)


def soft() -> PositionCompensator:
    """Upright on springs that bend far, tip over, or leave several equilibria."""
    model = mujoco.MjModel.from_xml_string(UPRIGHT)
    return PositionCompensator(model, {"shoulder": 1.0, "wrist": 0.5}, limit_rad=1.0)


ROBOTS = {robot.__name__: robot for robot in (tree, springs, seven, soft)}
Robot = Callable[[], PositionCompensator]


def records(compensator: PositionCompensator, count: int, seed: int = 0) -> Array:
    """Random states and payloads; a twentieth is not finite."""
    n = len(compensator.joints)
    generator = np.random.default_rng(seed)
    found = np.zeros((count, HEAD + 4 * n))
    found[:, 0] = generator.random(count) < 0.1
    found[:, 1] = generator.integers(0, len(payload_frames(compensator.constants)), count)
    found[:, 2] = generator.uniform(0.0, 0.2, count) * generator.integers(0, 2, count)
    found[:, 3:6] = generator.uniform(-0.1, 0.1, (count, 3))
    found[:, 6] = generator.random(count) < 0.6
    found[:, HEAD:] = generator.uniform(-2.0, 2.0, (count, 4 * n))
    found[:, HEAD + 3 * n :] *= 2.0  # beyond ranges, and to where soft springs tip over
    small = generator.random(count) < 0.3  # motion within and about the dead zone of friction
    steps = generator.normal(0.0, 2e-3, (count, n))
    for k in np.flatnonzero(small[1:]) + 1:
        found[k, HEAD : HEAD + n] = found[k - 1, HEAD : HEAD + n] + steps[k]
    bad = np.flatnonzero(generator.random(count) < 0.05)
    wrong = generator.choice([np.nan, np.inf, -np.inf], len(bad))
    found[bad, generator.integers(HEAD, found.shape[1], len(bad))] = wrong
    return found


def played(compensator: PositionCompensator, states: Array) -> Array:
    """What Python makes of records."""
    n = len(compensator.joints)
    model = compensator.constants.model
    names = {}
    for i, frame in enumerate(payload_frames(compensator.constants)):
        kind, _, own = frame.name.partition("_")
        sites = [model.site(s).name for s in range(model.nsite)]
        bodies = [model.body(b).name for b in range(model.nbody)]
        known = sites if kind == "SITE" else bodies
        ends = {re.sub(r"\W", "_", name).upper(): name for name in known if name}
        names[i] = None if kind == "TIP" else ends[own]
    rows = np.zeros((len(states), 2 + 4 * n))
    compensator.reset()
    for row, state in zip(rows, states, strict=True):
        q, q_dot, q_ddot, theta = state[HEAD:].reshape(4, n)
        rates = (q_dot, q_ddot) if state[6] else ()
        if state[0]:
            compensator.set_payload(state[2], state[3:6], names[int(state[1])])
        row[0] = row[1 + 3 * n] = 1
        try:
            row[1 + 2 * n : 1 + 3 * n] = compensator.torque(q, *rates)
            row[1 : 1 + n] = compensator.command(q, *rates)
            row[0] = 0
        except ActionError:
            pass
        row[1 + n : 1 + 2 * n] = compensator.clipped
        try:
            row[2 + 3 * n :] = compensator.link_angle(theta)
            row[1 + 3 * n] = 0
        except ActionError:
            continue
        except ElasticError as error:
            row[1 + 3 * n] = 3 if "tips over" in str(error) else 4
    return rows


def compiled(
    folder: Path, header: str, compiler: str, program: str = DRIVER, options: str = CHECKED
) -> Path:
    """A program with the header, compiled strictly."""
    assert shutil.which("gcc"), "no gcc: apt-get install gcc libc6-dev"
    (folder / "arm.h").write_text(header)
    (folder / "driver.c").write_text(program)
    made = folder / f"driver_{compiler}"
    arguments = [*COMPILERS[compiler], *options.split(), "driver.c", "-o", str(made), "-lm"]
    done = subprocess.run(arguments, cwd=folder, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return made


def compare(robot: Robot, count: int, compiler: str, folder: Path, options: str = CHECKED) -> Array:
    """Play records in C and in Python, and compare; what Python has made of them."""
    compensator = robot()
    header = c_header(compensator, "arm")
    program = compiled(folder, header, compiler, options=options)
    states = records(compensator, count)
    states.tofile(folder / "in")
    subprocess.run([program, "in", "out"], cwd=folder, check=True, timeout=300)
    expected = played(compensator, states)
    found = np.fromfile(folder / "out").reshape(expected.shape)
    np.testing.assert_allclose(found, expected, rtol=TOLERANCE, atol=TOLERANCE)
    return expected


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("name", ROBOTS)
def test_the_header_computes_what_python_does(name: str, compiler: str, tmp_path: Path) -> None:
    """Catches a wrong formula, parent, sign or order of joints, a payload that is taken over
    otherwise, a state that a bad call has changed, and another iteration."""
    # those of soft springs take Python long
    count = 100 if name == "soft" else 200
    expected = compare(ROBOTS[name], count, compiler, tmp_path, QUICKLY)
    n = (expected.shape[1] - 2) // 4
    assert set(expected[:, 0]) == {0.0, 1.0}
    assert (expected[:, 1 : 1 + n] != 0.0).any(axis=0).all()
    if name == "soft":
        assert set(expected[:, 1 + 3 * n]) == {0.0, 1.0, 3.0, 4.0}
    if name == "springs":
        assert expected[:, 1 + n : 1 + 2 * n].any()


@pytest.mark.slow
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("name", ROBOTS)
def test_the_header_computes_what_python_does_in_ten_thousand_states(
    name: str, compiler: str, tmp_path: Path
) -> None:
    compare(ROBOTS[name], 10_000 if name != "soft" else 2_000, compiler, tmp_path)


MATHEMATICS = {"sincos", "sin", "cos", "exp", "sqrt", "tanh", "tanhf", "fmin", "fmax"}
COPIES = {"memcpy", "memset"}  # gcc calls them where a struct is copied


def require_no_library(folder: Path, header: str, function: str) -> None:
    """Check that a function of a header calls nothing but mathematics: no malloc."""
    (folder / "arm.h").write_text(header)
    (folder / "all.c").write_text(f'#include "arm.h"\n{function}')
    subprocess.run(["gcc", "-std=c99", "-Os", "-c", "all.c"], cwd=folder, check=True)
    listed = ["nm", "-u", "all.o"]
    found = subprocess.run(listed, cwd=folder, capture_output=True, text=True, check=True)
    needed = {line.split()[-1] for line in found.stdout.splitlines()}
    assert needed <= MATHEMATICS | COPIES


def test_it_needs_no_heap_and_nothing_but_mathematics(tmp_path: Path) -> None:
    """Catches a call of malloc, and of what a controller does not have."""
    function = """int all(arm_state *arm, double *q) {
        arm_begin(arm);
        return arm_set_payload(arm, ARM_TIP, 1.0, q) || arm_command(arm, q, q, q, q)
            || arm_torque(arm, q, q, q, q) || arm_link_angle(arm, q, q);
    }"""
    require_no_library(tmp_path, c_header(seven(), "arm"), function)


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.slow
def test_two_robots_fit_in_one_program_that_checks_them(compiler: str, tmp_path: Path) -> None:
    """Catches a name without the prefix, and a test vector that is not of the compensator."""
    names = {"left": tree, "right_2": seven}
    headers = {name: c_header(robot(), name) for name, robot in names.items()}
    (tmp_path / "right_2.h").write_text(headers["right_2"])
    program = """#define LEFT_TEST
        #define RIGHT_2_TEST
        #include "arm.h"
        #include "right_2.h"
        int main(void) { return !(left_test() < 1e-12 && right_2_test() < 1e-12); }"""
    subprocess.run([compiled(tmp_path, headers["left"], compiler, program)], check=True)
    table = re.search(r"left_compliance_\[LEFT_JOINTS\] = {([^,]*),", headers["left"])
    assert table is not None
    wrong = headers["left"].replace(table[1], f"{1.001 * float(table[1])!r}", 1)
    assert wrong != headers["left"]
    done = subprocess.run([compiled(tmp_path, wrong, compiler, program)])
    assert done.returncode == 1


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("options", AS_RELEASED)
def test_the_example_checks_and_times_the_header(
    options: str, compiler: str, tmp_path: Path
) -> None:
    """Catches an example that does not compile, and one for another header."""
    (tmp_path / "robot.h").write_text(header := c_header(springs(), "arm"))
    made = c_example("arm", "arm", "robot.h")
    assert "add_executable(arm_main arm_main.c)" in made["CMakeLists.txt"]
    program = compiled(tmp_path, header, compiler, made["arm_main.c"], options)
    said = subprocess.run([program], capture_output=True, text=True, check=True).stdout
    assert said.startswith("largest deviation from Python: 0 rad")
    assert "us per command" in said


@pytest.mark.parametrize("compiler", COMPILERS)
def test_names_of_a_model_do_no_harm_in_c(compiler: str, tmp_path: Path) -> None:
    """Catches a name that ends a comment, one in another alphabet, and two that become one."""
    names = ["*/ int x;", "a-b", "a_b", "π??/"]
    spec = mujoco.MjSpec()
    body = spec.worldbody
    for name in names:
        body = body.add_body(name=name, pos=[0, 0, 0.2], mass=1.0, inertia=[0.01] * 3)
        body.explicitinertial = True
        body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
        body.add_site(name=f"{name} site")
    header = c_header(PositionCompensator(spec.compile(), 400.0), "arm", {"*/ a": b""})
    assert header.isascii()
    assert {"ARM_JOINT_A_B", "ARM_JOINT_A_B_2", "ARM_SITE_A_B_SITE_2"} <= set(
        re.findall(r"\w+", header)
    )
    compiled(tmp_path, header, compiler, '#include "arm.h"\nint main(void) { return 0; }')


def test_the_command_writes_header_and_example(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches an option that is lost on the way, and a file that is replaced unasked."""
    monkeypatch.chdir(tmp_path)
    Path("my arm.urdf").write_text(URDF)
    Path("joints.yaml").write_text("shoulder: {stiffness: 300, servo: {position_gain: 800}}")
    arguments = ["export", "c", "my arm.urdf", "--joints", "joints.yaml"]
    main([*arguments, "--ramp-s", "0.5", "--limit-rad", "0.3", "--example"])
    header = Path("my_arm.h").read_text()
    assert "k_p 800 N*m/rad" in header
    assert "MY_ARM_RAMP_STEPS = 50" in header
    assert "joints.yaml, SHA-256" in header
    example = Path("my_arm_example/my_arm_main.c").read_text()
    assert '#include "../my_arm.h"' in example
    assert Path("my_arm_example/CMakeLists.txt").exists()
    assert not Path("CMakeLists.txt").exists()
    main([*arguments, "--order", "elbow", "shoulder", "--prefix", "so101", "-o", "b.h"])
    assert "SO101_JOINT_ELBOW,\n    SO101_JOINT_SHOULDER\n" in Path("b.h").read_text()
    assert "held" not in capsys.readouterr().out
    main([*arguments[:3], "--joints", "300", "--order", "elbow", "-o", "c.h"])
    for text in (capsys.readouterr().out, Path("c.h").read_text()):
        assert "not commanded, taken as held: shoulder at 0 rad" in text
    for wrong, said in (
        ([*arguments], "my_arm.h exists; add --overwrite"),
        ([*arguments, "--prefix", "3d"], "prefix must be a letter"),
        ([*arguments, "-o", "no/arm.h"], "no folder no;"),
        (["export", "c", "no.urdf", "--joints", "300"], "no model at no.urdf"),
        (["export", "c", "foothold"], "can: input_output, adaptive_posture, residual:PATH"),
        ([*arguments[:3], "--joints", "-3"], "stiffness"),
        ([*arguments, "--order", "hip"], "hip"),
    ):
        with pytest.raises(SystemExit):
            main(wrong)
        error = capsys.readouterr().err
        assert error.startswith("error: ")
        assert said in error
        assert "Traceback" not in error
    main([*arguments, "--overwrite"])
    assert "RAMP_STEPS = 0" in Path("my_arm.h").read_text()


def test_a_prefix_is_an_identifier() -> None:
    for wrong in ("", "_arm", "3d", "my-arm", "a" * 41, "é"):
        with pytest.raises(ConfigurationError, match="prefix must be a letter"):
            c_header(tree(), wrong)
