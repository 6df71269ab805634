"""Processor steps of LeRobot, registered by importing this module; it needs the package lerobot.

`elastic_env_compensate_action` belongs at the end of the pipeline before `send_action`, and
`elastic_env_correct_observation` at the begin of the one after `get_observation`.
"""

from typing import Any

try:
    from lerobot.configs.types import PipelineFeatureType, PolicyFeature
    from lerobot.processor import (
        ObservationProcessorStep,
        ProcessorStepRegistry,
        RobotAction,
        RobotActionProcessorStep,
        RobotObservation,
    )
except ImportError as error:
    from elastic_env.core.errors import missing_extra

    raise missing_extra("lerobot", "lerobot", "a processor step of LeRobot") from error
from typing_extensions import override

from baselines.lerobot.arm import LeRobotArm
from baselines.lerobot.settings import ArmSettings

Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]


@ProcessorStepRegistry.register("elastic_env_compensate_action")
class CompensateActionStep(RobotActionProcessorStep):
    """Leads the positions of an action by what springs and servos give way.

    Args:
        **settings: As of `ArmSettings`.

    Attributes:
        arm: Units and compensator; `arm.compensator.set_payload` takes a payload.

    Raises:
        ConfigurationError: A setting cannot be used.
    """

    def __init__(self, **settings: Any) -> None:
        self.arm = LeRobotArm(ArmSettings(**settings))

    @override
    def action(self, action: RobotAction) -> RobotAction:
        return self.arm.command(action)

    @override
    def get_config(self) -> dict[str, Any]:
        return self.arm.settings.model_dump(mode="json")

    @override
    def reset(self) -> None:
        self.arm.reset()

    @override
    def transform_features(self, features: Features) -> Features:
        return features


@ProcessorStepRegistry.register("elastic_env_correct_observation")
class CorrectObservationStep(ObservationProcessorStep):
    """Puts the angles of the links in the place of those that encoders show.

    Arguments, attributes and errors are as of `CompensateActionStep`.
    """

    def __init__(self, **settings: Any) -> None:
        self.arm = LeRobotArm(ArmSettings(**settings))

    @override
    def observation(self, observation: RobotObservation) -> RobotObservation:
        return self.arm.link_angles(observation)

    @override
    def get_config(self) -> dict[str, Any]:
        return self.arm.settings.model_dump(mode="json")

    @override
    def transform_features(self, features: Features) -> Features:
        return features
