"""The testbed task: make the link follow a reference although the joint bends under gravity.

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

`info` of one world, all at the end of the control period, the truth where nothing else is said:

| key | unit | meaning |
|---|---|---|
| `time_s` | s | since the start of the episode |
| `reference_angle` | rad | q_ref |
| `link_angle`, `link_angle_imu` | rad | q, and what its IMU shows |
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

from elastic_env.robots.testbed.config import TestbedConfig, plant, require_feasible
from elastic_env.world.joint_task import JointTask


class TestbedTask(JointTask):
    """Rules of `elastic_env/Testbed-v0`: one elastic joint that carries a pendulum and an IMU."""

    __test__ = False

    config: TestbedConfig  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(self, config: TestbedConfig, num_worlds: int) -> None:
        require_feasible(config)
        super().__init__(config, plant(config), num_worlds, config.observe_link)
