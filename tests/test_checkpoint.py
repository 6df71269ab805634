"""Checkpoints: whole or not at all, checked before they are read, and gone on with after a full
disk."""

import random
import resource
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from elastic_env.core.errors import ElasticError
from tests.test_training import BEGUN, PPO, SMALL, interrupted_after
from train.learn.checkpoint import recover_checkpoint, require_complete, write_checkpoint
from train.learn.train_config import TrainConfig
from train.learn.training import Training
from train.runs.failures import SYSTEM_FAILED, explain

FULL_DISKS = 3


def write(checkpoint: Path, text: str) -> None:
    with write_checkpoint(checkpoint) as fresh:
        (fresh / "one").write_text(text)
        (fresh / "two.json").write_text('{"count": 1}')


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training seed that was interrupted behind a checkpoint."""
    folder = tmp_path_factory.mktemp("trained")
    with pytest.raises(KeyboardInterrupt):
        Training(BEGUN, 1, folder).run(interrupted_after(32))
    return folder


def flip(file: Path, chance: random.Random) -> None:
    content = bytearray(file.read_bytes())
    content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    file.write_bytes(content)


def cut(file: Path, chance: random.Random) -> None:
    file.write_bytes(file.read_bytes()[: chance.randrange(file.stat().st_size)])


def repeat(file: Path, chance: random.Random) -> None:
    content = file.read_bytes()
    file.write_bytes(content + content[: chance.randrange(1, len(content))])


def renumber(file: Path, chance: random.Random) -> None:
    """Another digit somewhere: JSON remains JSON."""
    content = bytearray(file.read_bytes())
    digits = [at for at, byte in enumerate(content) if chr(byte).isdigit()]
    at = chance.choice(digits)
    content[at] = ord("0") + (content[at] - ord("0") + chance.randrange(1, 10)) % 10
    file.write_bytes(content)


def remove(file: Path, chance: random.Random) -> None:
    file.unlink()


def rename(file: Path, chance: random.Random) -> None:
    file.rename(file.with_name(f"{file.name}{chance.randrange(10)}"))


def replace(file: Path, chance: random.Random) -> None:
    """One file of the checkpoint in the place of another."""
    others = [other for other in sorted(file.parent.iterdir()) if other != file]
    shutil.copy(chance.choice(others), file)


@pytest.mark.parametrize("mutations", [100, pytest.param(300, marks=pytest.mark.slow)])
def test_a_mutated_checkpoint_is_refused_before_it_is_read(
    mutations: int, trained: Path, tmp_path: Path
) -> None:
    """Catches a file that is read without its digest, and a digest that misses some change."""
    chance = random.Random(26)
    path = tmp_path / "checkpoint"
    require_complete(trained / "checkpoint")
    for _ in range(mutations):
        shutil.copytree(trained / "checkpoint", path, dirs_exist_ok=True)
        file = chance.choice(sorted(path.iterdir()))
        mutate = chance.choice([flip, cut, repeat, renumber, remove, rename, replace])
        mutate(file, chance)
        with pytest.raises(ElasticError, match=r"damaged or incomplete .*; remove it"):
            require_complete(path)
        shutil.rmtree(path)


def test_a_failure_on_the_way_leaves_the_checkpoint_before_it(tmp_path: Path) -> None:
    """Catches a checkpoint that is removed before the new one is whole."""
    checkpoint = tmp_path / "checkpoint"
    write(checkpoint, "first")
    with pytest.raises(TypeError):
        write(checkpoint, None)  # type: ignore[arg-type]
    assert recover_checkpoint(checkpoint)
    require_complete(checkpoint)
    assert (checkpoint / "one").read_text() == "first"
    write(checkpoint, "third")
    assert (checkpoint / "one").read_text() == "third"


def test_a_kill_between_the_moves_loses_nothing(tmp_path: Path) -> None:
    """Catches a checkpoint that is only found under its own name."""
    checkpoint = tmp_path / "checkpoint"
    assert not recover_checkpoint(checkpoint)
    write(checkpoint, "first")
    checkpoint.rename(tmp_path / "checkpoint.old")
    assert recover_checkpoint(checkpoint)
    require_complete(checkpoint)


def test_no_thread_goes_on_writing_behind_a_training_that_was_ended(tmp_path: Path) -> None:
    """Catches TensorBoard's thread, which would print a traceback where the disk is full,
    between other words."""
    before = set(threading.enumerate())
    with pytest.raises(KeyboardInterrupt):
        Training(BEGUN, 1, tmp_path).run(interrupted_after(32))
    assert [
        type(thread).__name__
        for thread in set(threading.enumerate()) - before
        if "Writer" in str(type(thread))
    ] == []


@contextmanager
def full_beyond(size: int) -> Iterator[None]:
    """No file may become larger [bytes], as on a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.slow
def test_a_full_disk_is_one_sentence_and_the_training_goes_on(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Catches a library that hides a full disk, a thread that prints it, and a file that is half
    written and used."""
    config = TrainConfig(**{**SMALL, **PPO})
    chance = random.Random(14)
    Training(config, 1, tmp_path / "whole").run()
    for number in range(FULL_DISKS):
        folder = tmp_path / str(number)
        size = chance.choice([0, 300, 3_000, 30_000, chance.randrange(60_000)])
        with (
            full_beyond(size),
            pytest.raises(Exception) as caught,  # noqa: PT011
        ):
            Training(config, 1, folder).run()
        found = explain(caught.value)
        assert found is not None, caught.value
        assert found[0].count("\n") == 0
        assert found[1] == SYSTEM_FAILED
        Training(config, 1, folder).run()
        for file in ("last/weights.safetensors", "best/weights.safetensors", "progress.csv"):
            assert (folder / file).read_bytes() == (tmp_path / "whole" / file).read_bytes(), (
                size,
                file,
            )
    assert "Traceback" not in capfd.readouterr().err


def test_a_file_of_a_terabyte_is_refused_unread(tmp_path: Path) -> None:
    """Catches minutes of hashing holes, where somebody else wrote the folder."""
    checkpoint = tmp_path / "checkpoint"
    with write_checkpoint(checkpoint) as fresh:
        (fresh / "model.pt").write_bytes(b"x")
    with (checkpoint / "model.pt").open("r+b") as file:
        file.truncate(2**40)
    with pytest.raises(ElasticError, match=r"model.pt must have at most 2e\+09 bytes"):
        require_complete(checkpoint)
