"""Gradients over 32 control steps, and where differences around them say little.

Every simulated environment, from states in and out of contact, along random directions
of all that a rollout depends on: coordinates, velocities, the actions of all steps and
the physical parameters. As long as no contact gap and no gap to a joint limit changes
its sign at any substep between the two points of a difference, the gradient is that of
the function. Wider differences pass through such changes: how far they are then off is
the map in docs/gradients.md.
"""

from __future__ import annotations

import collections
import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adjoint_helpers import Inputs, inputs_of, make, simulated, weighted
from gap_changes import changes, gap_names, gaps_of
from physics_helpers import report

from newton_qd import physics

pytestmark = pytest.mark.slow

STEPS, WORLDS, DIRECTIONS = 32, 8, 16
# Distance of the differences: so small because gradients of the halfcheetah reach 1e9.
DISTANCE = 1e-10
# Where rounding is small, but the halfcheetah's differences meet changes already.
WIDER = 1e-6
REACHES = (1e-4, 1e-3, 1e-2)  # of the map


def planned(env: Any) -> Inputs:
    """Inputs of several worlds with an action for every step."""
    plan = np.random.default_rng(3).uniform(-0.9, 0.9, (WORLDS, STEPS, env.action_size))
    return {**inputs_of(env, WORLDS), "action": plan}


def unit_directions(inputs: Inputs) -> Inputs:
    """Random directions (worlds, directions, ...) of norm 1 over all inputs."""
    rng = np.random.default_rng(4)
    drawn = {
        name: rng.normal(size=(WORLDS, DIRECTIONS, *np.shape(x)[1:]))
        for name, x in inputs.items()
    }
    size = np.sqrt(sum((_flat(x) ** 2).sum(axis=-1) for x in drawn.values()))
    return {
        name: x / size.reshape(WORLDS, DIRECTIONS, *[1] * (x.ndim - 2))
        for name, x in drawn.items()
    }


def _flat(x: np.ndarray) -> np.ndarray:
    return np.asarray(x).reshape(WORLDS, DIRECTIONS, -1)


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Derivatives along directions by the adjoint and by differences over a distance.

    Attributes:
        exact: (worlds, directions).
        central: (worlds, directions).
        first: (worlds, directions, gaps) as :func:`gap_changes.changes`.
    """

    exact: np.ndarray
    central: np.ndarray
    first: np.ndarray

    @property
    def changed(self) -> np.ndarray:
        """Whether any gap changes its sign (worlds, directions)."""
        return np.asarray((self.first >= 0).any(axis=-1))

    @property
    def cosine(self) -> np.ndarray:
        """Between the derivatives along all directions of a world (worlds,)."""
        size = np.linalg.norm(self.exact, axis=1) * np.linalg.norm(self.central, axis=1)
        return (self.exact * self.central).sum(axis=1) / size

    @property
    def error(self) -> np.ndarray:
        """Difference of both, in units of a typical derivative (worlds, directions)."""
        typical = np.sqrt((self.exact**2).mean(axis=1, keepdims=True))
        return np.abs(self.central - self.exact) / typical


@functools.cache
def comparisons(name: str) -> dict[float, Comparison]:
    """The comparison over each distance."""
    env = make(name)
    inputs, weigh = planned(env), weighted(env)
    directions = unit_directions(inputs)

    def value(inputs: Inputs) -> jax.Array:
        return weigh(inputs, STEPS)

    gradient = jax.jit(jax.vmap(jax.grad(value)))(inputs)
    exact = sum(
        _flat(np.asarray(gradient[part])[:, None] * x).sum(axis=-1)
        for part, x in directions.items()
    )
    several = jax.jit(jax.vmap(jax.vmap(value)))
    compare = jax.jit(jax.vmap(jax.vmap(functools.partial(changes, env))))
    found = {}
    for distance in (DISTANCE, WIDER, *REACHES):
        ahead, behind = (
            {part: inputs[part][:, None] + move * x for part, x in directions.items()}
            for move in (distance, -distance)
        )
        central = np.asarray(several(ahead) - several(behind)) / (2 * distance)
        first = np.asarray(compare(ahead, behind))
        found[distance] = Comparison(np.asarray(exact), central, first)
    return found


@pytest.mark.parametrize("name", simulated())
def test_gradient_of_32_steps(x64: None, name: str) -> None:
    """Cosine above 0.999999 in every world: over that distance no gap changes sign."""
    found = comparisons(name)
    report("map", _row(name, found))
    assert not found[DISTANCE].changed.any()
    assert (found[DISTANCE].cosine > 0.999999).all()


def _row(name: str, found: dict[float, Comparison]) -> str:
    """The environment's row of the map in docs/gradients.md."""
    apart = [1.0 - found[distance].cosine.min() for distance in (DISTANCE, WIDER)]
    cells = [f"`{name}`", *(f"{max(x, 1e-16):.0e}" for x in apart)]
    for reach in REACHES:
        changed, error = found[reach].changed, found[reach].error
        parts = (error[~changed], error[changed])
        sizes = [f"{np.median(part):.0e}" if part.size else "-" for part in parts]
        cells += [f"{changed.mean():.2f}", ", ".join(sizes)]
    cells.append(_where(make(name).unwrapped.system, found[REACHES[-1]].first))
    return f"| {' | '.join(cells)} |"


def _where(system: physics.System, first: np.ndarray) -> str:
    """The gaps that change in most directions, and in which step as a median."""
    steps = collections.defaultdict(list)
    columns = first.reshape(WORLDS * DIRECTIONS, first.shape[-1]).T
    for gap, column in zip(gap_names(system), columns, strict=True):
        steps[gap] += [int(step) + 1 for step in column if step >= 0]
    often = sorted(steps.items(), key=lambda item: -len(item[1]))[:2]
    named = [f"{gap} ({np.median(seen):.0f})" for gap, seen in often if seen]
    return ", ".join(named) or "-"


@pytest.mark.parametrize("name", ["antmaze", "halfcheetah_uni", "swimmer"])
def test_rollout_by_substeps_is_the_rollout(x64: None, name: str) -> None:
    """What the changes of gaps are read from moves as the environment does."""
    env = make(name)
    inputs = planned(env)
    inputs["action"] = inputs["action"][:, :2]
    params = {n: inputs[n] for n in inputs if n not in ("q", "v", "action")}

    def rollout(inputs: Inputs, params: Any) -> jax.Array:
        system = env.unwrapped.system
        state = first.replace(
            pipeline_state=physics.initial_state(system, inputs["q"], inputs["v"])
        )
        for action in inputs["action"]:
            state = env.step(state, action, physics.PhysicsParams(**params))
        return state.pipeline_state.q

    first = jax.jit(env.reset)(jax.random.key(0))
    expected = jax.jit(jax.vmap(rollout))(inputs, params)
    gaps, last = jax.jit(jax.vmap(gaps_of(env)))(inputs)
    np.testing.assert_allclose(last, expected, rtol=1e-12, atol=1e-12)
    start = jnp.concatenate([gaps[:, 0, 0], gaps[:, -1, -1]])
    assert np.isfinite(start).all()
    assert gaps.shape[-1] == len(gap_names(env.unwrapped.system))
