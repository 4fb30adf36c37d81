"""The file of an archive: versions, damage, and a disk that is full."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import io
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from point_runs import (
    SMALL,
    assert_same_results,
    compile_once,
    damage,
    point_task,
    reference,
    run,
    writes_of,
)

from newton_qd import cli, files
from newton_qd.qd.config import read_config
from newton_qd.qd.run.archive import Archive, ArchiveError, archive_bytes, load_archive
from newton_qd.qd.run.checkpoint import (
    Checkpoint,
    CheckpointError,
    load_checkpoint,
    save_checkpoint,
)
from newton_qd.qd.run.folder import RunFolder
from newton_qd.qd.run.search import Search

__all__ = ["compile_once", "reference"]  # fixtures

STORED = Path(__file__).resolve().parent / "data" / "archive_format_1"
NAMES = ("genotypes", "fitnesses", "descriptors", "centroids")


def test_an_archive_that_was_written_once_can_be_read() -> None:
    archive = load_archive(STORED)
    assert archive.genotypes.shape == (16, 26)
    assert archive.filled.sum() == 13
    assert archive.fitnesses.max() == np.float32(7.9464636)
    assert np.all(archive.genotypes[~archive.filled] == 0)
    distance = np.abs(archive.descriptors[:, None] - archive.centroids).max(-1)
    assert np.array_equal(
        distance.argmin(1)[archive.filled], np.flatnonzero(archive.filled)
    )
    facts: Any
    config, facts = read_config(STORED / "config.json")
    assert (config.env_name, config.hidden, config.grid) == ("point", (4,), (4, 4))
    assert facts["packages"]["newton_qd"] == "0.1.0"


def small() -> Archive:
    rows = np.arange(6, dtype=np.float32).reshape(3, 2)
    return Archive(rows, np.array([1.0, -np.inf, 2.0], np.float32), rows, rows)


def write(folder: Path, content: bytes) -> Path:
    (folder / "archive.npz").write_bytes(content)
    return folder


def test_an_archive_comes_back(tmp_path: Path) -> None:
    archive = load_archive(write(tmp_path, archive_bytes(small())))
    for name in NAMES:
        assert np.array_equal(getattr(archive, name), getattr(small(), name))
    assert archive.filled.tolist() == [True, False, True]


def test_archives_without_a_number_have_the_first_format(tmp_path: Path) -> None:
    arrays = {name: getattr(small(), name) for name in NAMES}
    np.savez(tmp_path / "archive.npz", **arrays)
    assert np.array_equal(load_archive(tmp_path).fitnesses, small().fitnesses)


def test_what_is_no_archive_is_refused(tmp_path: Path) -> None:
    arrays = {name: getattr(small(), name) for name in NAMES}
    with pytest.raises(FileNotFoundError, match=r"has no archive\.npz; allowed"):
        load_archive(tmp_path)
    file = tmp_path / "archive.npz"
    file.write_bytes(b"")
    with pytest.raises(FileNotFoundError, match=r"folder: got .*, which has no a"):
        load_archive(file)
    file.unlink()
    for change, message in (
        ({"format": np.asarray(2)}, r"has format 2; this version .* reads format 1"),
        ({"colours": np.zeros(3)}, r"holds the arrays .*'colours'"),
        ({"format": np.ones(2)}, r"has format \[1. 1.\]"),
        ({"format": np.asarray("1")}, r"has format 1; this version .* reads format 1"),
        ({"fitnesses": np.zeros(2)}, r"do not fit together: .*'fitnesses': \(2,\)"),
        ({"fitnesses": np.zeros((3, 1))}, r"'fitnesses': \(3, 1\)"),
        ({"descriptors": np.zeros((3, 3))}, r"'descriptors': \(3, 3\)"),
        ({"genotypes": np.asarray(1.0)}, r"'genotypes': \(\)"),
        ({"genotypes": np.full((3, 2), "a")}, "genotypes are <U1, not floats"),
        ({"fitnesses": np.zeros(3, np.int32)}, "fitnesses are int32, not floats"),
    ):
        np.savez(tmp_path / "archive.npz", **{**arrays, **change})
        with pytest.raises(ArchiveError, match=message):
            load_archive(tmp_path)


def test_every_damage_of_an_archive_is_found(tmp_path: Path) -> None:
    content = archive_bytes(small())
    for name in ("empty", "half", "other file"):
        with pytest.raises(ArchiveError, match=r"archive\.npz is damaged"):
            load_archive(write(tmp_path, damage(content)[name]))
    data = content.find(small().fitnesses.tobytes())
    flipped = content[:data] + b"\xff" + content[data + 1 :]
    with pytest.raises(ArchiveError, match=r"archive\.npz is damaged.*CRC"):
        load_archive(write(tmp_path, flipped))
    bare = io.BytesIO()
    np.save(bare, np.zeros(3))
    with pytest.raises(ArchiveError, match=r"archive\.npz is damaged"):
        load_archive(write(tmp_path, bare.getvalue()))


def test_no_damaged_byte_raises_anything_else(tmp_path: Path) -> None:
    content = archive_bytes(small())
    kept = 0
    for at in range(len(content)):
        damaged = content[:at] + bytes([content[at] ^ 0x41]) + content[at + 1 :]
        with contextlib.suppress(ArchiveError):
            load_archive(write(tmp_path, damaged))
            kept += 1
    assert kept < len(content) / 2  # dates and the like are not read


# --- folders that cannot be written to -------------------------------------


def fail_at(patch: pytest.MonkeyPatch, moment: int) -> None:
    """The disk is full in write number ``moment`` and from then on."""
    fsync, calls = os.fsync, iter(range(10**6))

    def full(descriptor: int) -> None:
        if next(calls) >= moment:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(descriptor)

    patch.setattr(files.os, "fsync", full)


@pytest.mark.slow
def test_a_full_disk_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = SMALL.replace(iterations=2)
    expected = tmp_path / "expected"
    writes = len(writes_of(config, expected, monkeypatch))
    for moment in range(0, writes, 2):
        out = tmp_path / f"run{moment}"
        with (
            monkeypatch.context() as patch,
            pytest.raises(OSError, match=rf"No space left.*{out.name}") as caught,
        ):
            fail_at(patch, moment)
            run(config, out=out)
        assert caught.value.errno == errno.ENOSPC
        assert not [entry for entry in out.iterdir() if entry.name.endswith(".tmp")]
        run(config, out=out, resume=True)
        assert_same_results(out, expected)


def test_two_writers_of_one_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second one begins and ends while the first one writes."""
    path, sync = tmp_path / "archive.png", os.fsync

    def meanwhile(number: int) -> None:
        monkeypatch.setattr(files.os, "fsync", sync)
        files.write_atomically(path, b"second")
        assert path.read_bytes() == b"second"

    monkeypatch.setattr(files.os, "fsync", meanwhile)
    files.write_atomically(path, b"first")
    assert path.read_bytes() == b"first"
    assert list(tmp_path.iterdir()) == [path]


def test_what_killed_writers_left_is_removed(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    old, new = files.temporary_name(path), files.temporary_name(path)
    for part, age in ((old, 2 * 3600), (new, 60)):
        part.touch()
        then = time.time() - age
        os.utime(part, (then, then))
    files.write_atomically(path, b"page")
    assert not old.exists() and new.exists()  # another process may write it now
    assert path.read_bytes() == b"page"


def test_unfinished_files_of_a_killed_run_are_removed(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    left = [files.temporary_name(tmp_path / "checkpoint.bin") for _ in range(2)]
    left.append(tmp_path / ".metrics.csv.tmp")  # of an earlier version
    drawn = files.temporary_name(tmp_path / "archive.png")
    for part in (*left, drawn):
        part.touch()
    folder.check(resume=False)
    with folder.lock():
        # newton-qd plot may write it now
        assert list(tmp_path.iterdir()) == [drawn]


def test_a_read_only_folder_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(path: Path, mode: str) -> Any:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    monkeypatch.setattr(files, "open", refuse, raising=False)
    out = tmp_path / "run"
    arguments = ["evolve", "point", "--quiet", "--out", str(out)]
    assert cli.main(arguments, task_factory=point_task) == cli.FAILED
    assert f"Read-only file system: '{out}/config.json'" in capsys.readouterr().err
    assert not list(out.iterdir())


def test_a_checkpoint_of_another_version_is_refused(tmp_path: Path) -> None:
    """Those with number 1 have a column less."""
    path = tmp_path / "checkpoint.bin"
    path.write_bytes(b"newton_qd checkpoint 1 0\n")
    with pytest.raises(CheckpointError, match="not a checkpoint of this version"):
        load_checkpoint(path)


def test_metrics_that_an_earlier_version_did_not_have_are_not_known(
    reference: Path,
) -> None:
    found = load_checkpoint(reference / "checkpoint.bin")
    early = dataclasses.replace(found, metrics=found.metrics[:, :7])
    metrics = Search(SMALL, point_task(SMALL)).restore(early).metrics
    assert metrics.shape == found.metrics.shape
    assert np.array_equal(metrics[:, :7], early.metrics)
    assert np.isnan(metrics[:, 7:]).all()


def test_leaves_of_an_emitter_keep_their_order(tmp_path: Path) -> None:
    """Also from the tenth on, whose names sort before that of the second."""
    leaves = tuple(np.full(2, number, np.float32) for number in range(12))
    rows = np.zeros((3, 2), np.float32)
    stored = Checkpoint(
        "{}", 0, rows, rows[:, 0], rows, rows, np.zeros((1, 10)), leaves
    )
    save_checkpoint(tmp_path / "checkpoint.bin", stored)
    found = load_checkpoint(tmp_path / "checkpoint.bin").emitter
    np.testing.assert_array_equal(found, leaves)
