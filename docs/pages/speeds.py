"""Tables of what a step costs, from the `speed.csv` that `elastic speed` wrote and from the
leaderboard.
"""

from collections.abc import Sequence

from docs.pages.cells import Rows, page_table
from train.evaluate.episodes import group_by
from train.evaluate.leaderboard_rows import Standing

_RAW = "raw mj_step"
_OURS = "vector env"
_SHOWN = ("1", "64", "1024")
"""Numbers of worlds in the table of the CPU; `speed_*.csv` has more."""
_OTHERS = ("Gymnasium AsyncVectorEnv", "SB3 SubprocVecEnv")
_POLICIES = ("uncompensated", "input_output", "adaptive_posture", "foothold", "residual of 3 s")
"""Vector environments in two processes, and policies that are timed alone."""


def vector_environments(*tables: Rows, shown: Sequence[str] = _SHOWN) -> str:
    """Time of raw physics per world and control step, and how fast the vector environment is
    beside it, with these numbers of worlds.
    """
    lines = []
    rows = [
        row
        for table in tables
        for row in table
        if row["against"] == f"{_RAW}, {row['num_envs']}" and row["num_envs"] in shown
    ]
    rows = sorted(rows, key=lambda row: int(row["num_envs"]))
    for (env, worlds), own in sorted(
        group_by(rows, lambda row: (row["env"], row["num_envs"])).items(), key=_robot
    ):
        ratios = [f"{float(row['ratio']):.2f}" for row in own if row["contender"].startswith(_OURS)]
        raw, *_ = (row for row in own if row["contender"] == _RAW)
        if ratios:  # the scalar environment has raw physics of its own
            lines.append([env, worlds, f"{1e6 / float(raw['steps_per_s']):.0f}", *ratios])
    head = [
        "",
        "worlds",
        "raw [µs]",
        "environment / raw",
        "with policy / raw",
        "with policy and network / raw",
    ]
    return page_table(head, lines)


def _robot(place: tuple[tuple[str, ...], Rows]) -> str:
    return place[0][0]


def other_ways(*tables: Rows) -> str:
    """Scalar environments under other vector environments, and PPO end to end."""
    rows = [
        row
        for table in tables
        for row in table
        if row["contender"].startswith("PPO")
        or (row["contender"] in _OTHERS and row["num_envs"] == "2")
    ]
    lines = [
        [
            row["env"],
            row["contender"],
            row["num_envs"],
            f"{float(row['steps_per_s']):.0f}",
            f"{float(row['ratio']):.2f}",
        ]
        for row in rows
    ]
    against = sorted({row["against"] for row in rows if not row["contender"].startswith("PPO")})
    head = [
        "",
        "",
        "worlds",
        "control steps/s",
        f"ratio to {' and '.join(against)}; of PPO to the first of them",
    ]
    return page_table(head, lines, words=2)


def costs_of_cells(rows: Rows) -> str:
    """Costs of handing out a cell and of a kill, from `tests.cluster_trials`."""
    lines = []
    for row in rows:
        if row["dask_to_local"]:
            here, there = (f"{float(row[name]):.4g}" for name in ("local_ms", "dask_ms"))
            lines.append(f"* {row['trial']}: {here} ms each here, {there} ms on dask")
        else:
            what = f"{float(row['count']):.0f} × {row['trial']}"
            again = f"at most {row['played_again_most']} cells began again"
            lines.append(f"* {what}: {row['identical']} results complete and identical, {again}")
    return "\n".join(lines) + "\n"


def policies_alone(standings: Sequence[Standing]) -> str:
    """Time of `predict` for one world of the walker, as measured with the leaderboard."""
    took = {s.policy: s.step_us for s in standings}
    shown = [f"`{policy}` {took[policy]:.0f} µs" for policy in _POLICIES[:-1]]
    return f"{', '.join(shown)}, {_POLICIES[-1]} {took[_POLICIES[-1]]:.0f} µs.\n"
