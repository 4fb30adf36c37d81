"""Compare our gradient-based emitters with pyribs' on the published domains.

Both run with the settings of Fontaine & Nikolaidis 2021 (OMG-MEGA, CMA-MEGA) and 2023
(CMA-MAEGA): 100 x 100 cells, 36 individuals per solution point and iteration. The
domains are the same functions for both, in float32 for ours and in float64 for pyribs.
Each run adds a line to a csv file, and runs that are in it already are left out, so
that a long comparison can be stopped and continued.

    python benchmarks/dqd.py --seeds 10 --out benchmarks/results/dqd.csv
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import functools
import itertools
import statistics
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from dqd_domains import DOMAINS, Domain

GRID = (100, 100)
POPULATION = 36
INITIAL_POPULATION = 100
ADAM_RATE = 0.002
LEARNING_RATE = 0.01
THRESHOLD_MIN = 0.0
ALGORITHMS = ("omg_mega", "cma_mega", "cma_mega_adam", "cma_maega")
LIBRARIES = ("newton_qd", "pyribs")
# Mean QD score over the number of cells, of Fontaine & Nikolaidis 2021.
PUBLISHED = {
    ("lp_sphere", "omg_mega"): 71.6,
    ("lp_rastrigin", "omg_mega"): 55.9,
    ("arm", "omg_mega"): 44.1,
    ("lp_sphere", "cma_mega"): 75.3,
    ("lp_rastrigin", "cma_mega"): 62.5,
    ("arm", "cma_mega"): 74.2,
}


@dataclasses.dataclass(frozen=True)
class Run:
    """One line of the comparison.

    Attributes:
        domain: Name in ``DOMAINS``.
        algorithm: Name in ``ALGORITHMS``.
        library: Name in ``LIBRARIES``.
        dimension: Number of variables.
        emitters: Solution points in parallel.
        iterations: Iterations after the initial population.
        seed: Seed of every random number.
    """

    domain: str
    algorithm: str
    library: str
    dimension: int
    emitters: int
    iterations: int
    seed: int


@dataclasses.dataclass(frozen=True)
class Result:
    """What a run has found and what it took.

    Attributes:
        qd_score: Sum of objectives over the number of cells.
        coverage: Filled cells [%].
        best: Best objective.
        wall_s: Time without compilation [s].
        processor_s: Processor time of the process without compilation [s].
    """

    qd_score: float
    coverage: float
    best: float
    wall_s: float
    processor_s: float


def initial_population(run: Run) -> np.ndarray:
    """(100, n) what OMG-MEGA starts from."""
    shape = (INITIAL_POPULATION, run.dimension)
    return np.random.default_rng(run.seed).normal(size=shape)


def run_ours(run: Run) -> Result:
    """Runs an emitter of this package in QDax's MAP-Elites."""
    from qdax.core.containers.mapelites_repertoire import (
        MapElitesRepertoire,
        compute_euclidean_centroids,
    )
    from qdax.core.map_elites import MAPElites

    from newton_qd.qd.emitters.annealed_repertoire import AnnealedRepertoire

    domain = DOMAINS[run.domain]
    emitter, score, initial = ours(run, domain)
    repertoire_init: Any = MapElitesRepertoire.init
    if run.algorithm == "cma_maega":
        repertoire_init = functools.partial(
            AnnealedRepertoire.init,
            learning_rate=LEARNING_RATE,
            threshold_min=THRESHOLD_MIN,
        )
    algorithm = MAPElites(score, emitter, lambda _: {}, repertoire_init)
    limit = domain.limit(run.dimension)
    centroids = compute_euclidean_centroids(GRID, [-limit] * 2, [limit] * 2)
    key, init_key = jax.random.split(jax.random.key(run.seed))
    repertoire, state, _ = algorithm.init(initial, centroids, init_key)

    def advance(carry: tuple, count: jax.Array) -> tuple:
        return jax.lax.fori_loop(
            0, count, lambda _, carry: algorithm.scan_update(carry, None)[0], carry
        )

    carry = (repertoire, state, key)
    compiled = jax.jit(advance, donate_argnums=0).lower(carry, 1).compile()
    wall, processor = time.perf_counter(), time.process_time()
    for first in range(0, run.iterations, 500):
        # Short enough to be interrupted.
        carry = compiled(carry, jnp.asarray(min(500, run.iterations - first)))
        jax.block_until_ready(carry)
    times = time.perf_counter() - wall, time.process_time() - processor
    found = getattr(carry[0], "result", carry[0]).fitnesses[:, 0]
    found = np.asarray(found, np.float64)
    filled = found[np.isfinite(found)]
    return Result(
        qd_score=filled.sum() / found.size,
        coverage=100 * filled.size / found.size,
        best=filled.max(),
        wall_s=times[0],
        processor_s=times[1],
    )


def ours(run: Run, domain: Domain) -> tuple[Any, Any, jax.Array]:
    """Emitter, scoring function of the loop and initial population (N, n)."""
    from newton_qd.qd.emitters import CMAMAEGAEmitter, CMAMEGAEmitter, OMGMEGAEmitter

    def score(solutions: jax.Array, key: jax.Array) -> tuple:
        del key
        values = domain.score(solutions)
        return values[:, 0], values[:, 1:], {}

    def score_with_gradients(solutions: jax.Array, key: jax.Array) -> tuple:
        del key
        values, gradients = domain.score_with_gradients(solutions)
        return values[:, 0], values[:, 1:], {"gradients": jnp.swapaxes(gradients, 1, 2)}

    if run.algorithm == "omg_mega":
        emitter = OMGMEGAEmitter(POPULATION // 2, domain.sigma_omg)
        initial = jnp.asarray(initial_population(run), jnp.float32)
        return emitter, score_with_gradients, initial
    start = jnp.zeros((1, run.dimension), jnp.float32)
    cls = CMAMAEGAEmitter if run.algorithm == "cma_maega" else CMAMEGAEmitter
    emitter = cls(
        score_with_gradients,
        sigma_g=domain.sigma_cma,
        batch_size=POPULATION,
        num_emitters=run.emitters,
        optimizer=optax.adam(ADAM_RATE) if run.algorithm == "cma_mega_adam" else None,
        start=start[0],
    )
    return emitter, score, start


def run_pyribs(run: Run) -> Result:
    """Runs pyribs' emitters in its own loop."""
    from ribs.schedulers import Scheduler

    domain = DOMAINS[run.domain]
    archive, result = archives(run, domain)
    scheduler = Scheduler(archive, pyribs(run, domain, archive), result)
    score, differentiate = jax.jit(domain.score), jax.jit(domain.score_with_gradients)
    with jax.enable_x64(True):
        if run.algorithm == "omg_mega":
            initial = initial_population(run)
            values = np.asarray(score(initial))
            archive.add(initial, values[:, 0], values[:, 1:])
        # Compile before the clock starts.
        warm = np.zeros((len(scheduler.emitters), run.dimension))
        jax.block_until_ready((score(warm), differentiate(warm)))
        wall, processor = time.perf_counter(), time.process_time()
        for _ in range(run.iterations):
            values, gradients = map(np.array, differentiate(scheduler.ask_dqd()))
            scheduler.tell_dqd(values[:, 0], values[:, 1:], gradients)
            values = np.asarray(score(scheduler.ask()))
            scheduler.tell(values[:, 0], values[:, 1:])
        times = time.perf_counter() - wall, time.process_time() - processor
    stats: Any = scheduler.result_archive.stats
    return Result(
        qd_score=float(stats.norm_qd_score),
        coverage=100 * float(stats.coverage),
        best=float(stats.obj_max),
        wall_s=times[0],
        processor_s=times[1],
    )


def archives(run: Run, domain: Domain) -> tuple[Any, Any]:
    """Archive of pyribs, and the elitist one beside an annealed one."""
    from ribs.archives import GridArchive

    limit = domain.limit(run.dimension)
    make = functools.partial(
        GridArchive,
        solution_dim=run.dimension,
        dims=GRID,
        ranges=[(-limit, limit)] * 2,
        seed=run.seed,
    )
    if run.algorithm != "cma_maega":
        return make(), None
    return make(learning_rate=LEARNING_RATE, threshold_min=THRESHOLD_MIN), make()


def pyribs(run: Run, domain: Domain, archive: Any) -> list[Any]:
    """Emitters of pyribs, with the settings of the papers."""
    from ribs.emitters import GradientArborescenceEmitter, GradientOperatorEmitter

    seeds: Any = np.random.SeedSequence(run.seed).spawn(run.emitters)
    start = np.zeros(run.dimension)
    if run.algorithm == "omg_mega":
        return [
            GradientOperatorEmitter(
                archive,
                x0=start,
                sigma=0.0,
                sigma_g=domain.sigma_omg,
                measure_gradients=True,
                normalize_grad=True,
                batch_size=POPULATION // 2,
                seed=seed,
            )
            for seed in seeds
        ]
    annealed, adam = run.algorithm == "cma_maega", run.algorithm == "cma_mega_adam"
    return [
        GradientArborescenceEmitter(
            archive,
            x0=start,
            sigma0=domain.sigma_cma,
            lr=ADAM_RATE if adam else 1.0,
            grad_opt="adam" if adam else "gradient_ascent",
            ranker="imp" if annealed else "2imp",
            restart_rule="basic" if annealed else "no_improvement",
            selection_rule="mu",
            batch_size=POPULATION - 1,
            seed=seed,
        )
        for seed in seeds
    ]


def read(path: Path) -> dict[Run, Result]:
    """Runs that a csv file holds."""
    if not path.exists():
        return {}
    found = {}
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            names = ("domain", "algorithm", "library")
            numbers = ("dimension", "emitters", "iterations", "seed")
            values: dict[str, Any] = {name: row[name] for name in names}
            values.update({name: int(row[name]) for name in numbers})
            fields = dataclasses.fields(Result)
            found[Run(**values)] = Result(
                **{field.name: float(row[field.name]) for field in fields}
            )
    return found


def append(path: Path, run: Run, result: Result) -> None:
    """Adds a line to a csv file."""
    values = {k: f"{v:.5g}" for k, v in dataclasses.asdict(result).items()}
    row = {**dataclasses.asdict(run), **values}
    path.parent.mkdir(parents=True, exist_ok=True)
    new = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, row, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerow(row)


def table(results: dict[Run, Result]) -> str:
    """Mean and standard deviation over seeds, as a Markdown table."""
    lines = [
        "| domain | n | points | iterations | algorithm | published | library | seeds "
        "| QD score | coverage [%] | processor [ms/iteration] |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    groups: dict[Run, list[Result]] = {}
    for run, result in results.items():
        groups.setdefault(dataclasses.replace(run, seed=0), []).append(result)
    for run, group in sorted(groups.items(), key=lambda item: repr(item[0])):
        published = PUBLISHED.get((run.domain, run.algorithm), "-")
        if run.dimension != 1000 or run.iterations != 10_000:
            published = "-"
        processor = statistics.mean(r.processor_s for r in group) / run.iterations
        lines.append(
            f"| {run.domain} | {run.dimension} | {run.emitters} | {run.iterations} "
            f"| {run.algorithm} | {published} | {run.library} | {len(group)} "
            f"| {spread([r.qd_score for r in group])} "
            f"| {spread([r.coverage for r in group])} | {1e3 * processor:.1f} |"
        )
    return "\n".join(lines)


def spread(values: list[float]) -> str:
    """Mean and standard deviation."""
    mean = f"{statistics.mean(values):.2f}"
    return mean if len(values) < 2 else f"{mean} ± {statistics.stdev(values):.2f}"


def main() -> None:
    """Runs what is missing and prints the table of everything in the file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("dqd.csv"))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0, help="of those seeds")
    parser.add_argument("--iterations", type=int, default=10_000)
    parser.add_argument("--dimension", type=int, default=1000)
    parser.add_argument("--emitters", type=int, default=1)
    for name, known in (
        ("domains", tuple(DOMAINS)),
        ("algorithms", ALGORITHMS),
        ("libraries", LIBRARIES),
    ):
        parser.add_argument(f"--{name}", nargs="*", choices=known, default=known)
    args = parser.parse_args()
    done = read(args.out)
    sizes = (args.dimension, args.emitters, args.iterations)
    kinds = list(itertools.product(args.domains, args.algorithms, args.libraries))
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        for domain, algorithm, library in kinds:
            run = Run(domain, algorithm, library, *sizes, seed)
            if run in done:
                continue
            done[run] = (run_ours if library == "newton_qd" else run_pyribs)(run)
            append(args.out, run, done[run])
            print(run, done[run], flush=True)
    print(table(done))


if __name__ == "__main__":
    main()
