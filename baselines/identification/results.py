"""Intervals and files that all results of identifications have in common."""

from pathlib import Path

from elastic_env.core.config import Model
from elastic_env.core.yaml_text import yaml_line


def stiffness_ends(compliance: float, half_width: float) -> tuple[float | None, float | None]:
    """Ends of the interval of K = 1/c [N·m/rad]; None where the interval of c reaches zero there.

    Args:
        compliance: Estimate of c [rad/(N·m)].
        half_width: Half of its interval [rad/(N·m)].
    """
    low = 1.0 / (compliance + half_width) if compliance + half_width > 0.0 else None
    high = 1.0 / (compliance - half_width) if compliance > half_width else None
    return low, high


def stiffness_line(joint: str, stiffness: float, comment: str) -> str:
    """Line of `joints.yaml` with K in six digits [N·m/rad]."""
    return yaml_line(joint, {"stiffness": float(f"{stiffness:.6g}")}, comment)


def save_result(result: Model, folder: Path, head: str, lines: list[str]) -> list[Path]:
    """Write `identification.json` and `joints.yaml`.

    Args:
        result: Content of `identification.json`.
        folder: Folder of the files.
        head: Comment in the first line of `joints.yaml`.
        lines: Its other lines.

    Returns:
        Both paths.
    """
    files = [folder / "identification.json", folder / "joints.yaml"]
    files[0].write_text(result.model_dump_json(indent=2) + "\n", encoding="utf-8")
    files[1].write_text("\n".join([head, *lines]) + "\n", encoding="utf-8")
    return files
