"""Processor steps of LeRobot, registered by importing this module; it needs the package lerobot.

`elastic_env_compensate_action` belongs at the end of the pipeline before `send_action`, and
`elastic_env_correct_observation` at the start of the pipeline after `get_observation`.
"""

from typing import Any

try:
    from lerobot.configs.types import (  # pyright: ignore[reportMissingImports]
        PipelineFeatureType,
        PolicyFeature,
    )
    from lerobot.processor import (  # pyright: ignore[reportMissingImports]
        ObservationProcessorStep,
        ProcessorStepRegistry,
        RobotAction,
        RobotActionProcessorStep,
        RobotObservation,
    )
except ImportError as error:
    from elastic_env.core.errors import missing_extra

    raise missing_extra("lerobot", "lerobot", "a processor step of LeRobot") from error

from baselines.lerobot.arm import LeRobotArm
from baselines.lerobot.settings import ArmSettings

Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]


class _ArmStep:
    """Settings and arm of a step."""

    def __init__(self, **settings: Any) -> None:
        self.arm = LeRobotArm(ArmSettings(**settings))

    def get_config(self) -> dict[str, Any]:
        """Settings as JSON, with the content of files instead of their names."""
        return self.arm.settings.model_dump(mode="json")

    def transform_features(self, features: Features) -> Features:
        """The same features."""
        return features


@ProcessorStepRegistry.register("elastic_env_compensate_action")
class CompensateActionStep(_ArmStep, RobotActionProcessorStep):
    """Adds the deflections of springs and servos to the positions of an action.

    Args:
        **settings: Fields of `ArmSettings`.

    Attributes:
        arm: Units and compensator; `arm.compensator.set_payload` takes a payload.

    Raises:
        ConfigurationError: A setting cannot be used.
    """

    def action(self, action: RobotAction) -> RobotAction:
        """Action with compensated positions."""
        return self.arm.command(action)

    def reset(self) -> None:
        """Restart the ramp at zero."""
        self.arm.reset()


@ProcessorStepRegistry.register("elastic_env_correct_observation")
class CorrectObservationStep(_ArmStep, ObservationProcessorStep):
    """Replaces the angles of the encoders by those of the links.

    Arguments, attributes and errors are those of `CompensateActionStep`.
    """

    def observation(self, observation: RobotObservation) -> RobotObservation:
        """Observation with positions of the links."""
        return self.arm.link_angles(observation)
