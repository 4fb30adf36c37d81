"""CMA-ME of pyribs; this library evaluates the batches.

python examples/ribs_cma_me.py
"""

from __future__ import annotations

import argparse

import jax
import numpy as np
from ribs.archives import GridArchive
from ribs.emitters import EvolutionStrategyEmitter
from ribs.schedulers import Scheduler

from newton_qd.qd import (
    EvolveConfig,
    from_ribs,
    make_policy,
    make_ribs_evaluation,
    make_scoring_function,
    make_task,
)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--env", default="walker2d_uni")
    parser.add_argument("--iterations", type=int, default=50)
    parser.add_argument("--batch-size", type=int, default=32, help="of each emitter")
    parser.add_argument("--episode-length", type=int, default=100)
    options = parser.parse_args()

    config = EvolveConfig(env_name=options.env, episode_length=options.episode_length)
    task = make_task(config)
    policy = make_policy(task.env, (16,))
    score = make_scoring_function(task, policy, config.episode_length)
    worst = -task.qd_offset(config.episode_length)
    evaluate = make_ribs_evaluation(
        score, jax.random.key(1), limits=task.limits, worst=worst
    )

    archive = GridArchive(
        solution_dim=policy.size,
        dims=(16,) * task.descriptor_length,
        ranges=list(zip(*task.limits, strict=True)),
        qd_score_offset=worst,
        dtype=np.float32,
        seed=0,
    )
    start = np.asarray(policy.init(jax.random.key(2)))
    emitters = [
        EvolutionStrategyEmitter(
            archive,
            x0=start,
            sigma0=0.1,
            es="sep_cma_es",
            batch_size=options.batch_size,
            seed=seed,
        )
        for seed in range(4)
    ]
    scheduler = Scheduler(archive, emitters)
    for iteration in range(options.iterations):
        scheduler.tell(*evaluate(scheduler.ask()))
        if iteration % 10 == 0 or iteration == options.iterations - 1:
            stats = archive.stats
            print(
                f"iteration {iteration}: QD score {stats.qd_score:,.0f}, "
                f"coverage {100 * stats.coverage:.1f} %, best {stats.obj_max:.1f}"
            )
    repertoire = from_ribs(archive)
    print(f"as a repertoire of QDax: {(repertoire.fitnesses > -np.inf).sum()} elites")


if __name__ == "__main__":
    main()
