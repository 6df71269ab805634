"""`elastic_env/Testbed-v0`: make the link follow a reference while the joint bends.

Observation of one world (float64):

| column | name | unit | meaning |
|---|---|---|---|
| 0 | `encoder_angle` | rad | motor encoder, θ in whole counts |
| 1 | `encoder_rate` | rad/s | its change over the last control period |
| 2 | `reference_angle` | rad | q_ref at the end of the coming control period |
| 3 | `reference_rate` | rad/s | its rate |
| 4 | `reference_acceleration` | rad/s² | its acceleration |
| 5 | `last_command` | rad | θ_cmd of the last control period |
| 6 | `link_angle_imu` | rad | IMU on the link; only with `observe_link=True` or `sensors=["link_imu"]` |

Action of one world (float32): the command offset a = θ_cmd − q_ref [rad], within ±0.3.

`info` of one world, at the end of the control period; true values unless the table says otherwise:

| key | unit | meaning |
|---|---|---|
| `time_s` | s | since the start of the episode |
| `reference_angle` | rad | q_ref |
| `link_angle`, `link_angle_imu` | rad | q, and q by its IMU |
| `link_error`, `link_error_imu` | rad | q_ref − q, and by the IMU; positive where the link hangs behind |
| `deflection` | rad | δ = θ − q |
| `joint_torque` | N·m | of spring and damper on the link, positive along q |
| `servo_error` | rad | θ_cmd − θ |
| `command_rate` | rad/s | rate of change of the offset a |
| `rest` | 1 | number of the window at rest of `hold`, −1 elsewhere |
| `clipped` | 1 | 1 where the action was beyond its bounds |
| `reward_terms` | 1 | weighted terms of the reward, by name |
| `termination` | | why the episode ended: "diverged", or "" |
| `episode_metrics` | | at the end of the episode: its figures, whose names end with their unit |
"""  # noqa: E501

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from elastic_env.core.errors import ConfigurationError, quote
from elastic_env.joint.dynamixel import H54_200_S500_R
from elastic_env.joint.elastic_joint import ElasticJoint
from elastic_env.joint.small_servos import small_servo
from elastic_env.motion.references import AnyReference, make_reference
from elastic_env.registration import Robot, as_model
from elastic_env.robots.testbed import ID, NAME
from elastic_env.robots.testbed.config import TestbedConfig
from elastic_env.robots.testbed.model import Pendulum
from elastic_env.robots.testbed.picture import TestbedPicture
from elastic_env.world.joint_config import RewardWeights
from elastic_env.world.joint_signals import ACTION_BOUND_RAD
from elastic_env.world.joint_task import JointTask
from elastic_env.world.link_signals import LINK_IMU_SENSOR
from elastic_env.world.robot_model import read_stiffness
from elastic_env.world.scenario import Scenario, make_scenario


def configure_testbed(
    reference: str | dict[str, Any] | AnyReference = "hold",
    scenario: str | Scenario = "nominal",
    stiffness: float | str | Path | None = None,
    joint: ElasticJoint | dict[str, Any] | str | None = None,
    pendulum: Pendulum | dict[str, Any] | None = None,
    form: Literal["tendon", "rigid"] = "tendon",
    observe_link: bool = False,
    reward: RewardWeights | dict[str, float] | None = None,
    timestep_s: float | None = None,
    sensors: Sequence[str] = (),
    action_bound_rad: float = ACTION_BOUND_RAD,
) -> TestbedConfig:
    """Make the testbed's configuration from the arguments of `gymnasium.make`.

    Args:
        reference: "hold", "sine", "multisine", "steps", a mapping with `kind` and parameters, or a
            reference model.
        scenario: Name as in `elastic_env.world.scenario`, or a `Scenario`.
        stiffness: K of the joint [N·m/rad], or the path of an `identification.json`; by default K
            of `joint`.
        joint: Elastic joint, a mapping of changes to the default, which is the paper's
            H54-200-S500-R, or a name of `elastic_env.joint.small_servos`.
        pendulum: The load, or a mapping of changes to the default, which has 60 N·m at the
            horizontal.
        form: "tendon" for the elastic joint, "rigid" for an inelastic testbed.
        observe_link: True to observe the link's IMU.
        reward: Weights of the reward terms, or a mapping of changes to the default.
        timestep_s: Physics step, which divides the control period of 4 ms; default 0.5 ms [s].
        sensors: Sensors in addition to the standard set: "link_encoder", "joint_torque",
            "accelerometer", see `elastic_env.world.further_sensors`, and "link_imu", which is the
            same as `observe_link`.
        action_bound_rad: Largest command offset [rad].

    Raises:
        ConfigurationError: A name, a parameter or a combination that does not exist.
    """
    if not isinstance(observe_link, bool):
        raise ConfigurationError(f"observe_link must be true or false, got {quote(observe_link)}")
    if observe_link and isinstance(sensors, list | tuple):
        sensors = (*sensors, LINK_IMU_SENSOR)
    changes = small_servo(joint) if isinstance(joint, str) else joint
    elastic_joint = as_model("joint", changes, H54_200_S500_R)
    if stiffness is not None:
        elastic_joint = elastic_joint.replace(stiffness=read_stiffness(stiffness))
    return TestbedConfig(
        reference=make_reference(reference),
        scenario=make_scenario(scenario, walks=False),
        joint=elastic_joint,
        pendulum=as_model("pendulum", pendulum, Pendulum()),
        form=form,
        sensors=sensors,  # pyright: ignore[reportArgumentType]  the model takes any sequence
        reward=as_model("reward", reward, RewardWeights()),
        action_bound_rad=action_bound_rad,
        **({} if timestep_s is None else {"timestep_s": timestep_s}),
    )


def _picture(task: JointTask) -> TestbedPicture:
    assert isinstance(task.config, TestbedConfig)
    return TestbedPicture(task.config.pendulum)


TESTBED = Robot(NAME, ID, configure_testbed, JointTask, _picture)
make = TESTBED.make
make_vector = TESTBED.make_vector
