"""Residuals on the Hugging Face hub: two data files and a card.

A repository of type model has `residual.json` and `weights.safetensors` at its top. Its files are
untrusted. Names, sizes and types are checked before a download. Nothing is executed or unpickled,
and the digest of the weights must be that of the description. Other files of a repository are not
downloaded.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from json import JSONDecodeError
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from baselines.residual.residual_folder import DESCRIPTION, WEIGHTS, find_folder, load_residual
from baselines.residual.settings import ResidualDescription
from elastic_env.core.errors import (
    ConfigurationError,
    SystemFailedError,
    list_names,
    missing_extra,
    quote,
    shorten,
)
from elastic_env.core.files import read_bounded, write_whole
from train.runs.folders import result_folder

HUB = Path("hub")
"""Folder for pulled residuals, in the working folder."""
_MOST_BYTES = {DESCRIPTION: 4_000_000, WEIGHTS: 100_000_000}
_ENDPOINT = "HF_ENDPOINT"
_TIMEOUT_S = 10.0

_CARD = """---
library_name: elastic-env
tags: [robotics, elastic-joints, residual]
---
A learned residual for the policy `{base}` of the {robot}, by [elastic-env](https://pypi.org/project/elastic-env/).

    elastic hub pull {repository} --sha256 {digest}
    elastic evaluate --policy residual:hub/{repository}

The weights are in `{weights}`, described by `{description}`. Neither holds code.
"""


class PushResult(NamedTuple):
    """A residual that was pushed to the hub.

    Attributes:
        url: Address of the commit.
        digest: SHA-256 of the weights.
    """

    url: str
    digest: str


class PullResult(NamedTuple):
    """A residual that was pulled from the hub.

    Attributes:
        folder: Its folder.
        commit: Commit of the repository.
        description: Description of the residual.
    """

    folder: Path
    commit: str
    description: ResidualDescription


def push_residual(folder: Path, repository: str, public: bool = False) -> PushResult:
    """Push a residual to a repository of the hub, and create the repository if it is missing.

    Args:
        folder: A residual's folder, or the name of one that comes with the package.
        repository: OWNER/NAME.
        public: True for a new repository that everybody may read.

    Raises:
        ConfigurationError: The folder is no residual, is damaged or has no digest, or the
            repository cannot be written.
        MissingExtraError: The package huggingface_hub is missing.
        SystemFailedError: The hub does not answer.
    """
    folder = find_folder(folder)
    description, _ = load_residual(folder)
    digest = _weights_digest(description, folder)
    hub = _import_hub()
    card = _CARD.format(
        base=description.base,
        robot=description.robot,
        repository=repository,
        digest=digest,
        weights=WEIGHTS,
        description=DESCRIPTION,
    )
    files = {name: read_bounded(folder / name, most) for name, most in _MOST_BYTES.items()}
    files["README.md"] = card.encode()
    additions = [
        hub.CommitOperationAdd(path_in_repo=name, path_or_fileobj=content)
        for name, content in files.items()
    ]
    api = hub.HfApi(endpoint=_endpoint())
    with _explain_errors(repository, None):
        api.create_repo(repository, private=not public, exist_ok=True)
        commit = api.create_commit(
            repository, additions, commit_message=f"Residual with weights {digest[:12]}"
        )
    return PushResult(str(commit.commit_url), digest)


def pull_residual(
    repository: str,
    *,
    revision: str = "main",
    digest: str | None = None,
    offline: bool = False,
    output: Path | None = None,
) -> PullResult:
    """Pull a residual from a repository of the hub, or from the hub's cache on this computer.

    Args:
        repository: OWNER/NAME.
        revision: Branch, tag or commit.
        digest: SHA-256 that the weights must have; None to check only that of the description.
        offline: True to use only the cache, without a network.
        output: Folder for it, new or empty; None for hub/OWNER/NAME.

    Raises:
        ConfigurationError: There is no such repository or revision, it has no residual, one of its
            files is too large, or a digest differs. Nothing is written then.
        MissingExtraError: The package huggingface_hub is missing.
        ResultsExistError: The folder is not empty.
        SystemFailedError: The hub does not answer.
    """
    hub = _import_hub()
    with _explain_errors(repository, revision):
        if not offline:
            _require_small(hub, repository, revision)
        options = {"revision": revision, "local_files_only": offline, "endpoint": _endpoint()}
        paths = [Path(hub.hf_hub_download(repository, name, **options)) for name in _MOST_BYTES]
    commits = {path.parent.name for path in paths}
    if len(commits) > 1:
        raise SystemFailedError(f"{repository} changed while it was pulled; pull it again")
    files = {path.name: read_bounded(path, _MOST_BYTES[path.name]) for path in paths}
    with TemporaryDirectory() as temporary:
        description = _check_files(files, Path(temporary), repository, digest)
    with result_folder("hub", HUB / repository if output is None else output) as folder:
        for name, content in files.items():
            write_whole(folder / name, content)
    return PullResult(folder, commits.pop(), description)


def _import_hub() -> Any:
    """Import the package huggingface_hub."""
    try:
        import huggingface_hub
    except ImportError:
        raise missing_extra("huggingface_hub", "hub", "sharing residuals") from None
    return huggingface_hub


def _endpoint() -> str | None:
    """Address of the hub from the environment variable; None for the usual one."""
    return os.environ.get(_ENDPOINT)


def _require_small(hub: Any, repository: str, revision: str) -> None:
    """Refuse a repository without the files of a residual, or with files that are too large."""
    api = hub.HfApi(endpoint=_endpoint())
    info = api.model_info(repository, revision=revision, files_metadata=True, timeout=_TIMEOUT_S)
    sizes = {file.rfilename: file.size for file in info.siblings or []}
    for name, most in _MOST_BYTES.items():
        if name not in sizes:
            raise ConfigurationError(
                f"{shorten(repository)} holds no residual: it needs {DESCRIPTION} and"
                f" {WEIGHTS} at its top, and has {list_names(sizes) or 'no files'}"
            )
        size = sizes[name]
        if size is None or not 0 < size <= most:
            problem = "has no size" if size is None else f"has {size}"
            raise ConfigurationError(
                f"{name} of {shorten(repository)} must have 1 to {most} bytes, it {problem}"
            )


def _check_files(
    files: dict[str, bytes], temporary: Path, repository: str, digest: str | None
) -> ResidualDescription:
    """Check network and digest of a residual in a temporary folder; return its description."""
    for name, content in files.items():
        write_whole(temporary / name, content)
    try:
        description, _ = load_residual(temporary)
    except ConfigurationError as error:
        problem = str(error).replace(f"{temporary}/", "")
        problem = problem.replace(str(temporary), shorten(repository))
        raise ConfigurationError(f"{shorten(repository)} is not used: {problem}") from None
    actual = _weights_digest(description, Path(repository))
    if digest is not None and digest != actual:
        raise ConfigurationError(
            f"the weights of {shorten(repository)} have the SHA-256 digest {actual}, and --sha256"
            f" {quote(digest)[1:-1]} was asked for; ask its author which one is right"
        )
    return description


def _weights_digest(description: ResidualDescription, folder: Path) -> str:
    if description.weights_sha256 is None:
        raise ConfigurationError(
            f"{DESCRIPTION} of {shorten(folder)} names no digest of its weights; give"
            " it their SHA-256 as weights_sha256"
        )
    return description.weights_sha256


@contextmanager
def _explain_errors(repository: str, revision: str | None) -> Iterator[None]:
    """Turn errors of the hub's package into errors with a cause and a cure."""
    from httpx2 import HTTPError  # the HTTP client of huggingface_hub
    from huggingface_hub import errors

    name = shorten(repository)
    form = f"a repository is OWNER/NAME, in letters, digits, and . _ -, got {quote(repository)}"
    if repository.count("/") != 1:
        raise ConfigurationError(form)
    causes = {
        errors.HFValidationError: form,
        errors.RevisionNotFoundError: f"{name} has no revision {quote(revision)}; give a branch, a"
        " tag or a commit",
        errors.RepositoryNotFoundError: f"no repository {name} that you may use; check its name, or"
        " log in by: hf auth login",
        errors.LocalEntryNotFoundError: f"{name} at {revision} is not in the cache of this"
        " computer, and the hub was not reached; pull it once with a network",
    }
    try:
        yield
    except tuple(causes) as error:
        problem = next(text for kind, text in causes.items() if isinstance(error, kind))
        raise ConfigurationError(problem) from None
    except errors.HfHubHTTPError as error:
        status = getattr(error.response, "status_code", None)
        if status in (401, 403):
            raise ConfigurationError(
                f"the hub refuses {name} ({status}); log in by: hf auth login, with a"
                " token that may write"
            ) from None
        raise SystemFailedError(f"the hub answers {status} for {name}; try again later") from None
    except JSONDecodeError:
        raise SystemFailedError(
            f"something else than a hub answers for {name}; check the network, and {_ENDPOINT}"
        ) from None
    except (OSError, HTTPError) as error:
        cache = "" if revision is None else ", or pull with --offline what was pulled before"
        raise SystemFailedError(
            f"the hub was not reached ({type(error).__name__}); check the network{cache}"
        ) from None
