"""The explorer page: the archive of a run as a map, and its elites moving."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.files import write_atomically
from newton_qd.viewing.drawing import Drawing, body_frames, drawing_of
from newton_qd.viewing.elites import record_elites
from newton_qd.viewing.html import drawing_data, encode, page
from newton_qd.viewing.trajectory import Trajectory

if TYPE_CHECKING:
    from newton_qd.qd.run.opened import Run

_EVERY = 2  # steps between two frames of the page
_LARGEST_PAGE = 10e6  # [bytes]
_FIXED = 0.7e6  # scripts, simple shapes and texts of a page [bytes]
_MOST_POINTS = 2000  # of a curve, which has fewer pixels
_MOST_GENOTYPES = 0.6e6  # [bytes]
_COUNTS = 16  # lengths of an episode, as text [bytes]
_TEXT = 4 / 3  # characters of base64 for a byte
_MOST_RUNS = 2
_CURVES = ("qd_score", "coverage", "max_fitness")
_SCRIPTS = ("map.js", "explorer.js")
_BODY = """
<header><h1 id="title"></h1><div id="facts"></div>
<button id="theme" type="button" title="Light or dark" aria-label="Light or dark">
&#9680;</button></header>
<main><section id="maps"></section><div id="player" class="player"></div></main>
"""


def explorer_html(
    runs: Sequence[Run],
    *,
    starts: int = 0,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> str:
    """Returns a page that shows the archives of one run or two runs.

    It has the motion of the elites at half rate, or at full rate if a number of control
    steps is odd. If the page would be larger than 10 MB, only some elites move, and the
    page says so.

    Args:
        runs: One run or two of the same robot in the same scene, from
            ``newton_qd.qd.load_run(DIR)``.
        starts: Other start states that each elite is evaluated from; 0: none. The page
            then compares these fitnesses with those of the archive.
        seed: Seed of these start states.
        progress: Called with the number of recorded elites and their total.

    Raises:
        TypeError: The environment cannot be drawn, or ``runs`` is no list of runs.
        ValueError: There are not one or two runs, an archive is empty, the robots or
            their scenes differ, or a number is not allowed.
    """
    checks.integer("starts", starts, least=0)
    checks.integer("seed", seed, least=0, most=2**32 - 1)
    allowed = "a list of one run or two runs, as newton_qd.qd.load_run returns them"
    checks.instance("runs", runs, (list, tuple), allowed)
    for index, run in enumerate(runs):
        if not hasattr(run, "cells"):
            raise TypeError(message(f"runs[{index}]", run, allowed))
    if not 1 <= len(runs) <= _MOST_RUNS:
        raise ValueError(message("runs", Fact(f"{len(runs)} runs"), "one run or two"))
    for run in runs:
        if not len(run.cells):
            name = f"archive of {run.path}"
            raise ValueError(message(name, Fact("no elite"), "at least one"))
    # half rate would lose the last step of an episode of an odd length
    odd = any(run.config.episode_length % _EVERY for run in runs)
    every = 1 if odd else _EVERY
    meshes = _mesh_size(drawing_of(runs[0].task.env))  # those of both runs
    budget = (_LARGEST_PAGE - _FIXED - meshes) / len(runs)
    chosen = [_moving(run, budget - _still_size(run, starts), every) for run in runs]
    total, before = sum(map(len, chosen)), 0
    found, first = [], None
    for run, cells in zip(runs, chosen, strict=True):

        def count(done: int, of: int, before: int = before) -> None:
            del of
            if progress is not None:
                progress(before + done, total)

        trajectory = record_elites(run, cells, progress=count)
        before += len(cells)
        if first is None:
            first = trajectory
        _check_same(first, trajectory, [run.config.env_name for run in runs])
        found.append(_run_data(run, cells, trajectory, every, starts, seed))
    assert first is not None
    title = " and ".join(dict.fromkeys(run.config.env_name for run in runs))
    data = {
        "title": title,
        "drawing": drawing_data(first.drawing),
        "dt": first.dt * every,
        "unit": " s" if first.dt != 1.0 else " steps",
        "runs": found,
    }
    return page(f"{title} - newton_qd", _BODY, _SCRIPTS, data)


def write_explorer(
    runs: Sequence[Run],
    path: str | os.PathLike[str],
    *,
    starts: int = 0,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Writes the page of :func:`explorer_html`. It opens from the disk.

    Args:
        runs: One run or two runs of the same robot in the same scene.
        path: The HTML file; it is replaced if it exists.
        starts: Other start states that each elite is evaluated from; 0: none.
        seed: Seed of these start states.
        progress: Called with the number of recorded elites and their total.

    Returns:
        The path of the file.

    Raises:
        TypeError: The environment cannot be drawn, or ``runs`` is no list of runs.
        ValueError: There are not one or two runs, an archive is empty, the robots or
            their scenes differ, or a number is not allowed.
        OSError: The file cannot be written.
    """
    target = Path(path)
    content = explorer_html(runs, starts=starts, seed=seed, progress=progress)
    write_atomically(target, content.encode())
    return target


def _check_same(first: Trajectory, other: Trajectory, names: list[str]) -> None:
    """Checks that two runs can be seen in one page.

    Raises:
        ValueError: The robots, their scenes or the durations of a step differ.
    """
    if not first.drawing.shows(other.drawing) or first.dt != other.dt:
        given = Fact(" and ".join(names))
        allowed = "two runs of the same robot in the same scene"
        raise ValueError(message("runs", given, allowed))


def _mesh_size(drawing: Drawing) -> float:
    """Returns the size of the meshes in the page [bytes]."""
    numbers = sum(shape.vertices.size + shape.faces.size for shape in drawing.shapes)
    return 4 * numbers * _TEXT


def _still_size(run: Run, starts: int) -> float:
    """Returns the size of map, values, curves and genotypes in the page [bytes]."""
    elites, dimensions = run.archive.descriptors[run.cells].shape
    values = 4 + (2 if starts else 0) + dimensions  # of the metrics of an elite
    points = min(run.iteration + 1, _MOST_POINTS) * (1 + len(_CURVES))
    numbers = elites * (2 + dimensions + values) + run.archive.centroids.size + points
    if _has_genotypes(run):
        numbers += run.archive.genotypes[run.cells].size
    return 4 * numbers * _TEXT


def _moving(run: Run, budget: float, every: int) -> np.ndarray:
    """Returns the cells whose elites move in the page: all, or as many as fit.

    Args:
        run: The run.
        budget: Size of their motion [bytes].
        every: Steps between two frames of the page.
    """
    env = run.task.env.unwrapped
    frames = run.config.episode_length // every + 1
    system = getattr(env, "system", None)
    numbers = (2, 0) if system is None else (system.nq, len(system.feet))
    # int16 for coordinates and reward, a byte for each foot
    size = frames * (2 * numbers[0] + 2 + numbers[1]) * _TEXT + _COUNTS
    most = max(1, math.floor(budget / size))
    cells = run.cells
    if len(cells) <= most:
        return cells
    kept = cells[np.linspace(0, len(cells) - 1, most).astype(int)]
    if run.best()[0].cell not in kept:
        kept[0] = run.best()[0].cell
    return np.unique(kept)


def _run_data(
    run: Run,
    cells: np.ndarray,
    trajectory: Trajectory,
    every: int,
    starts: int,
    seed: int,
) -> dict[str, Any]:
    """Returns a run as a JSON value."""
    low, high = (np.asarray(ends, float) for ends in run.task.limits)
    archive, config = run.archive, run.config
    filled = run.cells
    count = len(run.metrics["evaluations"])
    points = np.linspace(0, count - 1, min(count, _MOST_POINTS)).astype(int)
    columns = ("evaluations", *_CURVES)
    curves = {name: encode(run.metrics[name][points]) for name in columns}
    again = run.reevaluated
    return {
        "name": str(run.path),
        "facts": f"{config.env_name}, algorithm {config.algorithm}, "
        f"seed {config.seed}, generation {run.iteration}",
        "labels": list(run.task.labels),
        "low": low.tolist(),
        "high": high.tolist(),
        "map": _map_data(run),
        "cells": encode(filled, "int32"),
        "descriptors": encode(archive.descriptors[filled]),
        "metrics": [
            {"name": name, "values": encode(values)}
            for name, values in _metrics(run, cells, trajectory, starts, seed).items()
        ],
        "moving": encode(np.searchsorted(filled, cells), "int32"),
        "notice": _notice(len(filled), len(cells)),
        "curves": curves,
        "reevaluated": None
        if again is None
        else [
            f"re-evaluated {again.reevaluations} times: "
            f"QD score {again.qd_score:,.0f}, coverage {again.coverage:.1f} %, "
            f"best fitness {again.max_fitness:.1f}"
        ],
        "motion": _motion_data(trajectory, every),
        "genotypes": _genotypes(run),
    }


def _notice(elites: int, moving: int) -> str:
    """Returns what the page says about elites that do not move."""
    if moving == elites:
        return ""
    return f"{moving} of {elites} elites move, so that the page is below 10 MB"


def _genotypes(run: Run) -> dict[str, Any] | None:
    """Returns the genotypes of the elites, if they are small."""
    return encode(run.archive.genotypes[run.cells]) if _has_genotypes(run) else None


def _has_genotypes(run: Run) -> bool:
    """Returns whether the page has the genotypes of the elites."""
    return run.archive.genotypes[run.cells].nbytes < _MOST_GENOTYPES


def _map_data(run: Run) -> dict[str, Any]:
    """Returns where the cells are: a nested grid, or centroids."""
    from newton_qd.qd.run.plot_grid import grid_indices

    archive, grid = run.archive, run.config.grid
    if grid is not None:
        indices = grid_indices(archive.centroids, grid, run.task.limits)
        return {"grid": list(grid), "indices": encode(indices, "int32")}
    return {"grid": None, "centroids": encode(archive.centroids)}


def _metrics(
    run: Run, cells: np.ndarray, trajectory: Trajectory, starts: int, seed: int
) -> dict[str, np.ndarray]:
    """Returns values (n,) of the elites by name; NaN where they are not known."""
    filled = run.cells
    rows = np.searchsorted(filled, cells)

    def spread(values: np.ndarray) -> np.ndarray:
        whole = np.full(len(filled), np.nan)
        whole[rows] = values
        return whole

    found = {"fitness": run.archive.fitnesses[filled]}
    if starts:
        from newton_qd.qd.run.search import other_start_keys

        keys = other_start_keys(seed, starts)
        again = np.median(run.evaluate(filled, keys).fitnesses, axis=1)
        found[f"median fitness from {starts} other starts"] = again
        found["loss from other starts"] = found["fitness"] - again
    lengths = trajectory.lengths
    drawing = trajectory.drawing
    torso = body_frames(drawing, trajectory.q)[:, :, drawing.torso, :3]
    last = torso[np.arange(len(lengths)), lengths]
    way = np.linalg.norm(last[:, :2] - torso[:, 0, :2], axis=1)
    unit = "m" if trajectory.dt != 1.0 else "-"
    found["steps before the end"] = spread(lengths)
    found[f"distance from the start [{unit}]"] = spread(way)
    found["mean reward of a step"] = spread(trajectory.returns / lengths)
    for index, label in enumerate(run.task.labels):
        found[label] = run.archive.descriptors[filled][:, index]
    return found


def _motion_data(trajectory: Trajectory, every: int) -> dict[str, Any]:
    """Returns the motion of elites as a JSON value, one frame for some steps."""
    frames = trajectory.steps // every + 1
    # an episode may end between two frames: its last frame is its last state
    at = np.minimum(np.arange(frames) * every, trajectory.lengths[:, None])
    q = trajectory.q[np.arange(len(at))[:, None], at]
    steps = np.arange(trajectory.steps)
    valid = steps < trajectory.lengths[:, None]
    rewards = np.where(valid, trajectory.rewards, 0.0)
    # at the start of each step, as descriptors
    feet = (trajectory.feet[:, :-1] > 0) & valid[..., None]
    missing = (-trajectory.steps) % every
    rewards = np.pad(rewards, [(0, 0), (0, missing)])
    feet = np.pad(feet, [(0, 0), (0, missing), (0, 0)])
    shape = (len(q), rewards.shape[1] // every, every)
    summed = rewards.reshape(shape).sum(axis=-1)[:, : frames - 1]
    # in how many of the steps between two frames a foot touches the ground
    touched = feet.reshape(*shape, feet.shape[-1]).sum(axis=2)[:, : frames - 1]
    return {
        "q": encode(q, "int16"),
        "rewards": encode(summed[..., None], "int16"),
        "feet": encode(touched, "uint8"),
        "every": every,
        "lengths": (-(-trajectory.lengths // every)).clip(max=frames - 1).tolist(),
        "steps": trajectory.lengths.tolist(),
    }
