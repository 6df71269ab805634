"""Pictures in which one sees deviations of milliradians: they are drawn larger, by a factor that the picture shows."""

from elastic_env.rendering.picture import Picture
from elastic_env.rendering.testbed import EXAGGERATION, TestbedPicture, exaggerated
from elastic_env.rendering.walker import LARGEST_FACTOR, WalkerPicture

__all__ = ["EXAGGERATION", "LARGEST_FACTOR", "Picture", "TestbedPicture", "WalkerPicture", "exaggerated"]
