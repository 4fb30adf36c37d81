"""The explorer in a browser: maps of all kinds, and the elites of their cells."""

from __future__ import annotations

import base64
import dataclasses
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from browser import Pages, chrome, pages

import newton_qd
from newton_qd import cli
from newton_qd.qd import EvolveConfig, Policy, Task
from newton_qd.qd.run.archive import Archive
from newton_qd.qd.run.folder import COLUMNS
from newton_qd.qd.run.opened import Run
from newton_qd.qd.run.reevaluation import Reevaluated
from newton_qd.qd.run.search import start_key
from newton_qd.viewing import (
    Drawing,
    Trajectory,
    drawing_of,
    record,
    write_explorer,
    write_replay,
)
from newton_qd.viewing.elites import record_elites
from newton_qd.viewing.explorer import (
    _metrics,
    _motion_data,
    _moving,
    _run_data,
    explorer_html,
)

__all__ = ["chrome", "pages"]  # fixtures

STEPS = 8
KEY = jax.random.key(0)
HOSTILE = "</script><script>window.hacked=1</script>\u202e"


def opened(
    name: str,
    dimensions: int,
    grid: tuple[int, ...] | None,
    seed: int = 0,
    steps: int = STEPS,
) -> Run:
    """A run of the point maze without an evolution: its policies are one action."""
    env: Any = newton_qd.create("pointmaze", episode_length=steps, auto_reset=False)
    rng = np.random.default_rng(seed)
    limits = np.zeros(dimensions), np.ones(dimensions)
    if grid is None:
        centroids = rng.uniform(0, 1, (40, dimensions))
    else:
        axes = [(np.arange(count) + 0.5) / count for count in grid]
        centroids = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
        centroids = centroids.reshape(-1, dimensions)
    cells = len(centroids)
    fitnesses = np.where(
        rng.uniform(size=cells) < 0.7, rng.uniform(size=cells), -np.inf
    )
    fitnesses[:2] = 0.5, -np.inf
    filled = np.isfinite(fitnesses)
    archive = Archive(
        genotypes=rng.uniform(-1, 1, (cells, 2)).astype(np.float32),
        fitnesses=fitnesses.astype(np.float32),
        descriptors=np.where(filled[:, None], centroids, 0).astype(np.float32),
        centroids=centroids.astype(np.float32),
    )
    policy = Policy(
        size=2,
        init=lambda key: jax.random.normal(key, (2,)),
        unravel=lambda weights: weights,
        apply=lambda weights, observation: weights + 0 * observation,
        ravel=lambda weights: weights,
        network=None,
    )
    task = Task(
        env=env,
        descriptor_extractor=lambda data, mask: data.state_desc[:, -1],
        limits=limits,
        labels=tuple(f"{name} {k}" for k in range(dimensions)),
        reward_offset=0.0,
    )
    config = EvolveConfig(
        env_name="pointmaze",
        episode_length=steps,
        hidden=(),
        grid=grid,
        centroids=None if grid else cells,
    )
    return Run(
        path=Path(f"{name} {seed}"),
        config=config,
        facts={},
        task=task,
        policy=policy,
        archive=archive,
        metrics={column: np.arange(4.0) for column in COLUMNS},
        reevaluated=Reevaluated(4, 1.0, 2.0, 3.0),
        start_key=jax.random.key(0),
    )


def last(page: Any, world: int = 0) -> np.ndarray:
    """Last position of the point that a world of the player shows."""
    code = f"""(() => {{
        const d = NQD.player.data, w = {world};
        const at = 2 * (d.q.shape[1] * w + d.lengths[w]);
        return Array.from(d.q.data.slice(at, at + 2));
    }})()"""
    return np.array(page.evaluate(code))


def expected(run: Run, cell: int) -> np.ndarray:
    action = jnp.asarray(run.archive.genotypes[cell])
    found = record(run.task.env, jnp.tile(action, (STEPS, 1)), run.start_key)
    return found.q[0, STEPS]


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.parametrize("kind", ["grid", "nested", "cells", "lines"])
def test_a_click_shows_the_elite(kind: str, pages: Pages, tmp_path: Path) -> None:
    dimensions, grid = {
        "grid": (2, (5, 4)),
        "nested": (4, (3, 2, 3, 2)),
        "cells": (2, None),
        "lines": (5, None),
    }[kind]
    run = opened(kind, dimensions, grid)
    page = pages.open(write_explorer([run], tmp_path / "e.html"), width=700, height=600)
    best = run.best()[0].cell
    assert f"cell {best}" in page.inner_text("#facts")
    assert np.allclose(last(page), expected(run, best), atol=1e-3)
    # the pixel of a cell belongs to the elite of the cell
    cell = int(run.cells[len(run.cells) // 2])
    elite = int(np.searchsorted(run.cells, cell))
    spot = page.evaluate(f"[NQD.maps[0].u[{elite}], NQD.maps[0].v[{elite}]]")
    if kind == "lines":
        spot = [0.0, float(run.archive.descriptors[cell, 0])]
    box = page.evaluate("NQD.maps[0].box")
    place = {
        "x": box["x"] + spot[0] * box["w"] + 0.5,
        "y": box["y"] + (1 - spot[1]) * box["h"] - 0.5,
    }
    page.locator(".map").click(position=place)
    assert f"cell {cell}," in page.inner_text("#facts")
    assert np.allclose(last(page), expected(run, cell), atol=1e-3)
    assert f"elite({cell})" in page.inner_text(".tools code")
    height = "NQD.maps[0].v[NQD.maps[0].selected]"
    before = page.evaluate(height)
    page.keyboard.press("ArrowUp" if before < 0.5 else "ArrowDown")
    assert (page.evaluate(height) - before) * (0.5 - before) > 0
    shown = page.evaluate("NQD.maps[0].selected")
    assert f"cell {run.cells[shown]}," in page.inner_text("#facts")
    # the keys of a control are its own
    slider = page.locator("#maps input[type=range]")
    slider.focus()
    least = float(slider.input_value())
    page.keyboard.press("ArrowRight")
    assert float(slider.input_value()) > least
    assert page.evaluate("NQD.maps[0].selected") == shown


@pytest.mark.slow
@pytest.mark.browser
def test_two_runs_filter_colour_and_hostile_names(pages: Pages, tmp_path: Path) -> None:
    runs = [opened(HOSTILE, 2, (5, 4), seed) for seed in (0, 1)]
    page = pages.open(write_explorer(runs, tmp_path / "e.html"), width=900, height=700)
    assert page.evaluate("window.hacked === undefined")
    assert page.locator("h2").all_text_contents() == [str(run.path) for run in runs]
    assert (
        page.locator("h2").first.evaluate("e => getComputedStyle(e).unicodeBidi")
        == "isolate"
    )
    for world, run in enumerate(runs):
        assert np.allclose(
            last(page, world), expected(run, run.best()[0].cell), atol=1e-3
        )
    for index, run in enumerate(runs):  # also the elite at the slider's first value
        shown = page.evaluate(f"Array.from(NQD.maps[{index}].shown)")
        assert shown == [1] * len(run.cells)
    least = float(np.median(runs[0].archive.fitnesses[runs[0].cells]))
    page.locator("#maps input[type=range]").fill(str(least))
    for index, run in enumerate(runs):
        shown = page.evaluate(f"Array.from(NQD.maps[{index}].shown)")
        fitness = run.archive.fitnesses[run.cells]
        # the slider rounds
        sure = np.abs(fitness - least) > 1e-3
        assert np.array_equal(np.array(shown)[sure] > 0, (fitness >= least)[sure])
    page.locator("#maps select").select_option(label="steps before the end")
    values = page.evaluate("Array.from(NQD.maps[0].values)")
    assert values == [STEPS] * len(runs[0].cells)
    assert "re-evaluated 4 times" in page.inner_text(".curves")
    with page.expect_download() as info:
        page.locator(".tools button").first.click()
    stored = info.value.path().read_text(encoding="utf-8")
    assert f'"cell":{runs[0].best()[0].cell}' in stored and '"genotype":[' in stored


@pytest.mark.slow
@pytest.mark.browser
def test_a_screen_reader_has_names(pages: Pages, tmp_path: Path) -> None:
    """Of every picture, and of every button whose text is a symbol."""
    run = opened(HOSTILE, 2, (5, 4))
    page = pages.open(write_explorer([run], tmp_path / "e.html"))
    names = "[...document.querySelectorAll('canvas')].map((e) => "
    names += "e.getAttribute('role') + ': ' + e.getAttribute('aria-label'))"
    assert page.evaluate(names) == [
        f"application: archive of {run.path}, arrow keys choose an elite",
        *(f"img: curve of {name}" for name in ("qd score", "coverage", "max fitness")),
        "img: pointmaze in motion",
        "img: chart of reward of a step",
    ]
    words = page.get_by_role("button", name=re.compile(r"^[\w ]+$"))
    assert words.count() == page.locator("button").count() == 4
    said = page.get_by_role("status").inner_text()
    page.locator("canvas.map").focus()
    page.keyboard.press("ArrowUp")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowLeft")
    assert said.startswith("cell ") and said != page.get_by_role("status").inner_text()
    plan = jnp.zeros((2, 2))
    replay = write_replay(record(run.task.env, plan, KEY), tmp_path / "r.html")
    page = pages.open(replay)
    assert not [text for text in page.evaluate(names) if "null" in text]
    assert page.get_by_role("button", name=re.compile(r"^[\w ]+$")).count() == 3


@pytest.mark.slow
@pytest.mark.browser
def test_a_run_of_many_generations_has_a_page(pages: Pages, tmp_path: Path) -> None:
    """A function takes fewer arguments than such a run has generations."""
    run = opened("grid", 2, (5, 4))
    metrics = {name: np.arange(200_000.0) for name in run.metrics}
    run = dataclasses.replace(run, metrics=metrics)
    page = pages.open(write_explorer([run], tmp_path / "e.html"))
    assert "curves over 0 \u2026 199999 evaluations" in page.inner_text(".curves")


@pytest.mark.slow
@pytest.mark.browser
def test_controls_fit_a_narrow_page(pages: Pages, tmp_path: Path) -> None:
    run = opened("grid", 2, (5, 4))
    labels = "mean proportion of a very long name", "right"
    run = dataclasses.replace(run, task=dataclasses.replace(run.task, labels=labels))
    target = write_explorer([run], tmp_path / "e.html")
    page = pages.open(target, width=320, height=500)
    right = "Math.max(...[...document.querySelectorAll('.bar *')]"
    right += ".map((each) => each.getBoundingClientRect().right))"
    assert page.evaluate(right) <= 320


def test_scenes_are_not_mixed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The page has one drawing: a robot would move among walls that it never had."""
    runs = [opened("grid", 2, (5, 4), seed) for seed in (0, 1)]
    done: list[tuple[int, int]] = []
    assert explorer_html(runs, progress=lambda *count: done.append(count))
    counts = [len(run.cells) for run in runs]
    assert done == [(counts[0], sum(counts)), (sum(counts), sum(counts))]
    recorded = []

    def record(*arguments: Any, **options: Any) -> Any:
        found = record_elites(*arguments, **options)
        shapes = found.drawing.shapes[: -len(recorded) or None]
        recorded.append(found)
        drawing = dataclasses.replace(found.drawing, shapes=shapes)
        return dataclasses.replace(found, drawing=drawing)

    monkeypatch.setattr("newton_qd.viewing.explorer.record_elites", record)
    with pytest.raises(ValueError, match=r"runs: got .*; allowed: .*same scene"):
        explorer_html(runs)


@pytest.mark.parametrize(("steps", "every"), [(1, 1), (6, 2), (7, 1)])
def test_the_last_step_is_seen(steps: int, every: int) -> None:
    text = explorer_html([opened("grid", 2, (5, 4), steps=steps)])
    found = re.search(r'"every": ?(\d+), ?"lengths": ?\[(\d+)', text)
    assert found is not None
    assert [int(x) for x in found.groups()] == [every, steps // every]
    assert f'"dt":{every}.0,' in text  # of a frame


def test_a_large_archive_is_thinned(monkeypatch: pytest.MonkeyPatch) -> None:
    run = opened("grid", 2, (5, 4))
    monkeypatch.setattr("newton_qd.viewing.explorer._FIXED", 10e6 - 200)
    text = explorer_html([run])
    count = len(run.cells)
    assert f" of {count} elites move, so that the page is below 10 MB" in text


@pytest.mark.parametrize(("generations", "cells"), [(200_000, 5), (10, 60)])
def test_curves_and_maps_are_part_of_the_size(
    generations: int, cells: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = opened("grid", 2, (cells, cells), steps=40)
    metrics = {name: np.arange(float(generations)) for name in run.metrics}
    run = dataclasses.replace(run, metrics=metrics)
    monkeypatch.setattr("newton_qd.viewing.explorer._LARGEST_PAGE", 1.1e6)
    text = explorer_html([run])
    assert len(text) < 1.1e6
    thinned = f" of {len(run.cells)} elites move" in text
    assert thinned is (cells == 60)


def test_meshes_are_part_of_the_size(monkeypatch: pytest.MonkeyPatch) -> None:
    run = opened("grid", 2, (20, 20), steps=40)
    mesh = dataclasses.replace(
        drawing_of(run.task.env).shapes[0],
        kind="mesh",
        vertices=np.zeros((10_000, 3), np.float32),
        faces=np.zeros((5_000, 3), np.int32),
    )

    def with_mesh(env: Any) -> Drawing:
        found = drawing_of(env)
        return dataclasses.replace(found, shapes=(*found.shapes, mesh))

    for module in ("explorer", "recording"):
        monkeypatch.setattr(f"newton_qd.viewing.{module}.drawing_of", with_mesh)
    monkeypatch.setattr("newton_qd.viewing.explorer._LARGEST_PAGE", 1.0e6)
    text = explorer_html([run])
    assert '"kind":"mesh"' in text and len(text) < 1.0e6
    assert f" of {len(run.cells)} elites move" in text


def pushed(run: Run, worlds: int) -> Trajectory:
    """Four steps, of which an episode may have fewer."""
    return record(run.task.env, jnp.tile(jnp.array([0.5, 0.0]), (worlds, 4, 1)), KEY)


def test_a_loss_is_positive_if_the_archive_is_better(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def evaluate(run: Run, cells: Any, keys: Any) -> Any:
        return SimpleNamespace(fitnesses=np.tile([-1.0, 9.0, 0.25], (len(cells), 1)))

    monkeypatch.setattr(Run, "evaluate", evaluate)
    run = opened("grid", 2, (5, 4))
    found = _metrics(run, run.cells, pushed(run, len(run.cells)), 3, 0)
    assert np.all(found["median fitness from 3 other starts"] == 0.25)
    assert np.array_equal(found["loss from other starts"], found["fitness"] - 0.25)


def test_other_starts_are_not_the_start_of_the_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen = []

    def evaluate(run: Run, cells: Any, keys: Any) -> Any:
        seen.append(keys)
        return SimpleNamespace(fitnesses=np.zeros((len(cells), len(keys))))

    monkeypatch.setattr(Run, "evaluate", evaluate)
    run = opened("grid", 2, (5, 4))
    _metrics(run, run.cells, pushed(run, len(run.cells)), 3, seed=0)
    assert [keys.shape for keys in seen] == [(3,)]
    assert not np.any(seen[0] == start_key(0))


def test_distances_are_up_to_the_end() -> None:
    run = opened("grid", 2, (5, 4), steps=2)
    found = _metrics(run, run.cells, pushed(run, len(run.cells)), 0, 0)
    np.testing.assert_allclose(found["distance from the start [-]"], 0.1, rtol=1e-4)
    walk = pushed(run, len(run.cells))
    mean = walk.rewards[:, :2].mean(axis=1)
    np.testing.assert_allclose(found["mean reward of a step"], mean, rtol=1e-6)
    # a hop is no distance: the first slide now goes up
    axes = np.roll(np.eye(3)[:2], -1, axis=1)
    walk = dataclasses.replace(
        walk, drawing=dataclasses.replace(walk.drawing, joint_axis=axes)
    )
    found = _metrics(run, run.cells, walk, 0, 0)
    np.testing.assert_allclose(found["distance from the start [-]"], 0.0, atol=1e-6)


def test_motion_belongs_to_its_elite() -> None:
    run = opened("grid", 2, (5, 4))
    found = _run_data(run, run.cells[1:3], pushed(run, 2), 1, 0, 0)
    numbers = np.frombuffer(base64.b64decode(found["moving"]["data"]), np.int32)
    assert numbers.tolist() == [1, 2]
    rows = {row["name"]: row["values"] for row in found["metrics"]}
    steps = base64.b64decode(rows["steps before the end"]["data"])
    known = np.isfinite(np.frombuffer(steps, np.float32))
    assert np.flatnonzero(known).tolist() == [1, 2]
    for index, label in enumerate(found["labels"]):
        values = base64.b64decode(rows[label]["data"])
        wanted = run.archive.descriptors[run.cells, index]
        assert np.array_equal(np.frombuffer(values, np.float32), wanted)
    assert (found["low"], found["high"]) == ([0.0, 0.0], [1.0, 1.0])


def test_the_best_elite_moves_in_any_page() -> None:
    run = opened("grid", 2, (5, 4))
    for best in run.cells:
        fitnesses = run.archive.fitnesses.copy()
        fitnesses[best] = 2.0
        archive = dataclasses.replace(run.archive, fitnesses=fitnesses)
        assert best in _moving(dataclasses.replace(run, archive=archive), 1.0, 1)


def test_elites_begin_where_their_run_began() -> None:
    run = dataclasses.replace(opened("grid", 2, (5, 4)), start_key=jax.random.key(7))
    start = run.task.env.reset(run.start_key).obs
    np.testing.assert_allclose(record_elites(run, run.cells[:1]).q[0, 0], start[:2])


def test_elites_begin_at_a_start_that_counted() -> None:
    run = opened("grid", 2, (5, 4))
    run = dataclasses.replace(run, config=run.config.replace(starts=3))
    first = jax.random.split(run.start_key, 3)[0]
    start = run.task.env.reset(first).obs
    np.testing.assert_allclose(record_elites(run, run.cells[:1]).q[0, 0], start[:2])


def test_wrong_runs_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="runs: got 0 runs; allowed: one run or two"):
        explorer_html([])
    for command in ("explore", "replay", "render"):  # before anything is read
        assert cli.main([command, "ant", "--out", "no_folder/x.gif"]) == 2
        refused = "--out: got 'no_folder/x.gif', and no_folder is no folder; allowed: a"
        assert refused in capsys.readouterr().err
    for command in ("explore", "replay"):  # a file of the run would be lost
        assert cli.main([command, "ant", "--out", "config.json"]) == 2
        refused = "--out: got 'config.json'; allowed: files that end with .html"
        assert refused in capsys.readouterr().err
        assert cli.main([command, "no_run", "--out", "A.HTML"]) != 0
        assert "--out: got" not in capsys.readouterr().err
    assert cli.main(["explore", "a", "b", "c"]) == 2
    assert "DIR: got 3 folders; allowed: one folder or two" in capsys.readouterr().err


def test_the_feet_of_a_page_are_those_of_the_descriptor() -> None:
    """At the start of each step, so not in the last state."""
    feet = np.array([1, 1, 0, 1, 0])[None, :, None]
    shown: Any = SimpleNamespace(
        q=np.zeros((1, 5, 1)),
        steps=4,
        lengths=np.array([4]),
        rewards=np.ones((1, 4)),
        feet=feet,
    )
    for every, expected in ((1, [1, 1, 0, 1]), (2, [2, 1])):
        data = _motion_data(shown, every)
        assert list(base64.b64decode(data["feet"]["data"])) == expected
        assert data["lengths"] == [4 // every]
    # it ends between two frames, so the last frame is its last state
    shown.lengths, shown.q = np.array([3]), np.arange(5.0).reshape(1, 5, 1)
    data = _motion_data(shown, 2)
    assert data["lengths"] == [2] and data["steps"] == [3]
    assert list(base64.b64decode(data["feet"]["data"])) == [2, 0]
    for name, wanted in (("q", [0, 2, 3]), ("rewards", [2, 1])):
        numbers = np.frombuffer(base64.b64decode(data[name]["data"]), "<i2")
        scale, offset = data[name]["scale"][0], data[name]["offset"][0]
        np.testing.assert_allclose(numbers * scale + offset, wanted, atol=1e-3)
