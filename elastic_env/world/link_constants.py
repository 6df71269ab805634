"""Constants of links on a fixed base, as compiled kernels read them."""

import numpy as np

from elastic_env.motion.trajectory import PlanTable
from elastic_env.world import records
from elastic_env.world.joint_config import JointConfig
from elastic_env.world.records import Records, single_record
from elastic_env.world.sensors import is_due


def link_constants(config: JointConfig) -> Records:
    """Weights of the reward and quality of the IMU, a record of `LINK_CONSTANTS`."""
    terms = records.LINK_SCORES.names or ()
    weights = {name: getattr(config.reward, name) for name in terms}
    imu = config.scenario.imu
    return single_record(
        records.LINK_CONSTANTS,
        weights=single_record(records.LINK_SCORES, **weights),
        imu_noise_rad=imu.noise_rad,
        imu_bias_rad=imu.bias_rad,
        imu_sine_error_rad=imu.sine_error_rad,
    )


def link_schedule(reference: PlanTable, imu_rate_hz: float, period_s: float) -> Records:
    """Records of `SCHEDULE`, one per control step."""
    rows = np.zeros(reference.num_steps + 1, records.SCHEDULE)
    rows["scored"] = reference.scored
    rows["rest"] = reference.rest
    rows["imu_is_due"] = is_due(np.arange(len(rows)), imu_rate_hz, period_s)
    rows.flags.writeable = False
    return rows
