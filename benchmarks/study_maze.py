"""Archives of the study in the maze: a picture, and how far the elites come.

One panel for each run, before re-evaluation: a point for each cell, bright where the
fitness is high, grey where the cell is empty. The table has the cells that are filled
beyond a corner and the distance of the farthest elite from the start:

    python benchmarks/study_maze.py benchmarks/results/field me-actor-critic@15 \
        --stop "60 s" --seeds 0 1 2 3 4 5 6 7 --beyond 10 20 --figure maze.png

Without ``--seeds``, it has all runs that came to the stop.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from study_regions import cells_of, seeds_of
from study_scores import markdown

import newton_qd
from newton_qd.physics.reference import rotation_matrix
from newton_qd.physics.system import System

TASK = "antmaze"
WORST = -9000.0
"""Fitness of the darkest points: whole episodes far from the target."""
BEST = -3000.0
"""Fitness of the brightest points: episodes that end early, or near the target."""


def draw(axes: Any, system: System, places: np.ndarray, found: np.ndarray) -> None:
    """Draws the walls and the cells of an archive, seen from above.

    Args:
        axes: Axes of matplotlib.
        system: The maze, whose walls are capsules along the axes.
        places: (cells, 2) centres of the cells [m].
        found: (cells,) fitness, ``-inf`` in an empty cell.
    """
    from matplotlib.patches import Rectangle

    walls = zip(system.obstacle_frame[1:], system.obstacle_size[1:], strict=True)
    for frame, size in walls:
        # a capsule that lies: its radius, and half of its length along its own z axis
        half = (np.abs(rotation_matrix(frame[3:])[:, 2]) * size[1] + size[0])[:2]
        corner, sides = frame[:2] - half, 2 * half
        axes.add_patch(Rectangle(corner, *sides, color="black", zorder=2))
    filled = np.isfinite(found)
    axes.scatter(*places[~filled].T, s=3, color="0.85")
    colours = {"c": found[filled], "vmin": WORST, "vmax": BEST}
    axes.scatter(*places[filled].T, s=5, **colours)
    axes.plot(0, 0, "r+")
    axes.set(aspect="equal", xticks=[], yticks=[], xlim=(-5, 40), ylim=(-5, 40))


def main() -> None:
    """Prints the table and writes the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path)
    parser.add_argument("variant")
    parser.add_argument("--stop", default="60 s")
    parser.add_argument("--seeds", type=int, nargs="+")
    parser.add_argument("--beyond", type=float, nargs=2, default=[10.0, 20.0])
    parser.add_argument("--figure", type=Path)
    args = parser.parse_args()
    try:
        known = seeds_of(args.runs, TASK, args.variant, args.stop)
    except ValueError as error:
        parser.error(f"variant: {error}")
    seeds = args.seeds or known
    if unknown := sorted(set(seeds) - set(known)):
        parser.error(f"--seeds: got {unknown}; allowed: {known}, those at {args.stop}")
    import matplotlib.pyplot as plt

    robot: Any = newton_qd.create(TASK).unwrapped
    system = robot.system
    columns = -(-len(seeds) // (1 + (len(seeds) > 4)))
    figure, axes = plt.subplots(
        -(-len(seeds) // columns), columns, figsize=(9, 5), squeeze=False
    )
    rows = []
    for panel, seed in zip(axes.flat, seeds, strict=False):
        path = args.runs / "cells" / f"{TASK}.{args.variant}.{seed}.npz"
        before, after = np.load(path)[args.stop]
        places, _ = cells_of(TASK, seed)
        draw(panel, system, places, before)
        panel.set_title(f"seed {seed}", fontsize=9)
        far = (places > args.beyond).all(axis=1)
        distance = np.linalg.norm(places[np.isfinite(before)], axis=1).max()
        filled = [int(np.isfinite(x[far]).sum()) for x in (before, after)]
        counts = f"{filled[0]} of {far.sum()}", f"{filled[1]}"
        rows.append([f"{seed}", *counts, f"{distance:.0f}"])
    print(markdown(["seed", "filled", "after re-evaluation", "farthest [m]"], rows))
    if args.figure is not None:
        figure.tight_layout()
        figure.savefig(args.figure, dpi=80)


if __name__ == "__main__":
    main()
