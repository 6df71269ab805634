"""Picture of the walker: tilt and shift of the pelvis are enlarged, the feet stay to scale.

Relative to the feet the pelvis is drawn at planned + factor · (true − planned), in position and
attitude. The feet, the ZMP and its reference are drawn to scale. So the robot stands on the floor,
and the ZMP has its true place under the soles. The legs connect pelvis and feet. This enlarges the
link errors of the supporting leg to first order by the same factor. The factor decreases, down to
one, where the legs cannot reach the feet: a fall is drawn without enlargement. The translucent
robot is the plan. Camera and light follow its feet.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from elastic_env.core.quaternions import quaternion_of
from elastic_env.core.signals import Array
from elastic_env.motion.gait import LEFT
from elastic_env.motion.walk_plan import WalkPlan
from elastic_env.rendering.picture import CAMERA, Picture
from elastic_env.rendering.side_by_side import DisplayRobot, Sides
from elastic_env.rigid.biped import Biped
from elastic_env.rigid.contact_force import shares
from elastic_env.rigid.leg_kinematics import foot_pose, leg_angles, rotation_z
from elastic_env.robots.thormang import humanoid
from elastic_env.robots.thormang.humanoid import PLAN, ZMP, ZMP_REFERENCE
from elastic_env.robots.thormang.model import LEG_JOINTS
from elastic_env.robots.thormang.records import WalkTruth
from elastic_env.robots.thormang.task import WalkTask
from elastic_env.robots.thormang.walk_signals import FELL

LARGEST_FACTOR = 3.0
"""Factor of the deviations of the pelvis, as far as the legs reach."""

_NUM_FACTORS = 81
_ROBOT_DISTANCE_M = (0.0, 0.8, 0.0)
_REACH_SHARE = 1.0 - 1e-9
_BELOW_THE_FLOOR = (0.0, 0.0, -1.0)
_LEGEND = (
    ("left", humanoid.LEFT_RGBA),
    ("right", humanoid.RIGHT_RGBA),
    ("plan", (0.35, 0.66, 0.45, 1.0)),
    ("ZMP", humanoid.ZMP_RGBA),
    ("ZMP reference", humanoid.ZMP_REFERENCE_RGBA),
    (f"grid {humanoid.GRID_M:g} m", (0.55, 0.57, 0.60, 1.0)),
)


@dataclass(frozen=True)
class Posture:
    """Poses of pelvis and feet in the world frame.

    Attributes:
        pelvis, R: Position [m] and orientation of the pelvis, (3,), (3, 3).
        ankles, feet_R: Positions of the ankles [m] and orientations of the feet, left and right,
            (2, 3), (2, 3, 3).
    """

    pelvis: Array
    R: Array
    ankles: Array
    feet_R: Array

    @classmethod
    def from_truth(cls, truth: WalkTruth, world: int = 0) -> "Posture":
        """Return the true posture of a world."""
        R = truth.pelvis_R[world]
        feet_R = R @ foot_pose(truth.model.biped.leg, truth.q[world].reshape(2, -1))[1]
        return cls(truth.pelvis[world], R, truth.ankles[world], feet_R)

    @classmethod
    def from_plan(cls, plan: WalkPlan, row: int) -> "Posture":
        """Return the planned posture at a row of the plan, with pelvis and feet level."""
        R = rotation_z(plan.heading[row])
        feet_R = rotation_z(plan.foot_yaw[row])
        return cls(plan.pelvis[row], R, plan.ankles[row], feet_R)

    def joint_angles(self, robot: Biped) -> Array:
        """Joint angles of the posture, (12,) [rad]; a leg out of reach of its foot is straight."""
        legs = hip_to_ankle(robot, self.pelvis, self.R, self.ankles)
        reach = _REACH_SHARE * robot.leg.reach
        stretch = np.linalg.norm(legs, axis=-1, keepdims=True) / reach
        within = legs / np.maximum(stretch, 1.0)
        return leg_angles(robot.leg, within, self.R.T @ self.feet_R).ravel()


def hip_to_ankle(robot: Biped, pelvis: Array, R: Array, ankles: Array) -> Array:
    """Vectors from the hips to the ankles in the frame of the pelvis, (..., 2, 3) [m].

    The pelvis has positions (..., 3) and orientations R, (..., 3, 3).
    """
    return (ankles - pelvis[..., None, :]) @ R - robot.hips


def enlarge_posture(
    true: Posture,
    planned: Posture,
    share: Array | float,
    robot: Biped,
    largest: float = LARGEST_FACTOR,
) -> tuple[Posture, float]:
    """Enlarge the deviations of a posture; return the posture and the factor.

    Args:
        true: True posture, whose feet do not move.
        planned: Planned posture, whose pelvis is level.
        share: Share μ of the weight on the right foot; the pelvis deviates relative to the feet
            that carry it.
        robot: Robot whose legs must reach the feet.
        largest: Largest factor.
    """
    factors = np.linspace(largest, 1.0, _NUM_FACTORS)
    origin = planned.pelvis + shares(np.asarray(share)) @ (true.ankles - planned.ankles)
    pelvis = origin + factors[:, None] * (true.pelvis - origin)
    # this import takes a quarter of a second, and few programs draw
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_matrix(true.R @ planned.R.T).as_rotvec()
    R = Rotation.from_rotvec(np.outer(factors, turned)).as_matrix() @ planned.R
    legs = hip_to_ankle(robot, pelvis, R, true.ankles)
    is_within_reach = (np.linalg.norm(legs, axis=-1) <= robot.leg.reach).all(axis=-1)
    is_within_reach[-1] = True  # the true posture
    first = int(np.argmax(is_within_reach))
    enlarged = Posture(pelvis[first], R[first], true.ankles, true.feet_R)
    return enlarged, float(factors[first])


class WalkerPicture(Picture):
    """Picture of the walker with its plan, the ZMP and its reference.

    Args:
        task: Task of the worlds whose true state is drawn.
    """

    def __init__(self, task: WalkTask) -> None:
        super().__init__(humanoid.display_spec(task.config.robot), _LEGEND)
        self._task = task
        self._factor = LARGEST_FACTOR
        self._eye = self._model.camera(CAMERA).pos[:2].copy()
        self._lights = self._model.light_pos[:, :2].copy()

    def display_robot(self) -> DisplayRobot:
        """Return the robot of a side-by-side picture."""
        spec = humanoid.solid_spec(self._task.config.robot)
        dress = humanoid.set_floor_and_light
        return DisplayRobot(spec, LEG_JOINTS, _ROBOT_DISTANCE_M, "pelvis", dress)

    def sides(self, now: Mapping[str, float], world: int = 0) -> Sides:
        """Return reference, motor side and link side of a world."""
        truth = self._task.truth()
        planned = Posture.from_plan(self._task.plan, self._plan_row(now))
        q_ref = planned.joint_angles(truth.model.biped)
        base_ref = _pose_vector(planned.pelvis, planned.R)
        base = _pose_vector(truth.pelvis[world], truth.pelvis_R[world])
        theta = truth.theta[world].copy()
        return Sides(q_ref, theta, truth.q[world].copy(), base_ref, base)

    def _plan_row(self, now: Mapping[str, float]) -> int:
        step = round(now["time_s"] / self._task.config.control_period_s)
        return min(step, self._task.plan.num_steps)

    def _pose(self, now: dict[str, float], world: int) -> None:
        plan = self._task.plan
        row = self._plan_row(now)
        truth = self._task.truth()
        true = Posture.from_truth(truth, world)
        planned = Posture.from_plan(plan, row)
        robot = truth.model.biped
        self._model.camera(CAMERA).pos[:2] = self._eye + plan.origin[row]
        self._model.light_pos[:, :2] = self._lights + plan.origin[row]
        enlarged, self._factor = enlarge_posture(true, planned, plan.share[row], robot)
        self._place("", enlarged, robot)
        self._place(PLAN, planned, robot)
        for marker in (ZMP, ZMP_REFERENCE):
            x = now[f"{marker}_x"]
            place = _BELOW_THE_FLOOR if np.isnan(x) else (x, now[f"{marker}_y"], 0.0)
            self._data.mocap_pos[self._model.body(marker).mocapid[0]] = place

    def _caption(self, now: dict[str, float], world: int) -> list[str]:
        failures = [FELL] if self._task.has_fallen()[world] else []
        deviation = now["zmp_deviation"]
        zmp = f"ZMP deviation {1e3 * deviation:5.1f} mm"
        if np.isnan(deviation):
            zmp = "no ground contact"
        roll = f"roll {1e3 * now['pelvis_roll']:+6.1f} mrad"
        pitch = f"pitch {1e3 * now['pelvis_pitch']:+6.1f} mrad"
        factor = f"tilt and shift of the pelvis drawn x {self._factor:.2g}"
        first = [f"t = {now['time_s']:6.2f} s", _phase_name(now), *failures]
        lines = (first, [roll, pitch, zmp], [factor, "feet and ZMP to scale"])
        return ["     ".join(line) for line in lines]

    def _place(self, prefix: str, posture: Posture, robot: Biped) -> None:
        """Move one of the two robots into a posture."""
        pelvis = _pose_vector(posture.pelvis, posture.R)
        self._data.joint(f"{prefix}pelvis").qpos = pelvis
        for joint, angle in zip(LEG_JOINTS, posture.joint_angles(robot), strict=True):
            self._data.joint(prefix + joint).qpos = angle


def _pose_vector(position: Array, R: Array) -> Array:
    """Position [m] and quaternion, (7,)."""
    return np.concatenate([position, quaternion_of(R)])


def _phase_name(now: dict[str, float]) -> str:
    if not now["single_support"]:
        return "double support"
    return "left support" if now["support"] == LEFT else "right support"
