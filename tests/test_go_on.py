"""Runs that go on beyond their end, and runs that start from an archive."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_runs import (
    SMALL,
    PointEnv,
    assert_same_results,
    compile_once,
    copy,
    interrupt_after,
    point_task,
    reference,
    run,
    snapshot,
)

from newton_qd import cli
from newton_qd.qd import load_run, make_policy, to_ribs
from newton_qd.qd.config import ConfigError, read_config, same_run, settings_text
from newton_qd.qd.run.archive import Archive, load_archive
from newton_qd.qd.run.checkpoint import CheckpointError
from newton_qd.qd.run.evolution import evolve
from newton_qd.qd.run.evolve_result import EvolveResult
from newton_qd.qd.run.folder import RunFolder
from newton_qd.qd.run.search import Search
from newton_qd.qd.run.warm_start import digest_of, start_genotypes

__all__ = ["compile_once", "reference"]  # fixtures

# QDax and what it imports warn about their own use of other packages.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

SHORT = SMALL.replace(iterations=5)
AGAIN = SMALL.replace(reevaluations=2)


def start_with(source: Any, config: Any = None, **options: Any) -> EvolveResult:
    config = SMALL.replace(iterations=1) if config is None else config
    return run(config, start_from=source, **options)


def test_a_run_goes_on_beyond_its_end(reference: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    run(SHORT, out=out)
    result = run(SMALL, out=out, resume=True)
    assert result.iteration == SMALL.iterations and not result.interrupted
    assert_same_results(out, reference)
    with pytest.raises(
        ConfigError, match=r"^iterations: got 5; allowed: 12 or more, as"
    ):
        run(SHORT, out=out, resume=True)


class Other(PointEnv):
    """Another environment of the same name, as another module may register it."""


class Longer(Other):
    observation_size = 4


@pytest.mark.parametrize(
    ("env", "width", "shown"),
    [
        (Other(), 2.0, r"centres of cells from \[0.125 0.125\] to .* to \[2. 2.\]"),
        (Longer(), 1.0, "genotypes of 26 numbers; allowed: 30, the weights"),
    ],
)
def test_a_run_goes_on_in_its_environment(
    env: Any, width: float, shown: str, reference: Path, tmp_path: Path
) -> None:
    out = copy(reference, tmp_path)
    limits = np.zeros(2, np.float32), np.full(2, width, np.float32)
    task = dataclasses.replace(point_task(SMALL, env), limits=limits)
    before = snapshot(out)
    more, options = SMALL.replace(iterations=14), {"out": out, "resume": True}
    with pytest.raises(ConfigError, match=f"^checkpoint: got {shown}"):
        evolve(more, task_factory=lambda _: task, progress=False, **options)
    assert snapshot(out) == before


@pytest.mark.usefixtures("sigint")
def test_a_stopped_run_may_end_earlier(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ends as a run that was started with so many generations."""
    out = tmp_path / "run"
    run(SHORT, out=tmp_path / "whole")
    with monkeypatch.context() as patch:
        interrupt_after(patch, 3)
        assert run(SMALL, out=out).interrupted
    with pytest.raises(ConfigError, match="got 2; allowed: 3 or more, as the run"):
        run(SMALL.replace(iterations=2), out=out, resume=True)
    result = run(SHORT, out=out, resume=True)
    assert result.iteration == SHORT.iterations and not result.interrupted
    assert_same_results(out, tmp_path / "whole")


def test_a_checkpoint_that_does_not_fit_changes_nothing(
    reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise CheckpointError("it does not fit")

    out = copy(reference, tmp_path)
    (out / "corrected.json").write_text("{}")
    before = snapshot(out)
    monkeypatch.setattr(Search, "restore", refuse)
    with pytest.raises(CheckpointError, match="it does not fit"):
        run(SMALL.replace(iterations=14), out=out, resume=True)
    assert snapshot(out) == before


def test_an_algorithm_that_cannot_go_on_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = SMALL.replace(algorithm="me-es")
    monkeypatch.setattr(Search, "advance", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run(config, out=tmp_path)
    before = snapshot(tmp_path)
    for iterations, text in (
        (20, r"got 20, but 'me-es' cannot go on beyond the end of a run; allowed: 12,"),
        (5, "got 5; allowed: 12, as the run in"),
    ):
        with pytest.raises(ConfigError, match=f"^iterations: {text}"):
            run(config.replace(iterations=iterations), out=tmp_path, resume=True)
    assert snapshot(tmp_path) == before


@pytest.mark.slow
def test_metrics_of_the_first_end_do_not_stay(tmp_path: Path) -> None:
    out = tmp_path / "run"
    run(AGAIN.replace(iterations=2), out=out)
    first = (out / "corrected.json").read_bytes()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Search, "advance", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            run(AGAIN.replace(iterations=4), out=out, resume=True)
    assert not (out / "corrected.json").exists()
    assert read_config(out / "config.json")[0].iterations == 4
    run(AGAIN.replace(iterations=4), out=out, resume=True)
    whole = tmp_path / "whole"
    run(AGAIN.replace(iterations=4), out=whole)
    assert_same_results(out, whole)
    again = (out / "corrected.json").read_bytes()
    assert again == (whole / "corrected.json").read_bytes() != first


def test_an_earlier_end_takes_its_reevaluations_along(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.start(SMALL, {})
    (tmp_path / "corrected.json").write_text("{}")
    folder.go_on(SMALL)
    assert (tmp_path / "corrected.json").exists()
    folder.go_on(SMALL.replace(iterations=20))
    assert not (tmp_path / "corrected.json").exists()


def test_metrics_without_their_state_do_not_stay(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.start(SMALL, {})
    (tmp_path / "metrics.csv").write_text("")
    folder.go_on(SMALL, anew=True)
    assert not (tmp_path / "metrics.csv").exists()


def test_the_command_goes_on(
    reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = copy(reference, tmp_path)
    arguments = ["evolve", "--resume", "--quiet", "--out", str(out)]
    longer = [*arguments, "--iterations", "14"]
    assert cli.main(longer, task_factory=point_task) == cli.OK
    assert "in 14 generations" in capsys.readouterr().out
    assert cli.main(arguments, task_factory=point_task) == cli.OK  # the new end
    rows = (out / "metrics.csv").read_text().splitlines()
    assert len(rows) == 16
    assert rows[:14] == (reference / "metrics.csv").read_text().splitlines()


def test_settings_of_earlier_versions_have_defaults() -> None:
    old = settings_text(SMALL).replace(', "warm_start": null', "")
    assert "warm_start" not in old and same_run(old, settings_text(SMALL))
    assert not same_run(old, settings_text(SMALL.replace(warm_start="x")))
    assert same_run(old, settings_text(SMALL.replace(iterations=99)))


def network_parameters(genotypes: np.ndarray) -> Any:
    policy = make_policy(point_task(SMALL).env, SMALL.hidden)
    return jax.vmap(policy.unravel)(jnp.asarray(genotypes))


@pytest.mark.parametrize(
    "kind",
    [
        "folder",
        "qdax",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("text", "run", "archive", "ribs")
        ),
    ],
)
def test_a_run_starts_from_any_archive(reference: Path, kind: str) -> None:
    opened = load_run(reference, task_factory=point_task)
    source: Any = reference
    if kind == "text":
        source = str(reference)
    elif kind == "run":
        source = opened
    elif kind == "archive":
        source = opened.archive
    elif kind == "qdax":  # genotypes of QDax are parameters of a network
        parameters = network_parameters(opened.archive.genotypes)
        source = opened.repertoire.replace(genotypes=parameters)
    elif kind == "ribs":
        source = to_ribs(opened.archive, opened.task.limits, (4, 4))
    result = start_with(source)
    # the task and the start state are the same, so every elite is there again
    old, new = opened.archive.fitnesses, result.archive.fitnesses
    assert np.all(new >= old) and opened.archive.filled.sum() <= SMALL.batch_size
    assert result.metrics["evaluations"].tolist() == [16, 32]
    assert result.metrics["max_fitness"][0] >= old.max()
    expected = start_with(reference)
    assert np.array_equal(result.archive.genotypes, expected.archive.genotypes)
    assert result.config.warm_start == expected.config.warm_start is not None


def test_more_elites_than_a_generation(reference: Path) -> None:
    few = SMALL.replace(batch_size=4, iterations=1)
    elites = load_archive(reference)
    result = start_with(reference, few)
    count = int(elites.filled.sum())
    assert count > 8
    assert result.metrics["evaluations"].tolist() == [count, count + 4]
    assert np.all(result.archive.fitnesses >= elites.fitnesses)


def test_unfit_elites_are_counted(reference: Path) -> None:
    elites = load_archive(reference)
    size = elites.genotypes.shape[1]
    right = np.zeros(size, np.float32)
    right[np.argsort(elites.genotypes[elites.filled][0])] = 30.0  # leads to a fault
    bad = np.tile(right, (9, 1))
    fitnesses = np.full(9, 100.0, np.float32)
    joined = Archive(
        np.concatenate([elites.genotypes, bad]),
        np.concatenate([elites.fitnesses, fitnesses]),
        np.concatenate([elites.descriptors, elites.descriptors[:9]]),
        np.concatenate([elites.centroids, elites.centroids[:9]]),
    )
    config = SMALL.replace(batch_size=4, iterations=1)
    assert start_with(joined, config).metrics["rejected"][0] >= 9


def test_an_unfit_elite_is_counted_once(reference: Path) -> None:
    """Not once more for each row that fills the last batch."""
    elites = load_archive(reference)
    genotypes = elites.genotypes[elites.filled]
    bad = np.zeros((1, genotypes.shape[1]), np.float32)
    bad[0, np.argsort(genotypes[0])] = 30.0  # leads to a fault
    places = np.zeros((6, 2), np.float32)
    fitnesses = np.array([9, 8, 7, 6, 5, -5], np.float32)
    joined = Archive(np.concatenate([genotypes[:5], bad]), fitnesses, places, places)
    config = SMALL.replace(batch_size=4, iterations=1)
    assert start_with(joined, config).metrics["rejected"][0] == 1


def test_a_warm_run_starts_from_the_best_elites_first() -> None:
    policy = make_policy(point_task(SMALL).env, (4,))
    rows = np.arange(3 * policy.size, dtype=np.float32).reshape(3, -1)
    places = np.zeros((3, 2), np.float32)
    archive = Archive(rows, np.array([1.0, 3.0, 2.0], np.float32), places, places)
    assert np.array_equal(start_genotypes(archive, policy), rows[[1, 2, 0]])


def test_the_digest_of_a_start_is_that_of_all_its_genotypes() -> None:
    genotypes = np.zeros((2, 3), np.float32)
    before = digest_of(genotypes)
    genotypes[1, 2] = 1
    assert digest_of(genotypes) != before


@pytest.mark.usefixtures("sigint")
def test_a_warm_run_resumes_bit_by_bit(
    reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, out = tmp_path / "whole", tmp_path / "run"
    start_with(reference, SHORT, out=whole)
    with monkeypatch.context() as patch:
        patch.setattr(Search, "advance", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            start_with(reference, SHORT, out=out)
    assert sorted(e.name for e in out.iterdir()) == ["config.json", "start.npz"]
    config = read_config(out / "config.json")[0]
    with monkeypatch.context() as patch:
        interrupt_after(patch, 2)
        run(config, out=out, resume=True)
    run(config, out=out, resume=True)
    assert_same_results(out, whole)
    # killed between the two first files
    fresh = tmp_path / "fresh"
    fresh.mkdir()
    (fresh / "start.npz").write_bytes(b"half")
    start_with(reference, SHORT, out=fresh)
    assert_same_results(fresh, whole)


def test_wrong_archives_are_refused(reference: Path, tmp_path: Path) -> None:
    elites = load_archive(reference)

    def changed(**arrays: np.ndarray) -> Archive:
        return Archive(**{**vars(elites), **arrays})

    worst = np.full_like(elites.fitnesses, -np.inf)
    nan = np.where(elites.filled, np.nan, -np.inf)
    for source, text in (
        (tmp_path, "which has no archive; allowed: a results folder"),
        (3, "start_from: got 3; allowed: a results folder, a Run"),
        (changed(fitnesses=worst), "got an empty archive"),
        (changed(fitnesses=nan), "an archive with NaN as fitness of"),
        (changed(fitnesses=np.ones((16, 2))), r"one fitness in each cell"),
        (changed(genotypes=elites.genotypes[:, 1:]), r"allowed: \(cells, 26\), the w"),
        (changed(genotypes=np.full_like(elites.genotypes, np.inf)), "finite weights"),
    ):
        with pytest.raises(ConfigError, match=text):
            start_with(source)
    # settings of a warm run need their archive
    config = start_with(reference).config
    with pytest.raises(
        ConfigError, match="start_from: got nothing; allowed: the archive"
    ):
        run(config)
    other = Archive(**{**vars(elites), "genotypes": elites.genotypes + 1})
    with pytest.raises(ConfigError, match="start_from: got genotypes with SHA-256"):
        start_with(other, config)
    out = tmp_path / "run"
    run(SHORT, out=out)
    refused = r"start_from: got genotypes with .*; allowed: no archive"
    with pytest.raises(ConfigError, match=refused):
        start_with(reference, SHORT, out=out, resume=True)


def test_a_damaged_start_is_refused(reference: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    config = start_with(reference, out=out).config
    (out / "checkpoint.bin").unlink()
    (out / "archive.npz").unlink()
    content = (out / "start.npz").read_bytes()
    for damaged in (b"", content[:-100], b"PK\3\4 something else"):
        (out / "start.npz").write_bytes(damaged)
        with pytest.raises(CheckpointError, match=r"start\.npz is damaged"):
            run(config, out=out, resume=True)
    (out / "start.npz").unlink()
    with pytest.raises(ConfigError, match="start_from: got nothing; allowed: the arch"):
        run(config, out=out, resume=True)
    buffer = io.BytesIO()
    np.savez(buffer, genotypes=np.zeros((3, 26), np.float32))
    (out / "start.npz").write_bytes(buffer.getvalue())
    with pytest.raises(ConfigError, match="start_from: got genotypes with SHA-256"):
        run(config, out=out, resume=True)


def test_the_command_starts_from_a_folder(reference: Path, tmp_path: Path) -> None:
    point = ["evolve", "point", "--quiet", "--iterations", "1", "--batch-size", "16"]
    point += ["--episode-length", "9", "--hidden", "4", "--grid", "4x4"]
    point += ["--reevaluations", "0", "--start-from", str(reference)]
    out = tmp_path / "run"
    done = cli.main([*point, "--out", str(out)], task_factory=point_task)
    assert done == cli.OK
    expected = start_with(reference).archive
    assert np.array_equal(load_archive(out).genotypes, expected.genotypes)
