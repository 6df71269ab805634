"""A walker in the mirror: against the walk's own symmetry, and what residuals see against what
they would see there."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
from baselines.residual.correction import Corrected
from baselines.residual.features import Features
from baselines.residual.mirror import Mirror
from baselines.residual.settings import ResidualSettings
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, SignalTable
from elastic_env.world.robot_model import WalkerModel

MODEL_SPACE: dict[str, Any] = {"shared": True, "decision_period": 1}


def walker(**options: Any) -> gymnasium.Env[Any, Any]:
    """A fast walk of four steps."""
    options = {"scenario": "ideal", "step_period": [0.3, 0.4, 0.3], "num_steps": 4, **options}
    return gymnasium.make("elastic_env/WalkInPlace-v0", **options)


def walked(env: gymnasium.Env[Any, Any]) -> Array:
    """Observations of a whole walk on `input_output`."""
    policy = baselines.make("input_output", env)
    observation, _ = env.reset(seed=1)
    seen = [observation]
    state = None
    ended = False
    while not ended:
        action, state = policy.predict(observation, state)
        observation, _, terminated, truncated, _ = env.step(action)
        seen.append(observation)
        ended = terminated or truncated
    return np.array(seen)


def features_of(
    env: gymnasium.Env[Any, Any], rows: Array, **settings: Any
) -> tuple[Features, Array]:
    """What a residual sees at every observation of a walk."""
    model: Any = env.unwrapped
    corrected = Corrected(
        baselines.make("input_output", env),
        model.assumed_model,
        ResidualSettings(**{**MODEL_SPACE, **settings}),
    )
    features = Features(corrected)
    memory = None
    seen = []
    for i, row in enumerate(rows):
        values, memory = features.at(
            row[None], memory, np.array([i == 0]), None, np.ones(1, np.bool_)
        )
        seen.append(values[0])
    return features, np.array(seen)


def model_of(env: Any) -> WalkerModel:
    """What is assumed of the walker."""
    return env.unwrapped.assumed_model


@pytest.fixture(scope="module")
def walk() -> tuple[gymnasium.Env[Any, Any], Array]:
    """A walk in `ideal` and its observations."""
    env = walker()
    return env, walked(env)


def test_a_step_on_the_right_foot_is_one_on_the_left_in_the_mirror(walk: tuple[Any, Array]) -> None:
    """Catches a wrong sign or side of any signal: every one of them comes closer with its sign
    than with the other."""
    env, rows = walk
    table = model_of(env).observation_table
    support = rows[:, table.columns("clock.support")][:, 0]
    first, second, third = np.flatnonzero(np.diff(support))[:3] + 1
    assert second - first == third - second  # equally long
    one = rows[first:second]
    other = Mirror(table.signals)(rows[second:third])
    planned = [
        name
        for name in table.names
        if name.split(".")[0] in {"reference_angle", "load_share", "zmp_reference"}
    ]
    columns = np.array([table.names.index(name) for name in planned])
    assert np.ptp(one[:, columns], axis=0).max() > 0.1
    np.testing.assert_allclose(other[:, columns], one[:, columns], atol=2e-3)
    signed = np.array([name not in {"clock.support", "load_share"} for name in table.names])
    error, opposite = (np.square(one - sign * other).mean(axis=0)[signed] for sign in (1.0, -1.0))
    moving = opposite > 0.0
    assert moving.sum() > 0.9 * signed.sum()
    wrong = np.array(table.names)[signed][moving & (error >= opposite)]
    assert wrong.size == 0, wrong


def test_what_a_residual_sees_of_a_mirrored_walk_is_the_mirror_image() -> None:
    """Catches a feature whose sign or side in the mirror is wrong, on a robot whose joints
    differ from each other."""
    env = walker(scenario="spread", num_steps=1)
    model = model_of(env)
    rows = walked(env)[::40]
    observe = ("observation", "encoder_error", "contact_error", "level", "bending", "base_action")
    features, seen = features_of(env, rows, observe=observe)
    _, reflected = features_of(env, Mirror(model.observation_table.signals)(rows), observe=observe)
    expected = Mirror(features.signals)(seen)
    assert (
        np.abs(reflected - seen).max(axis=0).astype(bool).mean() > 0.6
    )  # not by leaving all as it is
    bound = 1e-6 * (1.0 + np.abs(seen).max(axis=0))  # commands are float32
    assert (np.abs(reflected - expected) <= bound).all(), np.array(features.signals)[
        (np.abs(reflected - expected) > bound).any(axis=0)
    ]


def test_residuals_see_the_mirror_image_while_the_right_foot_is_that_of_the_step(
    walk: tuple[Any, Array],
) -> None:
    """Catches a mirror at the other steps, or of the present but not of the earlier
    measurements."""
    env = walk[0]
    model = model_of(env)
    rows = walk[1][::50]
    settings: dict[str, Any] = {
        "observe": ("clock", "encoder_angle", "wrench", "bending"),
        "history": 2,
    }
    features, plain = features_of(env, rows, **settings)
    _, seen = features_of(env, rows, **settings, mirror=True)
    right = rows[:, model.observation_table.columns("clock.support")][:, 0] == 1.0
    assert 5 < right.sum() < len(rows) - 5
    np.testing.assert_array_equal(seen[~right], plain[~right])
    np.testing.assert_array_equal(
        seen[:, SignalTable(features.signals).names.index("clock.support")], 0.0
    )
    width = len(features.signals)
    np.testing.assert_array_equal(
        seen[right, :width], Mirror(features.signals)(plain[right, :width])
    )
    measured = [
        one for one in features.signals if one.name.startswith(("encoder_angle.", "wrench."))
    ]
    earlier = plain[right, width:].reshape(right.sum(), 2, len(measured))
    expected = Mirror(measured)(earlier).reshape(right.sum(), -1)
    np.testing.assert_array_equal(seen[right, width:], expected)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"observe": ("wrench.l_fx",)}, "no wrench.r_fx; observe both"),
        ({"joints": ("l_knee",)}, "differ for l_knee; name joints without"),
        ({"acts_on": {"deflection": {"l_knee": 0.2, "r_knee": 0.6}}}, "differ for l_knee"),
    ],
)
def test_what_has_no_mirror_image_is_refused(settings: dict[str, Any], message: str) -> None:
    """Catches corrections that would go to the wrong leg, and half of a pair."""
    with pytest.raises(ConfigurationError, match=message):
        features_of(walker(), np.zeros((0, 1)), **settings, mirror=True)


def test_the_testbed_has_no_mirror_image() -> None:
    """Catches an error that does not say what is wrong."""
    env: Any = gymnasium.make("elastic_env/Testbed-v0")
    settings = ResidualSettings(shared=True, mirror=True)
    with pytest.raises(ConfigurationError, match="a RobotModel; set mirror: false"):
        Features(Corrected(baselines.make("input", env), env.unwrapped.assumed_model, settings))
