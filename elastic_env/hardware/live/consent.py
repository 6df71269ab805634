"""Somebody at the terminal, who sees whether the way of a motion is free."""

import sys

from elastic_env.hardware.errors import HardwareError


def require_consent(question: str, port: str) -> None:
    """Ask at the terminal whether the way is free.

    Args:
        question: What will happen.
        port: For the messages.

    Raises:
        HardwareError: Nobody is there, or agrees.
    """
    if not sys.stdin.isatty():
        problem = f"nobody is at the terminal to agree to a motion at {port}"
        cure = "if the way is free, say so by --yes, in Python by confirm=False"
        raise HardwareError(f"{problem}; {cure}")
    if not answers_yes(f"{question} Type the whole word yes: "):
        raise HardwareError(f"nobody agreed; nothing has moved at {port}")


def answers_yes(question: str) -> bool:
    """True if somebody at the terminal answers yes."""
    try:
        return input(question).strip().lower() == "yes"
    except EOFError:
        return False
