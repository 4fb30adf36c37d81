"""What gradient-based emitters refuse: scores without gradients, bad settings."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from emitter_problems import (
    MAKERS,
    SIZE,
    algorithm,
    along,
    begin,
    broken,
    centroids,
    compiled,
    emit,
    score,
    start,
)

from newton_qd.qd.emitters import (
    CMAMAEGAEmitter,
    CMAMEGAEmitter,
    GradientLineEmitter,
    GradientsError,
    GradientVariationEmitter,
    OMGMEGAEmitter,
    SteeringEmitter,
)
from newton_qd.qd.scoring.gradient_scores import normalize, read_scores

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def _without_gradients(genotypes: jax.Array, key: jax.Array) -> tuple:
    fitnesses, descriptors, _ = score(genotypes, key)
    return fitnesses, descriptors, {"grads": fitnesses}


@pytest.mark.parametrize("name", ["omg_mega", "cma_mega", "cma_maega", "mixed"])
def test_missing_gradients_are_named(name: str) -> None:
    scoring = _without_gradients
    search = algorithm(MAKERS[name](scoring), scoring, name == "cma_maega")
    with pytest.raises(
        GradientsError, match=r"extra_scores: got .*'grads'.*'gradients' is mis"
    ):
        jax.eval_shape(search.init, start(), centroids(), jax.random.key(0))


def test_errors_name_what_is_wrong() -> None:
    found = compiled(score)(start(), jax.random.key(0))
    fitnesses, descriptors, extra = jax.device_get(found)
    read = functools.partial(read_scores, start(), fitnesses, descriptors)
    with pytest.raises(GradientsError, match="extra_scores: got nothing"):
        read(None)
    swapped = {"gradients": np.swapaxes(extra["gradients"], 1, 2)}
    with pytest.raises(GradientsError, match=r"\(16, 20, 3\).*swap the last two axes"):
        read(swapped)
    with pytest.raises(GradientsError, match=r"got shape \(16, 19, 3\)"):
        read({"gradients": extra["gradients"][:, 1:]})
    with pytest.raises(GradientsError, match="ravel_pytree"):
        read_scores({"w": start()}, fitnesses, descriptors, extra)

    with pytest.raises(
        GradientsError, match=r"start: got .*\(3,\); allowed: .*\(20,\)"
    ):
        begin(CMAMEGAEmitter(score, sigma_g=1.0, start=jnp.zeros(3)))
    with pytest.raises(TypeError, match=r"selector: got 'best'; allowed: .*of a sel"):
        OMGMEGAEmitter(4, 1.0, selector="best")  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="AnnealedRepertoire"):
        begin(CMAMAEGAEmitter(score, sigma_g=1.0))
    with pytest.raises(ValueError, match=r"got 2 columns; allowed: 1 \+ D = 3 columns"):
        emitter = GradientVariationEmitter(4, optax.sgd(1.0), directions=[(1, 0)])
        emit(emitter, *begin(emitter))
    # Values are known outside jit only; what finds them may be compiled.
    emitter = CMAMEGAEmitter(compiled(broken), sigma_g=1.0, start=jnp.ones(SIZE))
    archive = begin(OMGMEGAEmitter(4, sigma_g=0.5))[0]
    with pytest.raises(GradientsError, match="not finite"):
        emitter.init(jax.random.key(0), archive, start(), fitnesses, descriptors, extra)


def test_gradients_that_were_set_to_zero_are_not_known() -> None:
    fitnesses, descriptors, extra = compiled(score)(start(), jax.random.key(0))
    read = functools.partial(read_scores, start(), fitnesses, descriptors)
    assert read(extra).finite.all()
    lost = jnp.zeros((len(fitnesses), 3), bool).at[2, 1].set(True)
    found = read({**extra, "overflowed": lost})
    assert np.flatnonzero(~found.finite).tolist() == [2]
    # the count of an emitter beside has another shape
    assert read({**extra, "overflowed": jnp.ones(4, jnp.int32)}).finite.all()


def lost(genotypes: jax.Array, key: jax.Array) -> tuple:
    """Scores of which no gradient is finite."""
    fitnesses, descriptors, extra = score(genotypes, key)
    return fitnesses, descriptors, {"gradients": jnp.nan * extra["gradients"]}


def test_elites_without_finite_gradients_are_not_known() -> None:
    repertoire, state = begin(OMGMEGAEmitter(4, sigma_g=0.5), scoring=lost)
    assert (repertoire.fitnesses > -jnp.inf).any()
    assert not state.known(repertoire).any()


def test_weight_decay_moves_nobody_without_a_gradient() -> None:
    emitter = GradientVariationEmitter(4, optax.adamw(0.1, weight_decay=1.0))
    genotypes = np.asarray(emit(emitter, *begin(emitter, 1, lost)))
    np.testing.assert_array_equal(genotypes, np.tile(start()[0], (4, 1)))


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e25, 3e38])
def test_lengths_of_large_gradients_do_not_overflow(size: float) -> None:
    rows = jnp.asarray([[0.6, 0.8], [0.0, 0.0]], jnp.float32) * size
    found = normalize(rows)
    assert not np.any(found[1])
    if size >= 1:
        np.testing.assert_allclose(found[0], [0.6, 0.8], rtol=1e-6)


def variation(directions: Any) -> GradientVariationEmitter:
    return GradientVariationEmitter(4, optax.sgd(1.0), directions=directions)


def line(**changes: Any) -> GradientLineEmitter:
    given = {"parents": 2, "branches": 2, "shortest": 0.1, "longest": 1.0, **changes}
    return GradientLineEmitter(along(score), **given)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: OMGMEGAEmitter(0, 1.0), "batch_size: got 0; allowed: .* from 1"),
        (lambda: OMGMEGAEmitter(4, 0.0), "sigma_g: got 0.0; allowed: .*above 0"),
        (lambda: CMAMEGAEmitter(score, sigma_g=-1.0), "sigma_g: got -1.0; .*above 0"),
        (lambda: CMAMEGAEmitter(score, sigma_g=1.0, batch_size=2), "got 2; .* from 3"),
        (
            lambda: CMAMEGAEmitter(score, sigma_g=1.0, restart_period=0),
            "restart_period: got 0; allowed: .* from 1",
        ),
        (
            lambda: GradientVariationEmitter(4, optax.sgd(1.0), steps=2),
            "steps: got 2; allowed: 1 without a scoring_function",
        ),
        (
            lambda: variation([1.0]),
            "directions: got .*; allowed: finite numbers",
        ),
        (
            lambda: variation([[1], [1, 2]]),
            r"directions: got \[\[1\], \[1, 2\]\]; allowed: finite numbers",
        ),
        (lambda: variation(np.zeros((0, 3))), r"directions: got \[\]; .*K from 1"),
        (lambda: variation([[np.nan, 1.0]]), r"directions: got \[\[nan, 1.0\]\]; all"),
        (
            lambda: variation([[1e300, 0.0]]),
            r"directions: got \[\[1e\+300, 0.0\]\]; all",
        ),
        (
            lambda: variation([[10**400, 1]]),
            "directions: got .*; allowed: finite numbers",
        ),
        (
            lambda: variation([["1", "2"]]),
            "directions: got .*'1', '2'.*; allowed: finite",
        ),
        (lambda: variation([[1j, 0]]), "directions: got .*; allowed: finite numbers"),
        (
            lambda: line(parents=0),
            "parents: got 0; allowed: .* from 1",
        ),
        (lambda: line(steered=2.0), "steered: got 2.0; .* from 0 to 1"),
        (lambda: line(longest=0.05), "longest: got 0.05; .* numbers from 0.1"),
        (lambda: line(longest=np.inf), "longest: got inf;.*finite"),
        (lambda: SteeringEmitter(4, max_step=0.0), "max_step: got 0.0; .*above 0"),
        (lambda: SteeringEmitter(4, max_step=1.0, steps=0), "steps: got 0; .* from 1"),
    ],
)
def test_bad_settings_are_refused(make: Callable, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
