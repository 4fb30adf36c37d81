"""Results folders that lack a file, or have one that is damaged or of another run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from point_runs import assert_same_results, compile_once, point_task, reference, run

from newton_qd.qd import load_run
from newton_qd.qd.config import ConfigError
from newton_qd.qd.run.archive import ArchiveError
from newton_qd.qd.run.checkpoint import CheckpointError
from newton_qd.qd.run.opened import Run
from newton_qd.qd.run.results import read_archive

__all__ = ["compile_once", "reference"]  # fixtures


def opened(folder: Path) -> Run:
    return load_run(folder, task_factory=point_task)


def test_a_run_without_some_files(reference: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot read"):
        opened(tmp_path)
    out = tmp_path / "run"
    shutil.copytree(reference, out)
    (out / "archive.npz").unlink()  # as after kill -9
    whole = opened(out)
    (out / "archive.npz").write_bytes((reference / "archive.npz").read_bytes())
    (out / "checkpoint.bin").unlink()
    again = opened(out)
    assert np.array_equal(whole.archive.genotypes, again.archive.genotypes)
    for name, column in whole.metrics.items():
        assert np.array_equal(np.float32(column), np.float32(again.metrics[name]))
    (out / "checkpoint.bin").write_bytes(b"damaged")
    with pytest.warns(UserWarning, match=r"is read from archive\.npz instead") as seen:
        opened(out)
    assert seen[0].filename == __file__
    (out / "archive.npz").unlink()
    with pytest.raises(CheckpointError):
        opened(out)
    (out / "checkpoint.bin").unlink()
    with pytest.raises(FileNotFoundError):
        opened(out)
    (out / "archive.npz").write_bytes(b"damaged")
    with pytest.raises(ArchiveError):
        opened(out)


def test_metrics_are_not_newer_than_the_archive(
    reference: Path, tmp_path: Path
) -> None:
    """A run goes on beyond its end and is killed; then its checkpoint is damaged."""
    out = tmp_path / "run"
    shutil.copytree(reference, out)
    whole = opened(out)
    head, *rows = (out / "metrics.csv").read_text().splitlines()
    cells = rows[-1].split(",")
    column = head.split(",").index("coverage")
    cells[0], cells[column] = str(len(rows)), "99.5"
    later = "\n".join([head, *rows, ",".join(cells)]) + "\n"
    (out / "metrics.csv").write_text(later)
    (out / "checkpoint.bin").write_bytes(b"damaged")
    with pytest.warns(UserWarning, match=r"metrics up to that archive from metrics"):
        found = opened(out)
    assert found.iteration == whole.iteration
    assert found.metrics["coverage"][-1] == pytest.approx(
        100 * found.archive.filled.mean(), rel=1e-5
    )


def test_lists_without_an_end_are_damage(reference: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    shutil.copytree(reference, out)
    (out / "corrected.json").write_text("[" * 100_000)
    with pytest.warns(UserWarning, match=r"corrected\.json: got other content"):
        assert opened(out).reevaluated is None
    (out / "config.json").write_text("[" * 100_000)
    with pytest.raises(ConfigError, match=r"config\.json is not valid JSON"):
        opened(out)


def test_files_of_another_run_are_refused(reference: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    shutil.copytree(reference, out)
    text = (out / "config.json").read_text()
    (out / "config.json").write_text(text.replace('"hidden": [', '"hidden": [7,'))
    (out / "checkpoint.bin").unlink()
    with pytest.raises(ConfigError, match="weights of a policy of 'point' with hidden"):
        opened(out)
    (out / "config.json").write_text(text)
    metrics = (reference / "metrics.csv").read_text()
    for wrong in ("iteration,colour\n0,red\n", ""):
        (out / "metrics.csv").write_text(wrong)
        with pytest.raises(ConfigError, match="numbers with the columns iteration, e"):
            opened(out)
    (out / "metrics.csv").write_text(metrics[:-3])
    with pytest.raises(ConfigError, match=r"last line without an end, .*: whole lines"):
        opened(out)
    genotypes = opened(reference).archive.genotypes
    assert np.array_equal(read_archive(out).genotypes, genotypes), "a warm start"
    (out / "metrics.csv").write_text(metrics)
    whole = '{"reevaluations": 1, "qd_score": "a", "coverage": 1, "max_fitness": 1}'
    for text in ("[1]", "{", whole):
        (out / "corrected.json").write_text(text)
        with pytest.warns(UserWarning, match="an object of reevaluations, qd_score"):
            assert opened(out).reevaluated is None


def test_settings_are_those_of_the_checkpoint(reference: Path, tmp_path: Path) -> None:
    """With another seed, elites would begin elsewhere than in their run."""
    out = tmp_path / "run"
    shutil.copytree(reference, out)
    text = (out / "config.json").read_text()
    for name, other in (("seed", 5), ("episode_length", 7), ("hidden", [7])):
        document = json.loads(text)
        document["settings"][name] = other
        (out / "config.json").write_text(json.dumps(document))
        with pytest.raises(CheckpointError, match="run with other settings than conf"):
            opened(out)


def test_a_result_is_not_overwritten_without_its_state(
    reference: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    shutil.copytree(reference, out)
    (out / "checkpoint.bin").write_bytes(b"damaged")
    with pytest.raises(CheckpointError, match=r"delete it and archive\.npz$"):
        run(out=out, resume=True)
    (out / "checkpoint.bin").unlink()
    with pytest.raises(CheckpointError, match=r"missing, .*; delete archive\.npz, "):
        run(out=out, resume=True)
    assert (out / "archive.npz").read_bytes() == (
        reference / "archive.npz"
    ).read_bytes()
    (out / "archive.npz").unlink()
    (out / "corrected.json").write_text("{}")  # of the result that was there
    run(out=out, resume=True)
    assert not (out / "corrected.json").exists()
    assert_same_results(out, reference)
