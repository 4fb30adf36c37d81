"""Optimize sequences of actions into a repertoire of different gaits.

    python examples/gait_repertoire.py

A genotype has the actions of every control step. Half of the offspring are steps along
exact gradients.
"""

from __future__ import annotations

import argparse
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from qdax.core.containers.mapelites_repertoire import compute_euclidean_centroids
from qdax.core.emitters.multi_emitter import MultiEmitter
from qdax.core.emitters.mutation_operators import isoline_variation
from qdax.core.emitters.standard_emitters import MixingEmitter
from qdax.core.map_elites import MAPElites
from qdax.utils.metrics import default_qd_metrics

import newton_qd
from newton_qd import gradients
from newton_qd.qd.emitters import GradientLineEmitter


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--env", default="hopper_uni")
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--batch-size", type=int, default=64)
    options = parser.parse_args()

    env: Any = newton_qd.create(options.env, auto_reset=False)
    episode = gradients.Episode(
        gradients.with_smooth_descriptor(env, 0.1, straight_through=True),
        None,  # no policy: the genotypes are the actions
        newton_qd.tables.descriptor_extractor[options.env],
        episode_length=options.steps,
        options=gradients.GradientOptions(clip=10.0),
        unravel=jnp.tanh,
    )
    score = episode.scoring()
    start, key = jax.random.split(jax.random.key(0))
    line = GradientLineEmitter(
        lambda plans, ways, _: episode.directional(plans, ways, start),
        parents=options.batch_size // 8,
        **{"branches": 4, "shortest": 0.05, "longest": 5.0},
    )
    variation = functools.partial(isoline_variation, iso_sigma=0.05, line_sigma=0.2)
    parts: Any = (lambda x, _: x, variation, 1.0, options.batch_size // 2)
    metrics = functools.partial(default_qd_metrics, qd_offset=0.0)
    search = MAPElites(
        lambda plans, _: score(plans, start),
        MultiEmitter((line, MixingEmitter(*parts))),
        metrics,
    )
    shape = options.batch_size, options.steps * env.action_size
    plans = jax.random.normal(key, shape, jnp.float32)
    low, high = (limit.tolist() for limit in env.descriptor_limits)
    cells = compute_euclidean_centroids((16,) * len(low), low, high)
    repertoire, state, found = search.init(plans, cells, key)
    update = jax.jit(search.update)
    for iteration in range(1, options.iterations + 1):
        key, step_key = jax.random.split(key)
        repertoire, state, found = update(repertoire, state, step_key)
        if iteration % 20 == 0:
            print(iteration, {name: f"{value:.1f}" for name, value in found.items()})
    for cell in np.flatnonzero(repertoire.fitnesses[:, 0] > -jnp.inf):
        contact = ", ".join(f"{share:.2f}" for share in repertoire.descriptors[cell])
        print(f"feet on the ground {contact}: {repertoire.fitnesses[cell, 0]:.1f}")


if __name__ == "__main__":
    main()
