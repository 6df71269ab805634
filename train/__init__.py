"""Evaluation, comparison and training. The wrappers for agents are here by name; importing them loads no torch."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from train.residual_env import ResidualVectorWrapper, ResidualWrapper

__all__ = ["ResidualVectorWrapper", "ResidualWrapper"]


def __getattr__(name: str) -> Any:
    """The wrappers when they are asked for: the command line should not wait for them."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from train import residual_env

    return getattr(residual_env, name)
