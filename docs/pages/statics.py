"""Tables of the docs that no comparison plays: identifications, Eq. 12 against Eq. 10, and gravity
torques of a stance.

`python -m docs.pages.statics [CHECKOUT]` writes them into docs/results of a checkout, in some
minutes.
"""

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import elastic_env  # noqa: F401  registers the environments
from baselines.compensation.compensators import newton_link_angle, taylor_link_angle
from baselines.compensation.gravity_torque import make_gravity
from baselines.identification.identify import Identification, identify
from elastic_env.core.signals import Array
from elastic_env.motion.gait import Gait
from elastic_env.motion.references import Hold
from elastic_env.rigid.floating_body import FloatingBody
from elastic_env.robots.thormang.model import ANKLE_HEIGHT_M, LEG_JOINTS
from elastic_env.world.robot_model import WalkerModel
from train.runs.escaping import write_records

_MODULE = "vector_entry_point"
IDENTIFIED: Sequence[dict[str, Any]] = (
    *({"scenario": "ideal", "stiffness": k} for k in (300.0, 1001.0, 3000.0)),
    {"scenario": "nominal", "seeds": 100},
    {"scenario": "backlash", "seeds": 20},
    *({"damping": damping} for damping in (5.0, 10.0, 20.0, 50.0)),
)
"""Joints that are identified: scenario, true K, damping, seeds of the sensor noise."""
_JOINTS = ("hip_roll", "ankle_roll", "knee")
_LIFT_M = 0.05
_INWARD_M = 0.02


def identification(
    scenario: str = "nominal", stiffness: float = 1001.0, damping: float = 10.0, seeds: int = 1
) -> dict[str, Any]:
    """The static experiment with some seeds of the sensor noise, as a row of
    `identification.csv`.
    """
    env = gymnasium.make_vec(
        "elastic_env/Testbed-v0",
        num_envs=seeds,
        vectorization_mode=_MODULE,
        reference="hold",
        scenario=scenario,
        stiffness=stiffness,
        joint={"damping": damping},
    )
    try:
        found, _ = identify([env], 0)
    finally:
        env.close()
    place = {
        "scenario": scenario,
        "stiffness_nm_per_rad": stiffness,
        "damping_nms_per_rad": damping,
        "seeds": seeds,
    }
    return {**place, **_spread(found, stiffness)}


def _spread(found: Sequence[Identification], truth: float) -> dict[str, Any]:
    stiffness = np.array([each.stiffness_nm_per_rad for each in found])
    medians = {
        name: float(np.median([getattr(each, name) for each in found]))
        for name in ("line_stiffness_nm_per_rad", "friction_nm", "dead_band_rad", "pearson_r")
    }
    return {
        "identified_median": float(np.median(stiffness)),
        "identified_min": float(stiffness.min()),
        "identified_max": float(stiffness.max()),
        **medians,
        "covered": sum(
            e.stiffness_low_nm_per_rad <= truth <= e.stiffness_high_nm_per_rad for e in found
        ),
        "half_width_most": max(each.half_width for each in found),
    }


def output_compensators() -> Iterator[dict[str, Any]]:
    """Eq. 12 against Newton's method on Eq. 10 at the static positions, rows of
    `output_compensator.csv`.
    """
    env: Any = gymnasium.make("elastic_env/Testbed-v0", scenario="ideal")
    gravity = make_gravity(env.unwrapped.assumed_model)
    hold = Hold()
    sine = np.linspace(hold.lower, hold.upper, hold.positions)
    q = np.arcsin(sine)[:, None]
    for stiffness in (3000.0, 1001.0, 300.0):
        K = np.array([stiffness])
        deflection = gravity.gravity_torque(q) / K
        theta = q + deflection
        newton = newton_link_angle(theta, K, gravity)
        taylor = taylor_link_angle(theta, K, gravity)
        error = np.abs(taylor - newton)
        residual = np.abs(theta - newton - gravity.gravity_torque(newton) / K)
        yield {
            "stiffness_nm_per_rad": stiffness,
            "deflection_peak_rad": float(np.abs(deflection).max()),
            "error_rms_rad": float(np.sqrt(np.mean(error**2))),
            "error_peak_rad": float(error.max()),
            "newton_residual_rad": float(residual.max()),
        }
    env.close()


def stance_torques() -> Iterator[dict[str, Any]]:
    """Gravity torque of the left leg on one foot by each reading of Eq. 4, rows of
    `gravity_torque.csv`.
    """
    env: Any = gymnasium.make("elastic_env/WalkInPlace-v0", scenario="ideal")
    model = env.unwrapped.assumed_model
    for method in ("com", "ankle", "lumped"):
        row: dict[str, Any] = {"method": method}
        for inward, place in ((0.0, "ankle"), (_INWARD_M, "inward")):
            zmp = model.biped.footholds[0] - [0.0, inward]
            observation = np.zeros((1, len(model.observation_table)))
            observation[:, model.observation_table.group("zmp_reference")] = zmp
            torque = (
                make_gravity(model, method)
                .at(observation)
                .gravity_torque(_stance(model, zmp)[None])[0]
            )
            row |= {
                f"{place}_{name}_nm": float(torque[LEG_JOINTS.index(f"l_{name}")])
                for name in _JOINTS
            }
        yield row
    env.close()


def _stance(model: WalkerModel, zmp: Array) -> Array:
    """Joint angles of the posture of Fig. 1 with the center of mass over the ZMP, (12,) [rad]."""
    biped = model.biped
    ankles = np.column_stack([biped.footholds, ANKLE_HEIGHT_M + np.array([0.0, _LIFT_M])])
    body = FloatingBody(biped.rigid, LEG_JOINTS)
    pelvis = np.array([*zmp, Gait().hip_height_m])
    for _ in range(60):
        center = body.center_of_mass(biped.joint_angles(pelvis, ankles)[None])[0]
        pelvis[:2] += zmp - pelvis[:2] - center[:2]
    return biped.joint_angles(pelvis, ankles)


def main(arguments: Sequence[str]) -> None:
    """Write the tables: [CHECKOUT], by default the working directory."""
    results = Path(*arguments) / "docs" / "results"
    for name, rows in (
        ("gravity_torque", stance_torques()),
        ("output_compensator", output_compensators()),
        ("identification", (identification(**each) for each in IDENTIFIED)),
    ):
        rounded = [
            {key: f"{v:.5g}" if isinstance(v, float) else v for key, v in row.items()}
            for row in rows
        ]
        print(f"wrote {write_records(rounded, results / f'{name}.csv')}")


if __name__ == "__main__":
    main(sys.argv[1:])
