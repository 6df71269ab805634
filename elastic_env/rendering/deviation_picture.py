"""Enlarged deviations of joints from their reference, in pictures of robots on a fixed base."""

from typing import Any

from elastic_env.rendering.picture import Picture

WIDTH = 640
HEIGHT = 480
"""Size of a picture [pixels]."""
ENLARGEMENT = 8.0
"""Factor by which deviations from the reference are enlarged."""
REFERENCE_RGBA = (0.35, 0.65, 0.45, 0.35)
REFERENCE_WORD_RGBA = (0.27, 0.55, 0.37, 1.0)
"""Colours of the translucent reference, and of its word in the legend."""


def enlarge_deviation(angle: Any, reference: Any, factor: float = ENLARGEMENT) -> Any:
    """Angle for a picture, with its deviation from the reference enlarged [rad]."""
    return reference + factor * (angle - reference)


class DeviationPicture(Picture):
    """A picture of a robot on a fixed base, whose caption gives the factor of its deviations."""

    def _caption(self, now: dict[str, float], world: int) -> list[str]:  # noqa: ARG002
        deflection = 1e3 * now["deflection"]
        link_error = 1e3 * now["link_error"]
        return [
            f"t = {now['time_s']:6.2f} s     deviations from the reference drawn x {ENLARGEMENT:g}",
            f"deflection {deflection:+7.2f} mrad     link error {link_error:+7.2f} mrad",
        ]
