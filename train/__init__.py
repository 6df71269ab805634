"""Evaluation, comparison and training.

The wrappers for agents, which are in `baselines`, are here by name too.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from baselines import ResidualVectorWrapper, ResidualWrapper

__all__ = ["ResidualVectorWrapper", "ResidualWrapper"]


def __getattr__(name: str) -> Any:
    """The wrappers when they are asked for: the command line should not wait for them."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import baselines

    return getattr(baselines, name)
