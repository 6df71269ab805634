"""Where the recordings come from, and how a copy is fetched and checked."""

import hashlib
import http.client
import tomllib
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.files import write_whole

_WAIT_S = 60.0
_MOST_BYTES = 64 * 2**20


@dataclass(frozen=True)
class Source:
    """A public repository with recordings, at one commit.

    Attributes:
        name: What we call the recordings, and their folder.
        what: What was recorded, by whom.
        repository: Owner and name on GitHub.
        commit: The commit, 40 hexadecimal digits.
        licence: What the repository says about use.
        files: SHA-256 of each file by its path in the repository.
    """

    name: str
    what: str
    repository: str
    commit: str
    licence: str
    files: dict[str, str]

    def address(self, path: str) -> str:
        """Address of a file at the commit."""
        return f"https://raw.githubusercontent.com/{self.repository}/{self.commit}/{path}"

    def file(self, folder: Path, path: str) -> Path:
        """A copy of one file in a folder of recordings.

        Raises:
            ConfigurationError: It is not there, or is another file.
        """
        copy = folder / self.name / Path(path).name
        if not copy.is_file():
            raise ConfigurationError(
                f"{copy} is not there; get it by --fetch, or by hand from {self.address(path)}"
            )
        digest = hashlib.sha256(copy.read_bytes()).hexdigest()
        if digest != self.files[path]:
            raise ConfigurationError(
                f"{copy} is not the file that was measured: SHA-256 {digest}, expected"
                f" {self.files[path]}; delete it and fetch it anew"
            )
        return copy

    def fetch(self, folder: Path, show: Callable[[str], None]) -> None:
        """Fetch the files that a folder does not have yet.

        Args:
            folder: Folder of recordings.
            show: Called with the address of each file.

        Raises:
            ConfigurationError: A file cannot be reached, or is another one than expected.
        """
        for path in self.files:
            copy = folder / self.name / Path(path).name
            if copy.is_file():
                continue
            address = self.address(path)
            show(address)
            try:
                with urllib.request.urlopen(address, timeout=_WAIT_S) as answer:
                    content = answer.read(_MOST_BYTES)
            except (OSError, http.client.HTTPException) as error:
                raise ConfigurationError(f"cannot fetch {address}: {error}") from None
            digest = hashlib.sha256(content).hexdigest()
            if digest != self.files[path]:
                raise ConfigurationError(
                    f"what {address} sent is not the file that was measured: SHA-256 {digest},"
                    f" expected {self.files[path]}; nothing was written, try again later"
                )
            copy.parent.mkdir(parents=True, exist_ok=True)
            write_whole(copy, content)


_FILE = Path(__file__).with_suffix(".toml")
_TABLES = tomllib.loads(_FILE.read_text(encoding="utf-8"))
SOURCES = {name: Source(name, **table) for name, table in _TABLES.items()}
"""The recordings by name: `agile_justin`, `xl330`, `sts3250`."""
