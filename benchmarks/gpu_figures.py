"""Draw what `compare_gpu.py` measured: speed by batch, cost of a gradient by horizon.

python benchmarks/gpu_figures.py FORWARD.csv GRADIENT.csv [--out docs/figures]
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import Any

COLORS = {"newton_qd": "C0", "brax v1": "C1", "brax v2 spring": "C2", "MJX": "C3"}
Row = dict[str, str]


def rows_of(path: Path) -> list[Row]:
    """Returns the rows that have a speed."""
    with path.open(newline="", encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if row["million steps/s"]]


def lines(axes: Any, rows: list[Row], x: str, seconds: bool) -> None:
    """Draws a line for each library: speed, or seconds of a call, against ``x``."""
    for name, color in COLORS.items():
        points = []
        for row in rows:
            if row["library"] == name:
                speed = float(row["million steps/s"])
                cost = int(row["worlds"]) * int(row["steps"]) / speed / 1e6
                points.append((int(row[x]), cost if seconds else speed))
        if points:
            axes.plot(*zip(*sorted(points), strict=True), "o-", color=color, label=name)
    axes.set_xscale("log", base=2)
    if seconds:
        axes.set_yscale("log")
    else:
        axes.set_ylim(0)
    ticks = sorted({int(row[x]) for row in rows})
    axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
    axes.grid(visible=True, which="both", alpha=0.3)


def by_batch(rows: list[Row], path: Path) -> None:
    """Draws the speed of each robot against the number of worlds."""
    import matplotlib.pyplot as plt

    robots = list(dict.fromkeys(row["robot"] for row in rows))
    figure, grid = plt.subplots(1, len(robots), figsize=(3 * len(robots), 3.2))
    for robot, axes in zip(robots, grid, strict=True):
        lines(axes, [row for row in rows if row["robot"] == robot], "worlds", False)
        axes.set_title(robot)
        axes.set_xlabel("worlds")
    grid[0].set_ylabel("million steps per second")
    grid[0].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def by_horizon(rows: list[Row], path: Path) -> None:
    """Draws the time of a gradient against the number of steps, for one batch."""
    import matplotlib.pyplot as plt

    counts = [row["worlds"] for row in rows]
    worlds = max(dict.fromkeys(counts), key=counts.count)
    figure, axes = plt.subplots(figsize=(5, 3.6))
    lines(axes, [row for row in rows if row["worlds"] == worlds], "steps", True)
    robot = rows[0]["robot"]
    axes.set_title(f"{robot}, {int(worlds):,} worlds, forward and backward")
    axes.set_xlabel("steps")
    axes.set_ylabel("seconds")
    axes.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def main() -> None:
    """Draw both figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("forward", type=Path)
    parser.add_argument("gradient", type=Path)
    parser.add_argument("--out", type=Path, default=Path("docs/figures"))
    options = parser.parse_args()
    by_batch(rows_of(options.forward), options.out / "gpu_batch.png")
    by_horizon(rows_of(options.gradient), options.out / "gpu_horizon.png")


if __name__ == "__main__":
    main()
