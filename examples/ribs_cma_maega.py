"""CMA-MAEGA of pyribs with exact gradients: python examples/ribs_cma_maega.py."""

from __future__ import annotations

import argparse
import dataclasses

import jax
import numpy as np
from ribs.archives import GridArchive
from ribs.emitters import GradientArborescenceEmitter
from ribs.schedulers import Scheduler

from newton_qd import qd
from newton_qd.gradients import GradientOptions, with_smooth_descriptor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="ant_omni")
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--batch-size", type=int, default=32)
    parser.add_argument("--episode-length", type=int, default=100)
    options = parser.parse_args()

    config = qd.EvolveConfig(
        env_name=options.env, episode_length=options.episode_length
    )
    task = qd.make_task(config)
    # without this, the gradient of feet on the ground is 0
    env = with_smooth_descriptor(task.env, 0.1, straight_through=True)
    task = dataclasses.replace(task, env=env)
    policy = qd.make_policy(task.env, (16,))
    worst = -task.qd_offset(config.episode_length)
    common = {"key": jax.random.key(1), "limits": task.limits, "worst": worst}
    episode = qd.episode_of(
        task, policy, config.episode_length, options=GradientOptions(clip=10.0)
    )
    evaluate = qd.make_ribs_evaluation(episode.scoring(), **common)
    differentiate = qd.make_ribs_evaluation(
        episode.scoring(episode.gradient), jacobian=True, **common
    )

    grid = {
        "solution_dim": policy.size,
        "dims": (round(1024 ** (1 / task.descriptor_length)),) * task.descriptor_length,
        "ranges": list(zip(*task.limits, strict=True)),
        "qd_score_offset": worst,
    }
    archive = GridArchive(**grid, learning_rate=0.1, threshold_min=worst)
    result = GridArchive(**grid)
    emitters = [
        GradientArborescenceEmitter(
            archive,
            x0=np.asarray(policy.init(jax.random.key(seed))),
            sigma0=0.5,
            lr=1.0,
            ranker="imp",
            restart_rule="basic",
            batch_size=options.batch_size,
            seed=seed,
        )
        for seed in range(4)
    ]
    scheduler = Scheduler(archive, emitters, result)
    for iteration in range(options.iterations):
        scheduler.tell_dqd(*differentiate(scheduler.ask_dqd()))
        scheduler.tell(*evaluate(scheduler.ask()))
        if iteration % 10 == 0 or iteration == options.iterations - 1:
            stats = result.stats
            print(
                f"iteration {iteration}: QD score {stats.qd_score:,.0f}, "
                f"coverage {100 * stats.coverage:.1f} %, best {stats.obj_max:.1f}"
            )


if __name__ == "__main__":
    main()
