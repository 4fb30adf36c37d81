"""Worker of ``compare_brax.py``: times one library, one command at a time.

The script runs in the library's own Python environment and imports nothing of
``newton_qd`` unless it measures it, so it has to run on old releases of JAX too.
It reads one JSON object a line from standard input and answers each with one JSON
object a line; ``prepare`` compiles, ``measure`` repeats the compiled call, so that
a driver can take turns between libraries.
"""

from __future__ import annotations

import functools
import importlib.metadata
import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gait_runs import GaitRuns

ENV_NAME = "ant_uni"
EPISODE_LENGTH = 1000
SEED = 0
# A robot that has covered less ground than this on average did not move [m].
MOVED = 0.01
# Variables that could keep a library off a core; reported with the result.
PINNING = ("OMP_NUM_THREADS", "XLA_FLAGS", "NEWTON_QD_THREADS")


def make_newton_qd(**options: Any) -> Any:
    """Return the environment of this project."""
    import newton_qd

    return newton_qd.create(ENV_NAME, episode_length=EPISODE_LENGTH, **options)


def make_brax_v1(**options: Any) -> Any:
    """Return QDax's environment on brax v1, which runs its legacy spring physics."""
    from qdax.tasks.brax import v1

    return v1.create(ENV_NAME, episode_length=EPISODE_LENGTH, **options)


LIBRARIES: dict[str, tuple[Callable[..., Any], tuple[str, ...]]] = {
    "newton_qd": (make_newton_qd, ("jax", "newton", "warp-lang")),
    "brax_v1": (make_brax_v1, ("jax", "brax", "qdax")),
}


def rollout(env: Any, state: Any, actions: jax.Array) -> tuple[Any, dict[str, Any]]:
    """Step a batch through a scan, as QDax does.

    Args:
        env: Unbatched environment with auto-reset.
        state: Batched state; every leaf has the worlds in front.
        actions: (steps, worlds, nu) [-].

    Returns:
        The last state, whole, so that nothing the environment computes is dead
        code; and per step what a Quality-Diversity rollout keeps.
    """

    def body(carry: Any, action: jax.Array) -> tuple[Any, dict[str, Any]]:
        new = jax.vmap(env.step)(carry, action)
        kept = {
            "reward": new.reward,
            "done": new.done,
            "state_descriptor": new.info["state_descriptor"],
        }
        if "fault" in new.info:
            kept["fault"] = new.info["fault"]
        return new, kept

    return jax.lax.scan(body, state, actions)


def plan(env: Any, state: Any, actions: jax.Array) -> tuple[Any, dict[str, Any]]:
    """Run a batch of plans of actions in one call, where the library can.

    The environment has no auto-reset. Arguments and result are those of ``rollout``.
    """
    if not hasattr(env, "rollout"):
        return rollout(env, state, actions)
    states = jax.vmap(env.rollout, in_axes=(0, 1), out_axes=1)(state, actions)
    kept = {
        "reward": states.reward,
        "done": states.done,
        "state_descriptor": states.info["state_descriptor"],
        "fault": states.info["fault"],
    }
    return jax.tree_util.tree_map(lambda leaf: leaf[-1], states), kept


def forward(env: Any, state: Any, actions: jax.Array) -> tuple[Any, None]:
    """Return the rollout."""
    return rollout(env, state, actions), None


def gradient(
    env: Any, state: Any, actions: jax.Array, run: Any = rollout
) -> tuple[Any, jax.Array]:
    """Return the rollout, and the gradient of its reward sum by the actions."""

    def reward_sum(actions: jax.Array) -> tuple[jax.Array, Any]:
        rolled = run(env, state, actions)
        return rolled[1]["reward"].sum(), rolled

    slope, rolled = jax.grad(reward_sum, has_aux=True)(actions)
    return rolled, slope


def forward_plan(env: Any, state: Any, actions: jax.Array) -> tuple[Any, None]:
    """Return the rollout of plans."""
    return plan(env, state, actions), None


KINDS = {
    "forward": forward,
    "gradient": gradient,
    "plan": forward_plan,
    "plan_gradient": functools.partial(gradient, run=plan),
}


def all_finite(tree: Any) -> bool:
    """Whether every floating-point number of a tree is finite."""
    leaves = (np.asarray(leaf) for leaf in jax.tree_util.tree_leaves(tree))
    return all(
        bool(np.isfinite(leaf).all())
        for leaf in leaves
        if np.issubdtype(leaf.dtype, np.floating)
    )


def distance(state: Any) -> float:
    """Mean distance of the robots from where they started [m]."""
    x, y = (np.asarray(state.metrics[f"{axis}_position"]) for axis in "xy")
    return float(np.hypot(x, y).mean())


def check(result: tuple[Any, jax.Array | None]) -> dict[str, Any]:
    """Say whether a run counts: finite, no fault, the robot moved."""
    (last, kept), slope = result
    moved = distance(last)
    finite = all_finite((last, kept, slope))
    faults = int(np.count_nonzero(np.asarray(kept.get("fault", 0))))
    valid = finite and faults == 0 and moved > MOVED
    report = {"finite": finite, "faults": faults, "moved_m": moved}
    if slope is not None:
        norm = float(np.linalg.norm(np.asarray(slope, dtype=np.float64)))
        report["gradient_norm"] = norm
        valid = valid and norm > 0.0
    return {"valid": valid, **report}


class Worker:
    """Compiled scenarios of one library."""

    def __init__(self, library: str) -> None:
        self._make, self._packages = LIBRARIES[library]
        self._runs: dict[str, Callable[[], Any]] = {}

    @functools.cached_property
    def _env(self) -> Any:
        return self._make()

    @functools.cached_property
    def _env_of_plans(self) -> Any:
        return self._make(auto_reset=False)

    def describe(self) -> dict[str, Any]:
        """Return versions, device and what could keep the library off a core."""
        return {
            "versions": {p: importlib.metadata.version(p) for p in self._packages},
            "python": sys.version.split()[0],
            "device": str(jax.devices()[0]),
            "cores": len(os.sched_getaffinity(0)),
            "pinning": {k: os.environ[k] for k in PINNING if k in os.environ},
        }

    def prepare(
        self, name: str, kind: str, worlds: int, steps: int, calls: int
    ) -> dict[str, Any]:
        """Compile a scenario, run it once and check what it did."""
        env = self._env_of_plans if kind.startswith("plan") else self._env
        keys = jax.random.split(jax.random.PRNGKey(SEED), worlds)
        state = jax.jit(jax.vmap(env.reset))(keys)
        # NumPy's generator: the same actions in every library and JAX release.
        actions = jnp.asarray(
            np.random.default_rng(SEED)
            .uniform(-1.0, 1.0, (steps, worlds, env.action_size))
            .astype(np.float32)
        )
        call = jax.jit(functools.partial(KINDS[kind], env))

        def run() -> None:
            for _ in range(calls):
                jax.block_until_ready(call(state, actions))

        start = time.perf_counter()
        result = jax.block_until_ready(call(state, actions))
        first = time.perf_counter() - start
        self._runs[name] = run
        return {"first_call_s": first, **check(result)}

    def measure(self, name: str) -> dict[str, Any]:
        """Run a prepared scenario; returns wall and processor seconds."""
        wall, cpu = time.perf_counter(), time.process_time()
        self._runs[name]()
        return {
            "wall_s": time.perf_counter() - wall,
            "cpu_s": time.process_time() - cpu,
        }


def main() -> None:
    """Answer commands until standard input ends."""
    # Libraries print to standard output when they load; answers must not mix.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    worker = Worker(sys.argv[1])
    commands: dict[str, Callable[..., dict[str, Any]]] = {
        "describe": worker.describe,
        "prepare": worker.prepare,
        "measure": worker.measure,
        "gaits": GaitRuns(sys.argv[1]).run,
    }
    for line in sys.stdin:
        message = json.loads(line)
        command = commands[message.pop("command")]
        print(json.dumps(command(**message)), file=answers, flush=True)


if __name__ == "__main__":
    main()
