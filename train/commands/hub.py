"""`elastic hub`: push residuals to the Hugging Face hub, and pull them."""

import re
from pathlib import Path
from typing import Annotated

import tyro
from pydantic import field_validator
from rich.console import Console

from baselines.residual.settings import RESIDUAL
from elastic_env.core.config import Locator, Model, Title
from elastic_env.core.errors import quote
from train.export.hub import pull_residual, push_residual


class Push(Model):
    """Put a residual's folder into a repository of the hub: description, weights and a card.

    First log in with: hf auth login

    Example: elastic hub push residual:testbed/seed_0 me/testbed-residual
    """

    residual: Annotated[Locator, tyro.conf.Positional]
    """Folder of the residual, or residual:NAME of one in the package."""
    repository: Annotated[Title, tyro.conf.Positional]
    """OWNER/NAME; a missing repository is created."""
    public: bool = False
    """Let everybody read a new repository; default only its owner."""

    def run(self, console: Console) -> None:
        """Push the residual, and print its address and digest."""
        folder = Path(self.residual.removeprefix(RESIDUAL))
        pushed = push_residual(folder, self.repository, self.public)
        console.print(f"wrote {pushed.url}")
        console.print(f"elastic hub pull {self.repository} --sha256 {pushed.digest}")


class Pull(Model):
    """Take a residual from a repository of the hub.

    Sizes and kinds of files are checked before they are fetched, the digest of the weights
    afterwards. No file runs as code.

    Example: elastic hub pull me/testbed-residual

    Then: elastic evaluate --policy residual:hub/me/testbed-residual
    """

    repository: Annotated[Title, tyro.conf.Positional]
    """OWNER/NAME."""
    revision: Title = "main"
    """Branch, tag or commit."""
    sha256: str | None = None
    """Digest that the weights must have, as elastic hub push prints it."""
    offline: bool = False
    """Contact no server; use the hub's cache of earlier pulls."""
    output: Path | None = None
    """Folder for the residual, new or empty; default hub/OWNER/NAME."""

    @field_validator("sha256")
    @classmethod
    def _check_digest(cls, digest: str | None) -> str | None:
        if digest is not None and not re.fullmatch("[0-9a-f]{64}", digest):
            form = "64 hexadecimal digits, 0 to 9 and a to f"
            raise ValueError(f"the digest must be {form}, got {quote(digest)}")
        return digest

    def run(self, console: Console) -> None:
        """Pull the residual, and print its commit and folder."""
        pulled = pull_residual(
            self.repository,
            revision=self.revision,
            digest=self.sha256,
            offline=self.offline,
            output=self.output,
        )
        console.print(f"commit {pulled.commit}, of the {pulled.description.robot}")
        console.print(f"play it as residual:{pulled.folder}")


class Hub(Model):
    """Share residuals on the Hugging Face hub.

    push: a folder to a repository. pull: a repository to a folder.
    """

    command: Push | Pull

    def run(self, console: Console) -> None:
        """Run the subcommand."""
        self.command.run(console)
