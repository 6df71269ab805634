"""Residuals to a hub and back, through the real client and a small hub on the loopback.

The real hub was not asked. The small one takes files within a commit, as the real one takes small
texts; the way of large files (LFS, Xet) is the client's.
"""

import base64
import json
import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from hashlib import sha1, sha256
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import gymnasium
import pytest

import baselines
from baselines.residual.residual_folder import DESCRIPTION, WEIGHTS, find_folder
from elastic_env.core.errors import (
    ConfigurationError,
    ElasticError,
    ResultsExistError,
    SystemFailedError,
)
from train.commands.cli import main
from train.export.hub import pull_residual, push_residual

SHIPPED = find_folder(Path("testbed/seed_0"))
FILES = {name: (SHIPPED / name).read_bytes() for name in (DESCRIPTION, WEIGHTS)}
DIGEST = sha256(FILES[WEIGHTS]).hexdigest()
REPOSITORY = "somebody/testbed"


@dataclass
class SmallHub:
    """Repositories in memory, and what was asked of them."""

    files: dict[str, dict[str, bytes]] = field(default_factory=dict)
    sizes: dict[str, int] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)
    private: dict[str, bool] = field(default_factory=dict)
    may_write: bool = True
    is_portal: bool = False
    """True for a page that answers everything, as networks of hotels do."""

    def commit(self, name: str) -> str:
        """Commit of a repository: a digest of its files."""
        content = sorted(self.files[name].items())
        return sha1(repr(content).encode()).hexdigest()


class Handler(BaseHTTPRequestHandler):
    """The parts of the hub's interface that the client uses for this."""

    hub: SmallHub

    def log_message(self, *_: Any) -> None:
        """Say nothing."""

    def answer(self, status: int, body: bytes = b"", **headers: str) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def json(self, content: Any, status: int = 200) -> None:
        self.answer(status, json.dumps(content).encode(), Content_Type="application/json")

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        self.hub.asked.append(f"{self.command} {path}")
        if self.hub.is_portal:
            self.answer(200, b"<html>log in</html>")
        elif found := re.fullmatch(r"/api/models/([^/]+/[^/]+)/revision/(.+)", path):
            self.info(*found.groups())
        elif found := re.fullmatch(r"/([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path):
            self.file(*found.groups())
        else:
            self.answer(404)

    def info(self, name: str, revision: str) -> None:
        if name not in self.hub.files:
            self.answer(404, X_Error_Code="RepoNotFound")
            return
        if revision not in ("main", self.hub.commit(name)):
            self.answer(404, X_Error_Code="RevisionNotFound")
            return
        files = [
            {"rfilename": file, "size": self.hub.sizes.get(file, len(content))}
            for file, content in self.hub.files[name].items()
        ]
        self.json({"id": name, "sha": self.hub.commit(name), "siblings": files})

    def file(self, name: str, _: str, file: str) -> None:
        content = self.hub.files.get(name, {}).get(file)
        if content is None:
            self.answer(404, X_Error_Code="EntryNotFound")
            return
        self.answer(
            200, content, ETag=f'"{sha1(content).hexdigest()}"', X_Repo_Commit=self.hub.commit(name)
        )

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        path = self.path.partition("?")[0]
        self.hub.asked.append(f"POST {path}")
        if not self.hub.may_write:
            self.json({"error": "no"}, 403)
        elif path == "/api/validate-yaml":
            self.json({"errors": [], "warnings": []})
        elif path == "/api/repos/create":
            asked = json.loads(body)
            name = f"{asked['organization']}/{asked['name']}"
            self.hub.files.setdefault(name, {})
            self.hub.private[name] = asked.get("visibility") == "private" or bool(
                asked.get("private")
            )
            self.json({"url": f"http://127.0.0.1/{name}", "id": name})
        elif found := re.fullmatch(r"/api/models/(.+)/preupload/main", path):
            files = json.loads(body)["files"]
            answer = [
                {"path": own["path"], "uploadMode": "regular", "shouldIgnore": False}
                for own in files
            ]
            self.json({"files": answer})
        elif found := re.fullmatch(r"/api/models/(.+)/commit/main", path):
            name = found[1]
            for line in body.decode().splitlines():
                entry = json.loads(line)
                if entry["key"] == "file":
                    own = entry["value"]
                    self.hub.files[name][own["path"]] = base64.b64decode(own["content"])
            commit = self.hub.commit(name)
            url = f"http://127.0.0.1/{name}/commit/{commit}"
            self.json({"success": True, "commitOid": commit, "commitUrl": url, "hookOutput": ""})
        else:
            self.answer(404)


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[SmallHub]:
    """A hub on the loopback, an empty cache, and a working folder of its own."""
    from huggingface_hub import constants

    own = SmallHub()
    handler = type("OfHub", (Handler,), {"hub": own})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{server.server_port}")
    monkeypatch.setenv("HF_TOKEN", "hf_test")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    yield own
    server.shutdown()
    server.server_close()
    thread.join()


def test_what_is_pushed_comes_back_and_plays(
    hub: SmallHub, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both commands, and the policy under the name that pull prints."""
    main(["hub", "push", "residual:testbed/seed_0", REPOSITORY])
    said = capsys.readouterr().out
    assert f"elastic hub pull {REPOSITORY} --sha256" in " ".join(said.split())
    assert {name: hub.files[REPOSITORY][name] for name in FILES} == FILES
    assert set(hub.files[REPOSITORY]) == {*FILES, "README.md"}
    assert hub.private[REPOSITORY]
    main(["hub", "pull", REPOSITORY, "--sha256", DIGEST])
    assert f"residual:hub/{REPOSITORY}" in capsys.readouterr().out
    folder = Path("hub") / REPOSITORY
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == FILES
    assert not any(path.is_symlink() for path in folder.iterdir())
    env = gymnasium.make("elastic_env/Testbed-v0")
    policy = baselines.make(f"residual:hub/{REPOSITORY}", env)
    observation, _ = env.reset(seed=0)
    action, _ = policy.predict(observation)
    shipped, _ = baselines.make("residual:testbed/seed_0", env).predict(observation)
    assert (action == shipped).all()


def test_offline_takes_what_was_pulled_before(
    hub: SmallHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is asked of the hub, nor of any other."""
    hub.files[REPOSITORY] = dict(FILES)
    with pytest.raises(ConfigurationError, match="not in the cache"):
        pull_residual(REPOSITORY, offline=True)
    first = pull_residual(REPOSITORY)
    hub.asked.clear()
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    again = pull_residual(REPOSITORY, offline=True, output=tmp_path / "again")
    assert hub.asked == []
    assert again.commit == first.commit == hub.commit(REPOSITORY)
    assert (tmp_path / "again" / WEIGHTS).read_bytes() == FILES[WEIGHTS]


def test_other_files_of_a_repository_stay_there(hub: SmallHub) -> None:
    """A pickle beside the residual is not even fetched."""
    hub.files[REPOSITORY] = FILES | {"model.pkl": b"cos\nsystem\n", "code.py": b"1/0"}
    pulled = pull_residual(REPOSITORY)
    assert {path.name for path in pulled.folder.iterdir()} == set(FILES)
    assert not [asked for asked in hub.asked if "model.pkl" in asked or "code.py" in asked]


def described(**changed: Any) -> bytes:
    """A description with other values."""
    return json.dumps(json.loads(FILES[DESCRIPTION]) | changed).encode()


@pytest.mark.parametrize(
    ("files", "options", "said"),
    [
        ({WEIGHTS: b"\x80\x04."}, {}, "cut short or something else"),
        ({WEIGHTS: FILES[WEIGHTS][:-4] + b"\0\0\0\0"}, {}, "was changed"),
        ({DESCRIPTION: described(weights_sha256=None)}, {}, "names no digest"),
        ({DESCRIPTION: b"{}"}, {}, "describes no residual"),
        ({}, {"digest": "0" * 64}, "was asked for"),
        ({}, {"revision": "v9"}, "has no revision 'v9'"),
    ],
)
def test_what_is_no_sound_residual_is_one_sentence_and_leaves_nothing(
    files: dict[str, bytes], options: dict[str, Any], said: str, hub: SmallHub
) -> None:
    hub.files[REPOSITORY] = FILES | files
    with pytest.raises(ConfigurationError, match=said) as caught:
        pull_residual(REPOSITORY, **options)
    assert "/tmp" not in str(caught.value)
    assert not Path("hub").exists()


def test_sizes_are_checked_before_anything_is_fetched(hub: SmallHub) -> None:
    hub.files[REPOSITORY] = dict(FILES)
    hub.sizes[WEIGHTS] = 10**12
    with pytest.raises(ConfigurationError, match="it has 1000000000000"):
        pull_residual(REPOSITORY)
    del hub.files[REPOSITORY][WEIGHTS]
    with pytest.raises(ConfigurationError, match=f"needs {DESCRIPTION} and {WEIGHTS}"):
        pull_residual(REPOSITORY)
    assert not [asked for asked in hub.asked if "resolve" in asked]


def test_a_folder_with_results_is_not_overwritten(hub: SmallHub) -> None:
    hub.files[REPOSITORY] = dict(FILES)
    pull_residual(REPOSITORY)
    with pytest.raises(ResultsExistError, match="never overwritten"):
        pull_residual(REPOSITORY)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nobody/nothing", "no repository nobody/nothing"),
        ("a/b/c", "a repository is OWNER/NAME"),
        ("../up", "a repository is OWNER/NAME"),
        ("foo", "a repository is OWNER/NAME, .* got 'foo'"),
    ],
)
def test_a_name_of_no_repository_is_one_sentence(name: str, said: str, hub: SmallHub) -> None:
    with pytest.raises(ConfigurationError, match=said):
        pull_residual(name)


def test_no_network_is_one_sentence(hub: SmallHub, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(SystemFailedError, match="--offline"):
        pull_residual(REPOSITORY)
    with pytest.raises(SystemFailedError, match=r"check the network$"):
        push_residual(SHIPPED, REPOSITORY)


def test_a_wrong_digest_is_named_with_its_form(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["hub", "pull", REPOSITORY, "--sha256", "xyz"])
    said = " ".join(capsys.readouterr().err.split())
    assert "--sha256: the digest must be 64 hexadecimal digits" in said
    assert said.endswith("got 'xyz'")


def test_a_page_in_the_place_of_the_hub_is_one_sentence(hub: SmallHub) -> None:
    hub.is_portal = True
    with pytest.raises(SystemFailedError, match="something else than a hub"):
        pull_residual(REPOSITORY)


def test_what_may_not_be_pushed_is_one_sentence(hub: SmallHub, tmp_path: Path) -> None:
    """No residual, a damaged one, no right to write: the hub has nothing then."""
    for content in ({}, FILES | {WEIGHTS: FILES[WEIGHTS][:-4] + b"\0\0\0\0"}):
        folder = tmp_path / f"own_{len(content)}"
        folder.mkdir()
        for name, data in content.items():
            (folder / name).write_bytes(data)
        with pytest.raises(ConfigurationError):
            push_residual(folder, REPOSITORY)
    hub.may_write = False
    with pytest.raises(ElasticError, match="log in by"):
        push_residual(SHIPPED, REPOSITORY)
    assert hub.files == {}
