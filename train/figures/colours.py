"""Colours of policies and of the parts of charts, for pictures and for the page of a report."""

import tomllib
from collections.abc import Sequence
from pathlib import Path

_DATA = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
_CHART: dict[str, str] = _DATA["chart"]
INK = _CHART["ink"]
GRID = _CHART["grid"]
FRAME = _CHART["frame"]
LINE = _CHART["line"]
SHADE = _CHART["shade"]
REFERENCE = _CHART["reference"]
FAILED = _CHART["failed"]
RAMP = _CHART["ramp"]
SCORED = _CHART["scored"]
COLOURS: dict[str, str] = _DATA["baselines"]
"""Colours of the baselines."""
STRONG: list[str] = _DATA["strong"]
"""Colours of residuals and users' policies, unlike those of the baselines and unlike each other."""
VERDICTS: dict[str, str] = _DATA["verdicts"]
"""Colours of changes by their verdict."""
NIGHT: dict[str, str] = _DATA["night"]
"""Colours on a dark page, by the colours that would be invisible there, in all parts of a chart."""
_DASHED = ("zero", "rigid", "uncompensated_open", "input_open")


def policy_colours(policies: Sequence[str]) -> dict[str, str]:
    """A colour for every policy: its own, or else the next of `STRONG`."""
    others = [policy for policy in dict.fromkeys(policies) if policy not in COLOURS]
    return {
        policy: COLOURS.get(policy) or STRONG[others.index(policy) % len(STRONG)]
        for policy in policies
    }


def dash_of(policy: str) -> str:
    """Dash of a policy's line: dashed for policies without feedback of the center of mass."""
    return "dash" if policy in _DASHED else "solid"
