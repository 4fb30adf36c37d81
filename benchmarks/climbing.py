"""Shows what an archive gains from elites that climb, for several settings.

The archive is that of a variant after some generations, with seed and settings of the
protocol ``field``. Climbers (``AscentEmitter``) begin at its elites, the same for all
settings, and begin again only if their gradient was lost. Nothing else is emitted. The
gain is that of the QD score with offset, before re-evaluation:

    python benchmarks/climbing.py walker2d_uni me@6 --generations 40 \
        --settings climb_worlds=4 --settings climb_termination_width=0

The first line of the table has the defaults.
"""

from __future__ import annotations

import argparse
import functools
import math
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import study_runs
from actor_alone import changed
from study_execution import Progress
from study_protocols import FIELD

from newton_qd.qd.algorithms.climbing import ascent_emitter
from newton_qd.qd.algorithms.me_ascent import ME_ASCENT, MEAscentOptions
from newton_qd.qd.algorithms.spec import EmitterContext
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.scoring.robust import run_scoring
from newton_qd.qd.scoring.rollout import make_policy
from newton_qd.qd.scoring.task import make_task


def archive(task: str, variant: str, generations: int, seed: int) -> Any:
    """Returns the repertoire of a variant after some generations."""
    run = study_runs.Run(task, variant, seed)
    with tempfile.TemporaryDirectory() as out:
        search = Progress(FIELD, run, Path(out), math.inf)
    for _ in range(generations):
        search.advance()
    return search.state.repertoire


def gains(context: EmitterContext, repertoire: Any, options: Any, steps: int) -> Any:
    """Yields the QD score with offset after each step of the climbers."""
    offset = context.task.qd_offset(context.config.episode_length)
    emitter = ascent_emitter(context, options, options.climbers)
    nothing: Any = None  # climbers begin at the elites alone
    state = emitter.init(jax.random.key(5), repertoire, *[nothing] * 4)
    update, begun = jax.jit(emitter.state_update), repertoire
    for _ in range(steps):
        state = update(state, begun)
        weights, _ = emitter.emit(begun, state, jax.random.key(0))
        fitnesses, descriptors, _ = context.score(weights, context.reset_key)
        repertoire = repertoire.add(weights, descriptors, fitnesses)
        found = np.asarray(repertoire.fitnesses)[:, 0]
        yield float(np.sum(found[found > -np.inf] + offset))


def _options(config: EvolveConfig, climbers: int, settings: list) -> MEAscentOptions:
    """Returns the options of climbers that live longer than the measurement."""
    values = {"climbers": climbers, "climb_steps": 10**6, **dict(settings)}
    return ME_ASCENT.read_options(config.replace(algorithm="me-ascent", options=values))


def main() -> None:
    """Prints the gain after some numbers of steps, for each setting."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task", choices=FIELD.tasks)
    parser.add_argument("variant", help="a key of study/field.toml")
    parser.add_argument("--generations", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1000, help="default: the tuning's")
    parser.add_argument("--climbers", type=int, default=64)
    parser.add_argument("--steps", type=int, default=16)
    parser.add_argument(
        "--settings",
        type=functools.partial(changed, kind=MEAscentOptions),
        nargs="+",
        action="append",
        default=[[]],
        metavar="NAME=X",
    )
    args = parser.parse_args()
    if args.variant not in study_runs.variants():
        parser.error(f"variant: got {args.variant}; allowed: a key of study/field.toml")
    for name in ("generations", "steps"):
        if getattr(args, name) < 1:
            parser.error(
                f"--{name}: got {getattr(args, name)}; allowed: integers from 1"
            )
    given = {**FIELD.settings_of(args.task), **study_runs.variants()[args.variant]}
    given = {key: value for key, value in given.items() if key != "options"}
    config = EvolveConfig(env_name=args.task, seed=1, iterations=1, **given)
    try:
        asked = [_options(config, args.climbers, each) for each in args.settings]
    except ConfigError as error:
        parser.error(str(error))
    task = make_task(config)
    config = config.resolve(task.descriptor_length)
    policy = make_policy(task.env, config.hidden)
    begun = archive(args.task, args.variant, args.generations, args.seed)
    score = jax.jit(run_scoring(config, task, policy))
    reset_key = jax.random.key(9)
    context = EmitterContext(config, task, policy, score, reset_key, begun.centroids)
    found = np.asarray(begun.fitnesses)[:, 0]
    found = found[found > -np.inf]
    base = np.sum(found + task.qd_offset(config.episode_length))
    print(f"{found.size} elites, QD score {base:,.0f}, best {found.max():,.0f}\n")
    marks = [n for n in (1, 2, 4, 8, 16, 32, 64) if n <= args.steps]
    print(
        "| " + " | ".join(["settings", *map(str, marks), "processor time [s]"]) + " |"
    )
    print("|---" * (len(marks) + 2) + "|", flush=True)
    for settings, options in zip(args.settings, asked, strict=True):
        begin = time.process_time()
        scores = list(gains(context, begun, options, args.steps))
        cells = [", ".join(f"{k}={v:g}" for k, v in settings) or "defaults"]
        cells += [f"{scores[n - 1] - base:,.0f}" for n in marks]
        cells += [f"{time.process_time() - begin:.0f}"]
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
