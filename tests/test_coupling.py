"""Several pairs of one robot that touch at once, solved with its tree."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest
from coupled_bodies import (
    centres_of_mass,
    coupled_system,
    dense_step,
    touches,
    touching_states,
)
from physics_helpers import (
    batched_step,
    directional_errors,
    functional,
    one_step,
    report,
)

from newton_qd import physics
from newton_qd.physics import buffers
from newton_qd.physics.stepping import Solves

TREES = pytest.mark.parametrize("free", [True, False], ids=["free root", "slides"])


@TREES
def test_solve_is_the_dense_one(
    x64: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    free: bool,
) -> None:
    """(H + sum D^T W D) x = b + sum D^T P, of four pairs and the ground."""
    monkeypatch.setattr(buffers, "substep_solves", lambda _: Solves(1, 2))
    system = coupled_system(tmp_path, free, friction=0.0)
    assert len(system.contact_pairs) == 4
    q, v = touching_states(system, np.random.default_rng(0), 12)
    after = batched_step(system)(q, v, np.zeros((12, 0)))
    _, *found, fault = (np.asarray(x) for x in after)
    assert not fault.any()
    assert (found[2][:, np.unique(system.contact_body)] > 0).all()
    for world in range(12):
        assert max(touch.gap for touch in touches(system, q[world])) < 0.01
    expected = [dense_step(system, *state) for state in zip(q, v, strict=True)]
    for name, got, dense in zip(
        ("velocity", "impulse", "normal impulse"),
        found,
        map(np.array, zip(*expected, strict=True)),
        strict=True,
    ):
        scale = np.abs(dense).max()
        report(f"largest error of {name}", np.abs(got - dense).max() / scale)
        np.testing.assert_allclose(got, dense, rtol=0, atol=1e-12 * scale)


@TREES
def test_pairs_only_pass_momentum_on(x64: None, tmp_path: Path, free: bool) -> None:
    """Without a ground the impulses cancel, linear and about the origin."""
    system = coupled_system(tmp_path, free, ground=False)
    q, v = touching_states(system, np.random.default_rng(1), 12)
    after = batched_step(system)(q, v, np.zeros((12, 0)))
    impulse = np.asarray(after[2])
    assert (np.asarray(after[3])[:, np.unique(system.contact_body)] > 0).all()
    np.testing.assert_allclose(impulse[..., :3].sum(axis=1), 0.0, atol=1e-12)
    arms = np.array([centres_of_mass(system, one) for one in q])
    spin = impulse[..., 3:] + np.cross(arms, impulse[..., :3])
    np.testing.assert_allclose(spin.sum(axis=1), 0.0, atol=1e-12)


@TREES
def test_order_of_pairs_does_not_matter(x64: None, tmp_path: Path, free: bool) -> None:
    """Neither that of the pairs nor that of the two sides."""
    results = []
    for backwards in (False, True):
        system = coupled_system(tmp_path, free, backwards=backwards)
        q, v = touching_states(system, np.random.default_rng(2), 12)
        results.append(batched_step(system)(q, v, np.zeros((12, 0))))
    for field in range(4):
        one, other = (np.asarray(result[field]) for result in results)
        scale = np.abs(one).max()
        report(f"largest change of field {field}", np.abs(one - other).max() / scale)
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12 * scale)


@pytest.mark.slow  # compiles the adjoint
@TREES
@pytest.mark.parametrize(("steps", "bound"), [(1, 1e-6), (4, 1e-6)])
def test_directional_derivatives(
    x64: None, tmp_path: Path, free: bool, steps: int, bound: float
) -> None:
    system = coupled_system(tmp_path, free)
    q, v = touching_states(system, np.random.default_rng(3), 12)
    value = functional(system, steps)
    errors = directional_errors(lambda q, v: value(q, v, np.zeros(0)), (q, v))
    report("largest error for q, v", errors.max(axis=1))
    assert errors.max() < bound


@pytest.mark.slow  # compiles the adjoint
@TREES
def test_worlds_that_do_not_touch_ignore_their_neighbours(
    x64: None, tmp_path: Path, free: bool
) -> None:
    """Bitwise, values and gradients: in a pack with a world that touches, and not."""
    system = coupled_system(tmp_path, free)
    q, v = touching_states(system, np.random.default_rng(4), 8)
    # all but one world of a pack: in the air, the arms turned apart
    apart = np.arange(8) % 4 != 1
    raised = 2 if free else system.q_start[system.body_names.index("torso_1")]
    arms = system.q_start[[system.body_names.index(name) for name in "abcd"]]
    rng = np.random.default_rng(5)
    for world in np.flatnonzero(apart):
        q[world, raised] += 1.0
        while np.asarray(physics.contact_gaps(system, q[world])).min() < 0.06:
            q[world, arms] = rng.uniform(-1.5, 1.5, 4)
    gaps = np.array([physics.contact_gaps(system, one) for one in q])
    assert gaps[apart].min() > 0.05
    assert gaps[~apart].max() < 0.01

    @jax.jit
    @jax.vmap
    def step(q: jax.Array, v: jax.Array) -> tuple[tuple[jax.Array, ...], ...]:
        def advance(q: jax.Array, v: jax.Array) -> tuple[jax.Array, ...]:
            return one_step(system)(q, v, np.zeros(0))[:4]

        result, pull = jax.vjp(advance, q, v)
        return result, pull(jax.tree.map(lambda x: 1.0 + 0.0 * x, result))

    together = jax.tree.leaves(step(q, v))
    touching = np.asarray(together[3])[~apart]
    assert (touching[:, np.unique(system.contact_body)] > 0).all()
    for world in range(8):
        copies = np.full(8, world)
        alone = jax.tree.leaves(step(q[copies], v[copies]))
        for one, other in zip(together, alone, strict=True):
            np.testing.assert_array_equal(one[world], other[world])
            assert np.isfinite(one[world]).all()
