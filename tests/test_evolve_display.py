"""What a run shows: pictures of archives, and progress."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest

from newton_qd.cli.progress import ProgressCount
from newton_qd.qd.run import plot
from newton_qd.qd.run.archive import Archive
from newton_qd.qd.run.plot_colours import fitness_colours
from newton_qd.qd.run.progress import Progress

# QDax and what it imports warn about their own use of other packages.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def archive_of(grid: tuple[int, ...], empty: int = 0) -> Archive:
    """One individual in every cell but some; fitness counts the cells."""
    axes = [(np.arange(n) + 0.5) / n for n in grid]
    # QDax orders the cells like this: the first two axes are swapped.
    centroids = np.stack([m.ravel() for m in np.meshgrid(*axes)], axis=-1)
    fitnesses = np.arange(len(centroids), dtype=float)
    fitnesses[:empty] = -np.inf
    return Archive(np.zeros((len(centroids), 1)), fitnesses, centroids, centroids)


@pytest.mark.parametrize("grid", [(7,), (3, 4), (2, 3, 4), (3, 2, 4, 5), (2,) * 5])
@pytest.mark.parametrize("empty", [0, 2, 10**6])
def test_pictures_of_every_kind(grid: tuple[int, ...], empty: int) -> None:
    count = len(grid)
    figure = plot.plot_archive(
        archive_of(grid, empty),
        grid=grid,
        limits=(np.zeros(count), np.ones(count)),
        labels=tuple(f"foot_{i} contact" for i in range(count)),
        title="a title",
    )
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=20)
    assert buffer.getvalue().startswith(b"\x89PNG")
    assert figure.get_suptitle() == "a title"
    written = " ".join(
        label
        for axes in figure.axes
        for panel in (axes, *axes.child_axes)
        for label in (panel.get_xlabel(), panel.get_ylabel())
    )
    assert "fitness" in written
    for i in range(count):
        assert f"foot_{i} contact" in written


def test_nested_picture_puts_every_cell_in_its_place() -> None:
    grid = (3, 2, 4, 5)
    archive = archive_of(grid, empty=1)
    figure = plot.plot_archive(
        archive,
        grid=grid,
        limits=(np.zeros(4), np.ones(4)),
        labels=("a", "b", "c", "d"),
    )
    image = figure.axes[0].images[0].get_array()
    assert image is not None and image.shape == (10, 12)
    assert np.ma.count_masked(image) == 1
    for centroid, fitness in zip(archive.centroids, archive.fitnesses, strict=True):
        a, b, c, d = (centroid * np.array(grid)).astype(int)
        if np.isfinite(fitness):
            assert image[b * 5 + d, a * 4 + c] == fitness


@pytest.mark.parametrize(
    ("grid", "centres"), [((2,), [[0.75], [0.25]]), (None, [[0.7], [0.3]])]
)
def test_bars_are_where_their_cells_are(
    grid: tuple[int, ...] | None, centres: list[list[float]]
) -> None:
    places = np.array(centres)
    archive = Archive(np.zeros((2, 1)), np.array([7.0, 5.0]), places, places)
    limits = np.zeros(1), np.ones(1)
    figure = plot.plot_archive(archive, grid=grid, limits=limits, labels=("a",))
    bars: Any = figure.axes[0].patches
    tops = {
        bar.get_x(): bar.get_y() + bar.get_height() for bar in bars if bar.get_width()
    }
    assert tops == pytest.approx({0.0: 5.0, 0.5: 7.0})


def test_points_have_the_colours_of_their_fitnesses() -> None:
    points = np.eye(5)[:3]
    archive = Archive(np.zeros((3, 1)), np.array([5.0, 1.0, 3.0]), points, points)
    limits = np.zeros(5), np.ones(5)
    figure = plot.plot_archive(archive, grid=None, limits=limits, labels=tuple("abcde"))
    dots: Any = figure.axes[0].collections[0]
    colours = fitness_colours(archive.fitnesses)
    for place, shade in zip(dots.get_offsets(), dots.get_facecolors(), strict=True):
        row = (points[:, :2] == place).all(axis=1).argmax()
        np.testing.assert_allclose(shade, colours.to_rgba(archive.fitnesses[row]))


ROW = {"qd_score": 1234567.0, "coverage": 12.34, "max_fitness": 56.78}


class Terminal(io.StringIO):
    encoding = "utf-8"  # type: ignore[assignment]

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("columns", [20, 60, 80, 120, 300])
def test_bar_fits_the_terminal(monkeypatch: pytest.MonkeyPatch, columns: int) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    stream = Terminal()
    progress = Progress("ant_uni", 200, stream=stream)
    progress.update(0, ROW)
    progress.update(1, ROW)  # too soon after the first to be drawn
    progress.update(200, ROW)
    progress.close()
    drawn = stream.getvalue().split("\r")[1:]
    assert len(drawn) == 2 and stream.getvalue().endswith("\x1b[K\n")
    assert all(len(line.partition("\x1b")[0]) < columns for line in drawn)
    numbers = [line.partition("\x1b")[0] for line in drawn]
    if columns >= 40:  # whole numbers, or none
        shown = numbers[1].split("  ")
        assert set(shown[1:-1]) <= {
            "200/200",
            "QD score 1,234,567",
            "coverage 12.3%",
            "best 56.8",
        }
        assert "200/200" in shown and shown[-1].endswith("<0:00")
    if columns >= 120:
        assert "QD score 1,234,567  coverage 12.3%  best 56.8" in drawn[1]
        assert "█" * 20 in drawn[1] and "200/200" in drawn[1]


def test_a_long_run_says_how_long(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    for each, told in ((16.5, True), (0.01, False)):
        stream = io.StringIO()
        progress = Progress("ant_uni", 1000, stream=stream)
        for iteration, seconds in enumerate((60.0, 30.0, each, each)):
            now[0] += seconds
            progress.update(iteration, ROW)
        text = "a generation takes about 16 s: 4:34:27 for the 998 that are left\n"
        assert (text in stream.getvalue()) == told
        assert stream.getvalue().count("a generation takes") == told


class Gone(Terminal):
    """A stream whose reader has left."""

    def write(self, text: str) -> int:
        raise BrokenPipeError(32, "Broken pipe")


def test_a_reader_that_leaves_ends_the_display_only(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    progress = Progress("ant_uni", 200, stream=Gone())
    progress.update(0, ROW)
    progress.note("a note")
    progress.update(200, ROW)
    progress.close()
    monkeypatch.setattr("sys.stderr", Gone())
    with ProgressCount("frames") as shown:
        shown(1, 2)
    assert capsys.readouterr().out == ""


def test_plain_lines_without_a_terminal() -> None:
    stream = io.StringIO()
    progress = Progress("ant_uni", 200, stream=stream)
    for iteration in range(201):
        progress.update(iteration, ROW)
    progress.close()
    lines = stream.getvalue().splitlines()
    assert len(lines) == 2 and "\r" not in stream.getvalue()
    assert lines[1].startswith("ant_uni 100%  200/200  QD score 1,234,567")
