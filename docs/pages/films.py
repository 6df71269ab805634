"""Short films of the docs: the same motion without compensation on the left, and with compensation
on the right.

`python -m docs.pages.films [CHECKOUT]` writes them into docs/images of a checkout, as animated
WebP.
"""

import sys
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from elastic_env.rendering.headless import prefer_egl

prefer_egl()

import gymnasium  # noqa: E402
import numpy as np  # noqa: E402
import PIL.Image  # noqa: E402
from rich.console import Console  # noqa: E402

from elastic_env.rendering.picture import Image, with_text  # noqa: E402
from train.commands.play import episode  # noqa: E402
from train.commands.robot import Robot, robot_arguments  # noqa: E402
from train.evaluate.conditions import Condition, PolicySpec  # noqa: E402
from train.evaluate.rollout import make_policy  # noqa: E402

_FRAMES_PER_S = 12.5
_QUALITY = 40


@dataclass(frozen=True)
class Film:
    """A motion that two policies play.

    Attributes:
        condition: What is played; its policy is the one without compensation.
        compensated: The policy on the right.
        begin_s, end_s: What is shown of the episode [s].
        box: Left, upper, right and lower edge of what is shown [pixels]; caption and legend are
            left out.
        width: Of each of the two pictures [pixels].
    """

    condition: Condition
    compensated: str
    begin_s: float
    end_s: float
    box: tuple[int, int, int, int]
    width: int = 310


def films() -> dict[str, Film]:
    """The films by the names of their files."""
    robot = robot_arguments(Robot(model="panda"))
    circle = {"kind": "circle", "radius": 0.12, "duration_s": 5.0}
    return {
        "walk": Film(
            Condition(env="walker", policy=_named("uncompensated"), reference=3),
            "input_output",
            4.0,
            9.0,
            (120, 86, 640, 690),
        ),
        "arm": Film(
            Condition(
                env="robot", policy=_named("uncompensated"), reference=circle, env_options=robot
            ),
            "input",
            1.0,
            6.0,
            (180, 140, 580, 380),
        ),
    }


def _named(name: str) -> PolicySpec:
    return PolicySpec(name=name)


def frames(film: Film, policy: str, console: Console) -> Iterator[Image]:
    """The pictures of one side."""
    condition = film.condition.replace(policy=_named(policy))
    env: Any = gymnasium.make(
        condition.environment.id, render_mode="rgb_array", **condition.arguments
    )
    period = env.unwrapped.task.assumed_model.control_period_s
    every = round(1.0 / (_FRAMES_PER_S * period))
    title = "without" if policy == "uncompensated" else "with"
    with closing(env):
        played = episode(
            env, make_policy(condition.policy, env), condition, round(film.end_s / period), console
        )
        for step, _ in played:
            if step * period >= film.begin_s and step % every == 0:
                yield _cut(env.render(), film, f"{title} compensation")


def _cut(image: Image, film: Film, title: str) -> Image:
    left, upper, right, lower = film.box
    size = film.width, round(film.width * (lower - upper) / (right - left))
    small = PIL.Image.fromarray(image).crop(film.box).resize(size, PIL.Image.Resampling.LANCZOS)
    return with_text(np.asarray(small), [title])


def write(film: Film, path: Path, console: Console) -> Path:
    """Play both sides and write the film."""
    sides = zip(
        *(frames(film, policy, console) for policy in ("uncompensated", film.compensated)),
        strict=True,
    )
    first, *others = (PIL.Image.fromarray(np.concatenate(pair, axis=1)) for pair in sides)
    first.save(
        path,
        save_all=True,
        append_images=others,
        duration=round(1e3 / _FRAMES_PER_S),
        loop=0,
        quality=_QUALITY,
        method=6,
    )
    return path


def main(arguments: Sequence[str]) -> None:
    """Write the films: [CHECKOUT], by default the working directory."""
    console = Console()
    images = Path(*arguments) / "docs" / "images"
    for name, film in films().items():
        console.print(f"wrote {write(film, images / f'{name}.webp', console)}", soft_wrap=True)


if __name__ == "__main__":
    main(sys.argv[1:])
