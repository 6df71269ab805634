"""Colours of policies and of the parts of charts, for pictures and for the page of a report."""

from collections.abc import Sequence

INK = "#1f2328"
GRID = "#e8eaed"
FRAME = "#8b949e"
LINE = "#d0d7de"
"""Of a line between groups."""
SHADE = "#f1f3f5"
"""Of single support behind a curve."""
REFERENCE = "#111111"
COLOURS = {
    "zero": "#9c6644",
    "rigid": "#555555",
    "uncompensated_open": "#e6a57e",
    "uncompensated": "#c8553d",
    "input_open": "#8fbbd9",
    "input": "#2a6f97",
    "input_output": "#14a098",
    "input_wrench": "#1f2a55",
    "dynamic": "#7aa344",
    "oracle": "#8e5ea2",
}
"""Of the baselines."""
STRONG = ("#d6006c", "#e69500", "#3d3df5", "#00a63e", "#111111", "#00a5cf", "#a05a00", "#8a8a8a")
"""Of residuals and of one's own policies: far from the baselines' and from one another."""
FAILED = "#111111"
"""Of the mark of a failure that belongs to no policy alone."""
VERDICTS = {"lower": "#1a7f5a", "higher": "#b42318", "none": "#6e7781", "unclear": "#6e7781"}
"""Of changes by their verdict."""
NIGHT = {
    "white": "#0d1117",
    INK: "#e6edf3",
    GRID: "#262c34",
    FRAME: "#4a525c",
    LINE: "#3d444d",
    SHADE: "#1c2128",
    REFERENCE: "#e6edf3",
    "#1a7f5a": "#3fb27f",
    "#b42318": "#ff7b72",
    "#6e7781": "#9aa5b1",
    "#1f2a55": "#9fb0ff",
    "#3d3df5": "#9d9dff",
    "#555555": "#a8a8a8",
    "#2a6f97": "#4c9bc9",
    "#8e5ea2": "#b184c6",
    "#d6006c": "#ff5aa5",
    "#a05a00": "#d08a30",
}
"""Colours in the dark in place of those that would not be seen there, in all parts of a chart."""
_DASHED = ("zero", "rigid", "uncompensated_open", "input_open")


def policy_colours(policies: Sequence[str]) -> dict[str, str]:
    """A colour for every policy: those without one of their own take the others in turn."""
    unnamed = [policy for policy in policies if policy not in COLOURS]
    return {
        policy: COLOURS.get(policy) or STRONG[unnamed.index(policy) % len(STRONG)]
        for policy in policies
    }


def dash_of(policy: str) -> str:
    """Dash of a policy's line: no center of mass is fed back where it is not solid."""
    return "dash" if policy in _DASHED else "solid"
