"""Drawing on machines without a display: MuJoCo chooses its OpenGL at its first import."""

import ctypes
import os
import sys

_VARIABLE = "MUJOCO_GL"

CURE = (
    "drawing needs OpenGL: with a display nothing more, without one libEGL (Debian, Ubuntu: "
    "apt-get install libegl1 libgl1-mesa-dri) and the environment variable MUJOCO_GL=egl"
)
"""Cure for a machine that cannot draw."""


def prefer_egl() -> None:
    """Let MuJoCo draw through EGL where there is no display. Call it before importing MuJoCo."""
    is_chosen = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    is_chosen = is_chosen or _VARIABLE in os.environ
    if sys.platform == "linux" and not is_chosen and _has_egl():
        os.environ[_VARIABLE] = "egl"


def _has_egl() -> bool:
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    return True
