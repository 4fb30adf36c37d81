"""Scores with gradients, as QDax's emitters take them."""

from __future__ import annotations

import functools
from typing import Any

import jax
import numpy as np
import pytest
from point_runs import SMALL, PointEnv, PointState, point_task

from newton_qd.extractors import get_final_xy_position
from newton_qd.gradients import GradientOptions
from newton_qd.gradients.scores import unit_rows
from newton_qd.qd import make_policy, make_scoring_function
from newton_qd.qd.scoring.gradient_scoring import make_gradient_scoring_function
from newton_qd.qd.scoring.task import Task

STEPS = 6


class SmoothPoint(PointEnv):
    """The point of the evolution's tests, described by where it is."""

    def _state(self, position: jax.Array, reward: jax.Array) -> PointState:
        state = super()._state(position, reward)
        info = {**state.info, "state_descriptor": position}
        return PointState(position, state.obs, reward, state.done, info)


def smooth_task() -> Task:
    rough = point_task(SMALL)
    two = np.full(2, 2, np.float32)
    return Task(SmoothPoint(), get_final_xy_position, (-two, two), rough.labels, 5.0)


@pytest.mark.parametrize(
    "make", [make_scoring_function, make_gradient_scoring_function]
)
def test_genotypes_that_are_no_weights(make: Any) -> None:
    task = smooth_task()
    policy = make_policy(task.env, (4,))
    score, key = make(task, policy, STEPS), jax.random.key(1)
    for shape in ((4, policy.size + 1), (policy.size,)):
        with pytest.raises(
            ValueError, match=r"genotypes: got shape \(.*allowed: \(N, "
        ):
            score(np.zeros(shape, np.float32), key)
    shape = (2, policy.size)
    whole = jax.jit(score)(np.ones(shape, np.int32), key)
    real = jax.jit(score)(np.ones(shape, np.float32), key)
    np.testing.assert_array_equal(whole[0], real[0])


def test_scores_are_those_without_gradients_and_point_uphill() -> None:
    task = smooth_task()
    policy = make_policy(task.env, (4,))
    draw = jax.jit(jax.vmap(policy.init))
    genotypes = np.array(draw(jax.random.split(jax.random.key(0), 8)))
    genotypes[3, 0] = np.nan
    key = jax.random.key(1)
    score = jax.jit(make_gradient_scoring_function(task, policy, STEPS))
    fitnesses, descriptors, extra = jax.device_get(score(genotypes, key))
    plain = jax.jit(make_scoring_function(task, policy, STEPS))
    without = plain(genotypes, key)
    np.testing.assert_array_equal(fitnesses, without[0])
    np.testing.assert_array_equal(descriptors, without[1])
    gradients, unit = extra["gradients"], extra["normalized_grads"]
    assert gradients.shape == unit.shape == (8, policy.size, 3)
    np.testing.assert_array_equal(extra["faulty"], np.arange(8) == 3)
    assert extra["overflowed"].shape == (8, 3) and not extra["overflowed"].any()
    assert np.isfinite(gradients).all() and np.isfinite(unit).all()
    sound = np.arange(8) != 3
    sizes = np.linalg.norm(unit, axis=1)
    np.testing.assert_allclose(sizes[sound], 1.0, 1e-5)
    assert not unit[3].any()
    for row in range(3):
        ahead = score(genotypes + 1e-2 * unit[:, :, row], key)
        before = np.append(fitnesses[:, None], descriptors, 1)[:, row]
        after = np.append(ahead[0][:, None], ahead[1], 1)[:, row]
        assert (after[sound] > before[sound]).all()


def test_pytree_genotypes_and_plans() -> None:
    task, key = smooth_task(), jax.random.key(1)
    small = functools.partial(np.full, fill_value=0.1, dtype=np.float32)
    weights = {"a": small((5, 2, 3)), "b": {"c": small((5, 2))}}

    def policy(tree: Any, obs: jax.Array) -> jax.Array:
        return tree["a"] @ obs + tree["b"]["c"]

    score = make_gradient_scoring_function(
        task, policy, STEPS, GradientOptions(window=2, clip=10.0)
    )
    extra = jax.device_get(jax.jit(score)(weights, key)[2])
    for name in ("gradients", "normalized_grads"):
        shapes = jax.tree.map(lambda x: x.shape, extra[name])
        assert shapes == {"a": (5, 2, 3, 3), "b": {"c": (5, 2, 3)}}
    squares = [
        np.square(x).reshape(5, -1, 3).sum(1) for x in jax.tree.leaves(extra[name])
    ]
    np.testing.assert_allclose(sum(squares), 1.0, 1e-5)
    # a leaf without numbers has no length
    given = {**extra["gradients"], "none": np.zeros((5, 0, 3), np.float32)}
    found = jax.jit(unit_rows)(given)
    np.testing.assert_array_equal(found["a"], extra["normalized_grads"]["a"])
    # a plan of actions, in any shape of as many numbers
    score = jax.jit(make_gradient_scoring_function(task, None, STEPS))
    plans = np.random.default_rng(0).normal(size=(5, STEPS, 2)).astype(np.float32)
    given = plans, plans.reshape(5, -1)
    shaped, flat = (jax.device_get(score(each, key)) for each in given)
    assert shaped[2]["gradients"].shape == (5, STEPS, 2, 3)
    np.testing.assert_array_equal(
        shaped[2]["gradients"].reshape(5, -1, 3), flat[2]["gradients"]
    )


def test_directions_of_the_largest_numbers() -> None:
    """Their norm is no number, and their direction is."""
    large = np.array([[[3e38], [-3e38], [3e38], [3e38]]], np.float32)
    rows = np.asarray(jax.jit(unit_rows)(large))
    np.testing.assert_allclose(rows[0, :, 0], [0.5, -0.5, 0.5, 0.5], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["omg", "cma"])
def test_qdax_emitters_take_the_gradients(name: str) -> None:
    from qdax.core.containers.mapelites_repertoire import compute_euclidean_centroids
    from qdax.core.emitters.cma_mega_emitter import CMAMEGAEmitter
    from qdax.core.emitters.omg_mega_emitter import OMGMEGAEmitter
    from qdax.core.map_elites import MAPElites
    from qdax.utils.metrics import default_qd_metrics

    task = smooth_task()
    policy = make_policy(task.env, (4,))
    score: Any = make_gradient_scoring_function(task, policy, STEPS)
    low, high = (limit.tolist() for limit in task.limits)
    centroids = compute_euclidean_centroids((8, 8), low, high)
    genotypes = jax.vmap(policy.init)(jax.random.split(jax.random.key(0), 8))
    if name == "omg":
        emitter = OMGMEGAEmitter(8, 0.1, 2, centroids)
    else:
        emitter = CMAMEGAEmitter(score, 8, 0.1, 2, centroids, 0.1)
    search = MAPElites(
        score, emitter, lambda repertoire: default_qd_metrics(repertoire, 50.0)
    )
    repertoire, state, first = search.init(genotypes, centroids, jax.random.key(0))
    update = jax.jit(search.update)
    last = first
    for step in range(5):
        repertoire, state, last = update(repertoire, state, jax.random.key(step))
    assert last["qd_score"] > first["qd_score"]
    found = repertoire.fitnesses.ravel() > -np.inf
    assert np.isfinite(jax.tree.leaves(repertoire.genotypes)[0][found]).all()
