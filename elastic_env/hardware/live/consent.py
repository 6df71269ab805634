"""Questions to the person at the terminal, who sees whether the robot may move."""

import sys

from elastic_env.hardware.errors import HardwareError


def require_consent(question: str, port: str) -> None:
    """Ask at the terminal whether the robot may move.

    Args:
        question: Planned motion, and the question.
        port: Port of the servos, for the messages.

    Raises:
        HardwareError: Nobody is at the terminal, or nobody agrees.
    """
    if not sys.stdin.isatty():
        problem = f"nobody is at the terminal to agree to a motion at {port}"
        cure = "if the way is free, say so by --yes, in Python by confirm=False"
        raise HardwareError(f"{problem}; {cure}")
    if not answers_yes(f"{question} Type the whole word yes: "):
        raise HardwareError(f"nobody agreed; nothing has moved at {port}")


def answers_yes(question: str) -> bool:
    """Return True if somebody at the terminal answers yes."""
    try:
        return input(question).strip().lower() == "yes"
    except EOFError:
        return False
