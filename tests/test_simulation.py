"""One world and many against plain MuJoCo: bit for bit, live views, models that differ from
world to world, copies."""

import copy
from pathlib import Path

import mujoco
import numpy as np
import pytest

from elastic_env.core.signals import Array
from elastic_env.world.many_worlds import ManyWorlds, simulate
from elastic_env.world.physics import Simulation
from elastic_env.world.worlds import SingleWorld

# A cart with an elastic pendulum whose ball bounces on the floor; the servo has an integrator, so
# there is an `act`.
ROBOT = """<mujoco>
  <option timestep="0.002" integrator="implicitfast"><flag autoreset="disable"/></option>
  <worldbody>
    <body name="ground" pos="0 0 -0.3895"><geom type="plane" size="1 1 0.1"/></body>
    <body name="cart">
      <joint name="rail" type="slide" axis="1 0 0" damping="2"/>
      <geom size="0.05" mass="2" contype="0"/>
      <body name="motor">
        <joint name="theta" axis="0 1 0" armature="0.01"/><geom size="0.01" mass="0.01" contype="0"/>
      </body>
      <body name="arm">
        <joint name="q" axis="0 1 0" frictionloss="0.02"/>
        <geom size="0.05" pos="0 0 -0.34" mass="1"/><site name="tip" pos="0 0 -0.34"/>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="spring" stiffness="30" damping="0.1">
    <joint joint="theta" coef="1"/><joint joint="q" coef="-1"/></fixed></tendon>
  <actuator><general joint="theta" dyntype="integrator" gainprm="20" biastype="affine" biasprm="0 -20 -1"/></actuator>
  <sensor><framepos objtype="site" objname="tip"/><accelerometer site="tip"/></sensor>
</mujoco>"""
NUM = 3


@pytest.fixture(autouse=True)
def _log_of_mujoco_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo writes its warnings of a divergence into the working directory."""
    monkeypatch.chdir(tmp_path)


def model() -> mujoco.MjModel:
    """The robot."""
    return mujoco.MjModel.from_xml_string(ROBOT)


def worlds(kind: str) -> Simulation:
    """One world or some."""
    return simulate(model(), 1 if kind == "single" else NUM, num_threads=2)


def start(simulation: Simulation) -> None:
    """Another state in every world."""
    n = simulation.num_worlds
    simulation.qpos[:] = 0.3 * np.arange(1, n + 1)[:, None] * [0.5, 1.0, -0.6]
    simulation.qvel[:] = np.arange(1, n + 1)[:, None] * [0.2, -1.0, 0.4]
    simulation.act[:, 0] = 0.1 * np.arange(n)


def act(simulation: Simulation, step: int) -> None:
    """Another command and another push in every world, changing with time."""
    n = np.arange(1, simulation.num_worlds + 1)
    simulation.ctrl[:, 0] = np.sin(0.3 * step * n)
    simulation.bind("xfrc_applied")[:, 4, 0] = np.cos(0.2 * step + n)


def plain(robot: mujoco.MjModel, world: int) -> mujoco.MjData:
    """What MuJoCo alone holds of one world at its start."""
    data = mujoco.MjData(robot)
    number = world + 1
    data.qpos[:] = 0.3 * number * np.array([0.5, 1.0, -0.6])
    data.qvel[:] = number * np.array([0.2, -1.0, 0.4])
    data.act[0] = 0.1 * world
    return data


def drive(
    robot: mujoco.MjModel, data: mujoco.MjData, world: int, steps: int, substeps: int = 4
) -> mujoco.MjData:
    """The same commands and pushes by MuJoCo alone, one physics step after the other."""
    for step in range(steps):
        data.ctrl[0] = np.sin(0.3 * step * (world + 1))
        data.xfrc_applied[4, 0] = np.cos(0.2 * step + world + 1)
        for _ in range(substeps):
            mujoco.mj_step(robot, data)
    return data


def advance(simulation: Simulation, steps: int, substeps: int = 4) -> None:
    """The commands and pushes of `drive`."""
    for step in range(steps):
        act(simulation, step)
        simulation.advance(substeps)


def state(simulation: Simulation) -> list[Array]:
    """Everything that determines the future."""
    fields = ("qpos", "qvel", "act", "ctrl", "qacc_warmstart", "xfrc_applied")
    return [simulation.bind(field).copy() for field in fields]


@pytest.mark.parametrize("kind", ["single", "many"])
def test_every_world_is_mujocos_bit_for_bit(kind: str) -> None:
    """Catches substeps that are left out, commands that come a period late, and worlds that see
    each other."""
    simulation = worlds(kind)
    robot = model()
    views = [simulation.bind("sensordata"), simulation.bind("site_xpos")]
    start(simulation)
    advance(simulation, 60)
    for world in range(simulation.num_worlds):
        data = drive(robot, plain(robot, world), world, 60)
        assert data.time == pytest.approx(0.48)
        for name in ("qpos", "qvel", "act", "ctrl", "qacc_warmstart", "xfrc_applied"):
            np.testing.assert_array_equal(
                simulation.bind(name)[world], getattr(data, name), err_msg=name
            )
        np.testing.assert_array_equal(views[0][world], data.sensordata)
        np.testing.assert_array_equal(views[1][world], data.site_xpos)
        assert np.abs(data.qvel).max() > 0.01


def test_results_do_not_depend_on_threads() -> None:
    """Catches worlds that share a buffer of the pool."""
    results = []
    for threads in (1, 2, 0):
        simulation = ManyWorlds(model(), 17, threads)
        start(simulation)
        advance(simulation, 20)
        results.append(state(simulation))
    for one, two, every in zip(*results, strict=True):
        np.testing.assert_array_equal(one, two)
        np.testing.assert_array_equal(one, every)


def test_one_world_is_stepped_plainly_and_many_by_the_pool() -> None:
    """Catches the slow way for either, and a world that is lost."""
    assert isinstance(simulate(model(), 1), SingleWorld)
    many = simulate(model(), 2)
    assert isinstance(many, ManyWorlds)
    for simulation, number in ((simulate(model(), 1), 1), (many, 2)):
        assert simulation.num_worlds == number
        assert (simulation.qpos.shape, simulation.qvel.shape) == ((number, 3), (number, 3))
        assert (simulation.act.shape, simulation.ctrl.shape) == ((number, 1), (number, 1))
        assert simulation.bind("site_xpos").shape == (number, 1, 3)
        assert simulation.bind("xfrc_applied").shape == (number, 5, 6)
        assert simulation.vary("body_quat").shape == (number, 5, 4)


@pytest.mark.parametrize("kind", ["single", "many"])
@pytest.mark.parametrize("field", ["qpos", "qvel", "act", "ctrl"])
def test_a_bound_state_is_the_state(kind: str, field: str) -> None:
    """Catches copies, whose writes are lost and whose values are old."""
    simulation = worlds(kind)
    view = simulation.bind(field)
    view[0] = 0.25
    np.testing.assert_array_equal(getattr(simulation, field)[0], 0.25)
    start(simulation)
    before = view.copy()
    advance(simulation, 2)
    np.testing.assert_array_equal(view, getattr(simulation, field))
    np.testing.assert_array_equal(view, simulation.bind(field))
    assert not np.array_equal(view, before)


@pytest.mark.parametrize("kind", ["single", "many"])
def test_derived_fields_lag_by_one_physics_step_until_they_are_refreshed(kind: str) -> None:
    """Catches a refresh that moves the world, or one of another stage: the accelerometer needs
    all of them."""
    simulation = worlds(kind)
    robot = model()
    tip, sensors = (simulation.bind(name) for name in ("site_xpos", "sensordata"))
    start(simulation)
    advance(simulation, 10)
    present = state(simulation)
    late = [drive(robot, plain(robot, w), w, 10) for w in range(simulation.num_worlds)]
    np.testing.assert_array_equal(tip[:, 0], [data.site_xpos[0] for data in late])
    lagging = tip.copy()
    simulation.refresh(np.ones(simulation.num_worlds, dtype=bool))
    for data in late:
        mujoco.mj_forward(robot, data)
    np.testing.assert_array_equal(tip[:, 0], [data.site_xpos[0] for data in late])
    np.testing.assert_array_equal(sensors, [data.sensordata for data in late])
    assert (np.abs(tip - lagging).max(axis=(1, 2)) > 1e-5).all()
    names = ("qpos", "qvel", "act", "ctrl")
    for name, old in zip(names, present[:4], strict=True):
        np.testing.assert_array_equal(simulation.bind(name), old, err_msg=name)


def test_only_the_chosen_worlds_are_refreshed() -> None:
    """Catches a mask taken for indices, or ignored."""
    many = worlds("many")
    single = worlds("single")
    for simulation, chosen in ((many, [False, True, False]), (single, [False])):
        tip = simulation.bind("site_xpos")
        simulation.refresh(np.ones(simulation.num_worlds, dtype=bool))
        before = tip.copy()
        simulation.qpos[:] = 0.5
        simulation.refresh(np.array(chosen))
        changed = (tip != before).any(axis=(1, 2))
        np.testing.assert_array_equal(changed, chosen)
        simulation.refresh(np.ones(simulation.num_worlds, dtype=bool))
        assert (tip != before).any(axis=(1, 2)).all()


def of_world(field: str, world: int) -> tuple[int, float | list[float]]:
    """Which entry of a field another world has, and its value: the spring, the slope of the
    floor, the friction."""
    values: dict[str, tuple[int, float | list[float]]] = {
        "tendon_stiffness": (0, 15.0 + 20.0 * world),
        "body_quat": (1, [1.0, 0.0, 0.02 + 0.01 * world, 0.0]),
        "dof_frictionloss": (2, 0.1 + 0.2 * world),
    }
    return values[field]


@pytest.mark.parametrize("kind", ["single", "many"])
@pytest.mark.parametrize("field", ["tendon_stiffness", "body_quat", "dof_frictionloss"])
def test_every_world_can_have_its_own_model(kind: str, field: str) -> None:
    """Catches a variation that all worlds share, that reaches the caller's model, or that a
    restart takes back."""
    robot = model()
    simulation = simulate(robot, 1 if kind == "single" else NUM, num_threads=2)
    before = getattr(robot, field).copy()
    simulation.advance(1)  # also after the physics has begun
    for world in range(simulation.num_worlds):
        entry, value = of_world(field, world)
        simulation.vary(field)[world, entry] = value
    np.testing.assert_array_equal(getattr(robot, field), before)
    for _ in range(2):
        simulation.restart(np.ones(simulation.num_worlds, dtype=bool))
        start(simulation)
        advance(simulation, 40)
        ends = simulation.qpos.copy()
    for world in range(simulation.num_worlds):
        own = model()
        entry, value = of_world(field, world)
        getattr(own, field)[entry] = value
        np.testing.assert_array_equal(ends[world], drive(own, plain(own, world), world, 40).qpos)
        unchanged = drive(robot, plain(robot, world), world, 40).qpos
        assert np.abs(ends[world] - unchanged).max() > 1e-4


@pytest.mark.parametrize("kind", ["single", "many"])
def test_varied_fields_start_from_the_model_and_stay_live(kind: str) -> None:
    """Catches worlds that begin with zeros, and a second call that takes the first one back."""
    simulation = worlds(kind)
    first = simulation.vary("tendon_stiffness")
    np.testing.assert_array_equal(first, np.full((simulation.num_worlds, 1), 30.0))
    first[-1] = 50.0
    assert simulation.vary("dof_damping")[0, 0] == 2.0
    np.testing.assert_array_equal(simulation.vary("tendon_stiffness"), first)
    simulation.vary("tendon_stiffness")[-1] = 70.0
    assert first[-1, 0] == 70.0


@pytest.mark.parametrize("kind", ["single", "many"])
def test_a_copy_continues_as_the_original_and_then_goes_its_own_way(kind: str) -> None:
    """Catches a copy without warm start, pushes or variations, and one that shares any of them."""
    simulation = worlds(kind)
    stiffness = simulation.vary("tendon_stiffness")
    stiffness[:, 0] = 25.0 * np.arange(1, simulation.num_worlds + 1)
    start(simulation)
    advance(simulation, 15)
    twin = copy.deepcopy(simulation)
    for one, other in zip(state(simulation), state(twin), strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(twin.vary("tendon_stiffness"), stiffness)
    for both in (simulation, twin):
        both.advance(8)  # under the same commands and pushes
    for one, other in zip(state(simulation), state(twin), strict=True):
        np.testing.assert_array_equal(one, other)
    kept = state(simulation)
    twin.vary("tendon_stiffness")[:] = 1.0
    twin.ctrl[:] = 0.9
    twin.advance(20)
    for one, old in zip(state(simulation), kept, strict=True):
        np.testing.assert_array_equal(one, old)
    np.testing.assert_array_equal(stiffness[:, 0], 25.0 * np.arange(1, simulation.num_worlds + 1))
    assert not np.array_equal(twin.qpos, simulation.qpos)


@pytest.mark.parametrize("kind", ["single", "many"])
def test_a_restart_is_a_new_world_and_leaves_the_others_alone(kind: str) -> None:
    """Catches a restart of all worlds, and one that leaves warm start, pushes or integrators
    behind."""
    simulation = worlds(kind)
    start(simulation)
    advance(simulation, 10)
    kept = state(simulation)
    simulation.restart(np.zeros(simulation.num_worlds, dtype=bool))
    for one, old in zip(state(simulation), kept, strict=True):
        np.testing.assert_array_equal(one, old)
    chosen = np.arange(simulation.num_worlds) == simulation.num_worlds - 1
    simulation.restart(chosen)
    for one, old in zip(state(simulation), kept, strict=True):
        np.testing.assert_array_equal(one[~chosen], old[~chosen])
        np.testing.assert_array_equal(one[chosen], np.zeros_like(one[chosen]))
    assert all(np.abs(old).max() > 0.0 for old in kept)


@pytest.mark.parametrize("kind", ["single", "many"])
def test_a_bad_number_is_noticed_in_its_world_until_the_restart(kind: str) -> None:
    """Catches MuJoCo's silent reset of a world, and a warning that sticks or is forgotten by a
    copy."""
    simulation = worlds(kind)
    start(simulation)
    simulation.advance(3)
    none = np.zeros(simulation.num_worlds, dtype=bool)
    bad = np.arange(simulation.num_worlds) == 0
    np.testing.assert_array_equal(simulation.divergence(), none)
    simulation.qvel[0, 0] = np.nan
    simulation.advance(3)
    np.testing.assert_array_equal(simulation.divergence(), bad)
    np.testing.assert_array_equal(copy.deepcopy(simulation).divergence(), bad)
    simulation.advance(3)
    np.testing.assert_array_equal(simulation.divergence(), bad)
    simulation.restart(bad)
    simulation.advance(3)
    np.testing.assert_array_equal(simulation.divergence(), none)
    assert np.isfinite(simulation.qpos).all()
