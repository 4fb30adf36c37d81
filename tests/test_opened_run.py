"""A run that is opened again: its elites, their evaluation, and its pictures."""

from __future__ import annotations

import dataclasses
import pickle
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_runs import (
    SMALL,
    PointEnv,
    PointState,
    compile_once,
    point_task,
    reference,
    run,
)

import newton_qd
from newton_qd import cli
from newton_qd.qd import load_run, make_scoring_function
from newton_qd.qd.config import EvolveConfig
from newton_qd.qd.run import plot_curves
from newton_qd.qd.run.archive import Archive, load_archive
from newton_qd.qd.run.opened import Run
from newton_qd.qd.run.plot import plot_archive
from newton_qd.qd.run.plot_cells import voronoi_cells
from newton_qd.qd.run.plot_colours import round_ticks
from newton_qd.qd.run.reevaluation import Reevaluated

__all__ = ["compile_once", "reference"]  # fixtures


def opened(folder: Path) -> Run:
    return load_run(folder, task_factory=point_task)


@pytest.fixture(scope="module")
def found(reference: Path) -> Run:
    return opened(reference)


def call(*arguments: object) -> int:
    return cli.main([str(a) for a in arguments], task_factory=point_task)


def test_a_run_has_everything(found: Run, reference: Path) -> None:
    archive = load_archive(reference)
    assert found.config == SMALL and found.iteration == SMALL.iterations
    assert found.policy.size == archive.genotypes.shape[1]
    assert found.task.labels == ("left", "right")
    assert found.facts["backend"] == jax.default_backend()
    for name in ("genotypes", "fitnesses", "descriptors", "centroids"):
        stored = getattr(archive, name)
        assert np.array_equal(getattr(found.archive, name), stored)
        whole = np.asarray(getattr(found.repertoire, name)).reshape(stored.shape)
        assert np.array_equal(whole, stored)
    assert set(found.metrics) >= {"qd_score", "coverage", "max_fitness"}
    assert found.metrics["coverage"][-1] == np.float32(100 * archive.filled.mean())


def test_a_run_is_shown_in_one_line(found: Run, reference: Path) -> None:
    last = {name: values[-1] for name, values in found.metrics.items()}
    words = (
        f"me on point, {SMALL.iterations} generations, "
        f"QD score {last['qd_score']:,.0f}, "
        f"coverage {last['coverage']:.1f} %, best fitness {last['max_fitness']:,.1f}"
    )
    assert repr(found) == f"<Run {reference}: {words}>"
    assert repr(run(SMALL)) == f"<EvolveResult: {words}>"
    bare = dataclasses.replace(found, metrics={})
    assert repr(bare) == f"<Run {reference}: me on point>"
    filled, cells = len(found.cells), len(found.archive.centroids)
    shown = f"<Archive: {filled} of {cells} cells, {found.policy.size} weights each>"
    assert repr(found.archive) == shown


def test_a_run_takes_another_environment(found: Run) -> None:
    class Weak(PointEnv):
        def step(self, state: PointState, action: jax.Array) -> PointState:
            return super().step(state, jnp.float32(0.5) * action)

    other = found.with_env(Weak())
    assert np.array_equal(other.archive.fitnesses, found.archive.fitnesses)
    own, new = found.evaluate(), other.evaluate()
    assert np.array_equal(own.fitnesses, found.archive.fitnesses[own.cells])
    assert not np.array_equal(own.fitnesses, new.fitnesses)
    with pytest.raises(ValueError, match=r"^env: got an environment with 11 obs"):
        found.with_env(newton_qd.create("hopper", auto_reset=False))
    with pytest.raises(ValueError, match=r"^env: got an environment with auto-reset"):
        found.with_env(newton_qd.create("pointmaze"))
    with pytest.raises(ValueError, match=r"^env: got .* a batch; allowed: one world"):
        found.with_env(newton_qd.create("pointmaze", batch_size=2, auto_reset=False))
    wrong: Any = 3
    with pytest.raises(TypeError, match=r"^env: got 3"):
        found.with_env(wrong)


def test_elites_are_found(found: Run) -> None:
    archive = found.archive
    assert found.cells.tolist() == np.flatnonzero(archive.filled).tolist()
    best = found.best(3)
    assert best[0].fitness == archive.fitnesses.max()
    assert [e.fitness for e in best] == sorted((e.fitness for e in best), reverse=True)
    assert len(found.best(10**6)) == len(found.cells)
    for cell in found.cells[:3]:
        elite = found.elite(int(cell))
        assert np.array_equal(elite.genotype, archive.genotypes[cell])
        assert np.array_equal(elite.descriptor, archive.descriptors[cell])
        assert found.nearest(elite.descriptor)[0].cell in found.cells
        place = (archive.centroids[cell] * 4).astype(int).tolist()
        assert found.elite(place).cell == cell
    gaps = np.linalg.norm(archive.descriptors[found.cells] - [0.2, 0.9], axis=1)
    nearest = found.nearest([0.2, 0.9], count=2)
    assert nearest[0].cell == found.cells[gaps.argmin()] and len(nearest) == 2


def test_distances_are_in_units_of_the_limits(found: Run) -> None:
    near, far = found.cells[:2]
    descriptors = found.archive.descriptors.copy()
    descriptors[near], descriptors[far] = [0.4, 0.0], [0.0, 10.0]
    fitnesses = np.full_like(found.archive.fitnesses, -np.inf)
    fitnesses[[near, far]] = 1.0
    archive = dataclasses.replace(
        found.archive, descriptors=descriptors, fitnesses=fitnesses
    )
    limits = np.zeros(2), np.array([1.0, 100.0])
    task = dataclasses.replace(found.task, limits=limits)
    wide = dataclasses.replace(found, archive=archive, task=task)
    assert wide.nearest((0.0, 0.0))[0].cell == far


def test_wrong_cells_are_named(found: Run) -> None:
    for cell in (16, -1, 1.0, (4, 0), (0, 0, 0), [9]):
        with pytest.raises(IndexError, match=r"cell: got .*; allowed: "):
            found.elite(cell)  # type: ignore[arg-type]
    empty = np.flatnonzero(~found.archive.filled)
    if len(empty):
        with pytest.raises(LookupError, match="which is empty; allowed: one of the"):
            found.elite(int(empty[0]))
    wrong: Any = ["0.1", "0.2"]
    for descriptor in ([0.1], [0.1, np.nan], [0.1] * 3, wrong):
        with pytest.raises(ValueError, match="2 finite numbers: left, right"):
            found.nearest(descriptor)
    with pytest.raises(ValueError, match="count: got 0"):
        found.best(0)
    with pytest.raises(ValueError, match="descriptor: got 'a'; allowed: 2 finite num"):
        found.nearest("a")  # type: ignore[arg-type]
    for cell in ("a", "ab", ("a", "b"), 1.5, None):
        with pytest.raises(IndexError, match=r"^cell: got .*; allowed: "):
            found.elite(cell)  # type: ignore[arg-type]
    with pytest.raises(IndexError, match=r"^cell: got 1\.5"):
        found.evaluate(np.array([1.5]))
    for cell in (np.array([[0, 0], [0, 1]]), [(0, 0), (0, 1)]):
        with pytest.raises(
            ValueError, match=r"^cell: got .*; allowed: a row, rows \(N"
        ):
            found.evaluate(cell)  # type: ignore[arg-type]
    with pytest.raises(LookupError, match=r"^cell: got \[\], which names none"):
        found.evaluate([])
    with pytest.raises(TypeError, match=r"^keys: got 3; allowed: one key, .*an array"):
        found.evaluate(int(found.cells[0]), 3)  # type: ignore[arg-type]
    limits = tuple(limit[:1] for limit in found.task.limits)
    alone = dataclasses.replace(found.task, labels=("height",), limits=limits)
    with pytest.raises(ValueError, match=r"allowed: 1 finite number: height$"):
        dataclasses.replace(found, task=alone).nearest([0.1, 0.2])
    for load in (load_run, load_archive):
        with pytest.raises(
            TypeError, match=r"^folder: got None; allowed: a results fo"
        ):
            load(None)  # type: ignore[arg-type]


def test_an_evaluation_repeats_the_archive_bitwise(found: Run) -> None:
    archive, cells = found.archive, found.cells
    again = found.evaluate()
    assert np.array_equal(again.cells, cells)
    assert np.array_equal(again.fitnesses, archive.fitnesses[cells])
    assert np.array_equal(again.descriptors, archive.descriptors[cells])
    alone = found.evaluate(int(cells[1]))
    assert alone.fitnesses.shape == () and alone.descriptors.shape == (2,)
    assert alone.fitnesses == archive.fitnesses[cells[1]]
    place = tuple((archive.centroids[cells[1]] * 4).astype(int).tolist())
    assert found.evaluate(place).cells == cells[1]  # as ``elite`` reads it


def test_a_run_goes_to_other_processes(found: Run) -> None:
    found.evaluate(int(found.cells[0]))  # compiled functions do not pickle
    again = pickle.loads(pickle.dumps(found))
    assert again.config == found.config and again.path == found.path
    for name in ("fitnesses", "descriptors"):
        expected = getattr(found.evaluate(), name)
        assert np.array_equal(getattr(again.evaluate(), name), expected)


@pytest.mark.parametrize("kind", [jax.random.key, jax.random.PRNGKey])
def test_keys_are_other_start_states(found: Run, kind: type) -> None:
    cells = found.cells[:2]
    one = found.evaluate(cells, kind(3))
    assert one.fitnesses.shape == (2,) and one.descriptors.shape == (2, 2)
    keys = jax.random.split(kind(3), 20)
    many = found.evaluate(cells, keys)
    assert many.fitnesses.shape == (2, 20) and many.descriptors.shape == (2, 20, 2)
    assert len(np.unique(many.fitnesses[0])) > 1
    alone = found.evaluate(int(cells[1]), keys[:5])
    assert np.array_equal(alone.fitnesses, many.fitnesses[1, :5])
    if kind is jax.random.key:
        start = found.evaluate(cells, found.start_key)
        assert np.array_equal(start.fitnesses, found.archive.fitnesses[cells])


def test_eval_says_that_the_bits_are_the_same(
    reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    count = len(opened(reference).cells)
    assert call("eval", reference) == cli.OK
    printed = capsys.readouterr().out
    assert printed == (
        f"{count} elites of {reference}: fitness and descriptor are bitwise the same\n"
    )
    assert call("eval", reference, "--best", 2) == cli.OK
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[0] == "cell" and len(lines) == 4
    assert lines[1].endswith("yes") and "2 elites" in lines[3]
    assert call("eval", reference, "--near", "0.1,0.9", "--starts", 4) == cli.OK
    printed = capsys.readouterr().out
    assert "deviation" in printed and "medians over 4 start states" in printed
    assert "their median" not in printed  # of a single elite
    for best, over in ((["--best", 3], "these 3 elites"), ([], "all elites")):
        assert call("eval", reference, *best, "--starts", 4) == cli.OK
        printed = capsys.readouterr().out
        assert f"their median over {over} is" in printed
        assert "lost more than a tenth" in printed
    out = tmp_path / "run"
    shutil.copytree(reference, out)
    (out / "checkpoint.bin").unlink()  # it knows the seed
    text = (out / "config.json").read_text()
    (out / "config.json").write_text(text.replace('"seed": 0', '"seed": 1'))
    assert call("eval", out) == cli.FAILED
    printed = capsys.readouterr().out
    assert "have other results" in printed and "same bits" in printed


def test_eval_does_not_compare_returns_with_what_counts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = SMALL.replace(starts=2, scatter=1.0, iterations=0, reevaluations=0)
    run(config, out=tmp_path / "run")
    capsys.readouterr()
    assert call("eval", tmp_path / "run", "--starts", 2) == cli.OK
    printed = capsys.readouterr().out
    assert "fitness: with the price of scatter; again: without it" in printed
    assert "lost more" not in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--cell", "99"), "cell: got 99; allowed: integers from 0 to 15"),
        (("--near", "1,2,3"), "2 finite numbers: left, right"),
        (("--best", "0"), "--best: got 0"),
        (("--starts", "-1"), "--starts: got -1"),
        (("--seed", "3"), "--seed: got 3, which has no effect without --starts"),
        (
            ("--starts", "2", "--seed", "4294967296"),
            "--seed: got 4294967296; allowed: integers from 0 to 4294967295",
        ),
    ],
)
def test_eval_refuses(
    reference: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    message: str,
) -> None:
    assert call("eval", reference, *arguments) == cli.BAD_ARGUMENTS
    assert message in capsys.readouterr().err


def test_eval_takes_the_seeds_of_runs(
    reference: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = "--best", "1", "--starts", "2", "--seed", "4294967295"
    assert call("eval", reference, *options) == cli.OK
    assert capsys.readouterr().out


def test_eval_of_no_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("eval", tmp_path / "no") == cli.BAD_ARGUMENTS
    assert "no', which does not exist; allowed: a results folder, as" in (
        capsys.readouterr().err
    )
    assert call("eval", tmp_path) == cli.BAD_ARGUMENTS
    assert "cannot read" in capsys.readouterr().err


def test_plot_writes_both_pictures(
    reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "pictures"
    assert call("plot", reference, "--out", out) == cli.OK
    assert "written: " in capsys.readouterr().out
    drawn = (out / "archive.png").read_bytes()
    assert drawn == (reference / "archive.png").read_bytes()
    assert (out / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert call("plot", reference, "--out", out / "archive.png") == cli.BAD_ARGUMENTS
    foreign = out / "config.json"
    foreign.write_text('{"name": "a site", "settings": {"theme": "dark"}}')
    assert call("plot", reference, "--out", out) == cli.OK  # of another program
    shutil.copy(reference / "config.json", out)
    assert call("plot", reference, "--out", out) == cli.BAD_ARGUMENTS
    assert f"got {out}, the folder of another run" in capsys.readouterr().err
    # a run of a version with other settings
    foreign.write_text('{"format": 99, "settings": {}}')
    shutil.copy(reference / "checkpoint.bin", out)
    assert call("plot", reference, "--out", out) == cli.BAD_ARGUMENTS
    assert f"got {out}, the folder of another run" in capsys.readouterr().err
    missing = tmp_path / "missing"
    assert call("plot", missing) == cli.BAD_ARGUMENTS
    error = capsys.readouterr().err
    assert call("plot", missing, "--out", reference) == cli.BAD_ARGUMENTS
    assert capsys.readouterr().err == error


def test_curves_have_all_values() -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    rows = np.arange(5.0)
    names = ("evaluations", "qd_score", "coverage", "max_fitness")
    again = Reevaluated(reevaluations=8, qd_score=3.0, coverage=2.0, max_fitness=1.0)
    figure = plot_curves.curves_figure(
        dict.fromkeys(names, rows), EvolveConfig(), again
    )
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels == ["QD score", "coverage [%]", "best fitness"]
    for axes, last in zip(figure.axes, (3.0, 2.0, 1.0), strict=True):
        line, mark = axes.lines
        assert np.array_equal(line.get_ydata(), rows)
        assert np.array_equal(mark.get_xydata(), [[4.0, last]])
    (legend,) = figure.legends  # not on a curve
    FigureCanvasAgg(figure).draw()
    top = legend.get_window_extent().y1
    assert all(axes.get_tightbbox().y0 >= top for axes in figure.axes)
    assert [text.get_text() for text in legend.get_texts()] == [
        "archive",
        "elites evaluated again, medians of 8",
    ]


def test_cells_of_a_tessellation_fill_the_box() -> None:
    random = np.random.default_rng(0)
    low, high = np.array([-5.0, 0.0]), np.array([40.0, 2.0])
    centroids = random.uniform(low, high, (200, 2))
    cells = voronoi_cells(centroids, (low, high))
    area = 0.0
    for index, corners in enumerate(cells):
        x, y = corners.T
        area += 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
        # a corner is as far from its own centre as from the nearest one
        gaps = np.linalg.norm(corners[:, None] - centroids, axis=-1)
        assert np.allclose(gaps[:, index], gaps.min(axis=1), rtol=1e-9)
    assert area == pytest.approx(90.0, rel=1e-9)
    alone = voronoi_cells(centroids[:1], (low, high))
    assert len(alone) == 1 and len(alone[0]) == 4


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("grid", [False, True])
def test_pictures_show_cells_with_round_ticks(count: int, grid: bool) -> None:
    axis = (np.arange(8) + 0.5) / 8
    centroids = np.stack(np.meshgrid(*[axis] * count), -1).reshape(-1, count)
    centroids = (60 * centroids - 30).astype(np.float32)
    fitnesses = np.arange(len(centroids), dtype=np.float32)
    fitnesses[3] = -np.inf
    archive = Archive(np.zeros((len(centroids), 1)), fitnesses, centroids, centroids)
    limits = (np.full(count, -30.0), np.full(count, 30.0))
    figure = plot_archive(
        archive,
        grid=(8,) * count if grid else None,
        limits=limits,
        labels=("x", "y")[:count],
    )
    axes = figure.axes[0]
    ticks = [label.get_text() for label in axes.get_xticklabels()]
    assert ticks == ["-30", "-20", "-10", "0", "10", "20", "30"]
    if count == 1:
        assert len(axes.patches) == 8  # bars
        heights = [bar.get_height() for bar in axes.containers[1]]
        assert heights == [0, 1, 2, 4, 5, 6, 7]  # the empty cell has none
    elif not grid:
        (cells,) = axes.collections
        assert len(cells.get_paths()) == 64


def test_ticks_are_round() -> None:
    for low, high, texts in (
        (0, 1, "0 0.2 0.4 0.6 0.8 1"),
        (-5, 40, "0 10 20 30 40"),
        (0, 70, "0 10 20 30 40 50 60 70"),
    ):
        assert round_ticks(low, high)[1] == texts.split()


@pytest.mark.slow
def test_elites_of_an_ant_repeat_bitwise(tmp_path: Path) -> None:
    out = tmp_path / "ant"
    arguments = ["evolve", "ant_uni", "--quiet", "--batch-size", "16"]
    arguments += ["--episode-length", "20", "--iterations", "2", "--out", str(out)]
    assert cli.main(arguments) == cli.OK
    found = load_run(out)
    cells = found.cells
    for again in (found.evaluate(), found.evaluate(keys=found.start_key)):
        assert np.array_equal(again.fitnesses, found.archive.fitnesses[cells])
        assert np.array_equal(again.descriptors, found.archive.descriptors[cells])


@pytest.mark.slow
def test_a_scoring_function_of_ones_own_is_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from newton_qd.qd import algorithms
    from newton_qd.qd.algorithms.me import ME

    def doubled(config: EvolveConfig, options: Any, task: Any, policy: Any) -> Any:
        score = make_scoring_function(task, policy, config.episode_length)

        def scored(genotypes: jax.Array, key: jax.Array) -> Any:
            fitness, descriptor, extra = score(genotypes, key)
            return 2 * fitness, descriptor, extra

        return scored

    monkeypatch.setattr(algorithms, "_REGISTERED", {})
    spec = dataclasses.replace(ME, name="doubled", scoring=doubled)
    algorithms.register_algorithm(spec)
    result = run(SMALL.replace(algorithm="doubled", starts=2), out=tmp_path / "run")
    again = opened(tmp_path / "run").evaluate()
    filled = result.archive.filled
    assert np.array_equal(again.fitnesses, result.archive.fitnesses[filled])


@pytest.mark.slow
def test_new_starts_cannot_be_repeated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(SMALL.replace(new_starts=True, iterations=4), out=tmp_path / "run")
    assert call("eval", tmp_path / "run") == cli.OK
    assert "each generation had start states of its own" in capsys.readouterr().out


def test_runs_need_no_finished_run(tmp_path: Path) -> None:
    config = SMALL.replace(iterations=0)
    run(config, out=tmp_path / "run")
    assert opened(tmp_path / "run").iteration == 0
