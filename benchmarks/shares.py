"""Measures which part of a generation improves the archive.

A generation of a gradient-based algorithm has offspring of its own emitter, and
iso+line variations. For both, the table has the number of offspring, the share of them
that entered the archive, and their share of what was added to the QD score (with
offset): in cells that were empty, and in cells that were filled.

    python benchmarks/shares.py ant_uni me-actor-critic@1 --generations 100
"""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any

import jax
import numpy as np
from study_runs import variants

from newton_qd import UnknownEnvironment
from newton_qd.qd import ConfigError, EvolveConfig, make_task
from newton_qd.qd.run.search import Search, SearchState

LENGTH = 250


@dataclasses.dataclass
class Share:
    """What one part of the generations has done so far.

    Attributes:
        offspring: Number of individuals.
        entered: Number of them in the archive after their generation.
        new: What they added to the QD score in cells that were empty.
        better: What they added to it in cells that were filled.
    """

    offspring: int = 0
    entered: int = 0
    new: float = 0.0
    better: float = 0.0

    def add(self, rows: slice, entered: np.ndarray, gain: Any, empty: Any) -> None:
        """Counts the offspring in some rows of a generation."""
        here = entered[rows]
        self.offspring += len(here)
        self.entered += int(here.sum())
        self.new += float(gain[rows][here & empty[rows]].sum())
        self.better += float(gain[rows][here & ~empty[rows]].sum())


def measured(search: Search, generations: int, own: int) -> tuple[Share, Share]:
    """Returns the shares of the own emitter and of the variations.

    Args:
        search: The search.
        generations: Number of generations.
        own: Offspring of the own emitter in a generation; they come first.
    """
    from qdax.core.containers.mapelites_repertoire import get_cells_indices

    parts = Share(), Share()
    state: SearchState = search.advance(search.empty())
    offset = search._generation.offset
    for _ in range(generations):
        before = np.asarray(state.repertoire.fitnesses)[:, 0]
        key = jax.random.fold_in(search._key_generations, state.iteration + 1)
        given = search._drawn, state.repertoire, state.emitter, key
        genotypes = search._ask(*given)[0]
        start = search._start(state.iteration + 1)
        fitnesses, found, _ = search._score(genotypes, start)
        state = search.advance(state)  # the same offspring once more
        cells = np.asarray(get_cells_indices(found, state.repertoire.centroids))
        fitness = np.asarray(fitnesses)
        # the best of a cell enters; equal ones count once
        entered = fitness == np.asarray(state.repertoire.fitnesses)[cells, 0]
        entered &= fitness > before[cells]
        _, first = np.unique(np.where(entered, cells, -1), return_index=True)
        entered &= np.isin(np.arange(len(cells)), first)
        empty = ~np.isfinite(before[cells])
        old = np.where(empty, -offset, before[cells])
        for part, rows in zip(parts, (slice(own), slice(own, None)), strict=True):
            part.add(rows, entered, fitness - old, empty)
    return parts


def main() -> None:
    """Prints the table of one run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("env_name")
    parser.add_argument("variant", help="a key of study/field.toml")
    parser.add_argument("--generations", type=int, default=100)
    for name in ("--batch-size", "--updates"):
        parser.add_argument(name, type=int, help="in place of the variant's")
    args = parser.parse_args()
    if args.variant not in variants():
        parser.error(f"variant: got {args.variant}; allowed: a key of study/field.toml")
    if args.generations < 1:
        parser.error(f"--generations: got {args.generations}; allowed: integers from 1")
    given = {"batch_size": 1024, **variants()[args.variant]}
    if args.batch_size:
        given["batch_size"] = args.batch_size
    if args.updates:
        own = given.get("options", {})
        given = {**given, "options": {**own, "updates": args.updates}}
    config = EvolveConfig(
        env_name=args.env_name,
        algorithm=args.variant.split("@")[0],
        episode_length=LENGTH,
        hidden=(64, 64),
        centroids=1024,
        **given,
    )
    try:
        task = make_task(config)
        search = Search(config.resolve(task.descriptor_length), task)
    except (UnknownEnvironment, ConfigError) as error:
        parser.error(str(error))
    emitters = getattr(search._generation.emitter, "emitters", None)
    if emitters is None:
        allowed = "a variant with offspring of two kinds"
        parser.error(f"variant: got {args.variant}; allowed: {allowed}")
    parts = measured(search, args.generations, emitters[0].batch_size)
    whole = sum(part.new + part.better for part in parts)
    print("| part | offspring | entered [%] | new cells [%] | better elites [%] |")
    print("|---|---|---|---|---|")
    for name, part in zip(("own emitter", "iso+line"), parts, strict=True):
        entered = 100 * part.entered / part.offspring
        new, better = (100 * x / whole for x in (part.new, part.better))
        print(
            f"| {name} | {part.offspring} | {entered:.1f} | {new:.1f} | {better:.1f} |"
        )


if __name__ == "__main__":
    main()
