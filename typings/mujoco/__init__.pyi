"""The compiled bindings of mujoco bring no types."""

from typing import Any

def __getattr__(name: str) -> Any: ...
