"""Speed of one environment on the present device, forward and with gradient.

    python benchmarks/throughput.py [--env ant_uni] [--batches 1024 4096]
    python benchmarks/throughput.py --suite [--batches 1024] [--names humanoid antmaze]
                                    [--clock processor]
    python benchmarks/throughput.py --ratios [--batches 128] [--names ant hopper]
    python benchmarks/throughput.py --lanes [--env ant_uni] [--batches 4096 16384]

A figure counts only if every state stays finite; times are medians after a warm-up,
with the result waited for. ``--suite`` compares every environment with the ant: both
take turns, so that what else the machine does matters little, and the speed is counted
per degree of freedom and contact. On a CPU that others use too, compare processor time.
``--ratios`` says how much longer a step with its gradient takes, for every environment.
``--lanes`` has the speed of a GPU by number of lanes per world, and the default's.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import newton_qd
from newton_qd.envs.base import PhysicsEnv
from newton_qd.physics.launch import LANES, lane_count
from newton_qd.physics.tree import build_tree

CLOCKS = {"wall": time.perf_counter, "processor": time.process_time}


def seconds(run: Callable[[], Any], repetitions: int) -> float:
    """Median duration of ``run`` [s], after one run that is not counted."""
    jax.block_until_ready(run())
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def measure(
    name: str, batch: int, steps: int, horizon: int, repetitions: int
) -> tuple[float, float]:
    """Environment steps per second, forward and with gradient.

    Args:
        name: Environment.
        batch: Number of worlds.
        steps: Control steps of a forward run.
        horizon: Control steps that a gradient walks back.
        repetitions: Runs that the median is taken of.

    Raises:
        RuntimeError: A state or a gradient is not finite.
    """
    env = newton_qd.create(name)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), batch))
    shape = (steps, batch, env.action_size)
    actions = jax.random.uniform(jax.random.key(1), shape, jnp.float32, -1, 1)

    def totals(actions: jax.Array) -> tuple[Any, jax.Array]:
        def step(carry: Any, action: jax.Array) -> tuple[Any, jax.Array]:
            carry = jax.vmap(env.step)(carry, action)
            # of the observation, too: a reward may be constant, its gradient nothing
            return carry, carry.reward + carry.obs.sum(axis=-1)

        return jax.lax.scan(step, state, actions)

    forward = jax.jit(totals)
    gradient = jax.jit(jax.grad(lambda actions: totals(actions)[1].sum()))
    last = forward(actions)[0]
    slope = gradient(actions[:horizon])
    if not (np.isfinite(last.obs).all() and np.isfinite(slope).all()):
        raise RuntimeError(f"{name}, batch {batch}: a value is not finite")
    forward_time = seconds(lambda: forward(actions), repetitions)
    gradient_time = seconds(lambda: gradient(actions[:horizon]), repetitions)
    return batch * steps / forward_time, batch * horizon / gradient_time


def stopwatch(
    name: str, batch: int, steps: int, clock: Callable[[], float]
) -> Callable[[], float]:
    """A rollout under random actions, compiled, as a function that times it [s].

    Raises:
        RuntimeError: A state is not finite.
    """
    env = newton_qd.create(name)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), batch))
    shape = (steps, batch, env.action_size)
    actions = jax.random.uniform(jax.random.key(1), shape, jnp.float32, -1, 1)

    @jax.jit
    def run() -> Any:
        def step(carry: Any, action: jax.Array) -> tuple[Any, jax.Array]:
            carry = jax.vmap(env.step)(carry, action)
            return carry, carry.reward

        return jax.lax.scan(step, state, actions)

    if not np.isfinite(run()[0].obs).all():
        raise RuntimeError(f"{name}, batch {batch}: a value is not finite")

    def timed() -> float:
        start = clock()
        jax.block_until_ready(run())
        return clock() - start

    return timed


def compare(
    names: list[str], batch: int, steps: int, repetitions: int, clock: str
) -> None:
    """Prints the speed of environments per degree of freedom and contact."""
    ant, ant_size = stopwatch("ant", batch, steps, CLOCKS[clock]), size("ant")
    print(
        f"batch {batch} on {jax.devices()[0]}, {clock} time; thousand environment "
        "steps per second"
    )
    print(
        "| environment | degrees of freedom | contacts | forward | "
        "per (dof + contact), ant = 1 |\n|---|---|---|---|---|"
    )
    for name in names:
        run = stopwatch(name, batch, steps, CLOCKS[clock])
        times = [(ant(), run()) for _ in range(repetitions)]
        rate = batch * steps / statistics.median(own for _, own in times) / 1e3
        faster = statistics.median(other / own for other, own in times)
        dofs, contacts = size(name)
        relative = f"{faster * (dofs + contacts) / sum(ant_size):.2f}" if dofs else "-"
        print(
            f"| `{name}` | {dofs} | {contacts} | {rate:.1f} | {relative} |", flush=True
        )


def size(name: str) -> tuple[int, int]:
    """Degrees of freedom and contacts; zeros without a simulation."""
    base = newton_qd.create(name).unwrapped
    if not isinstance(base, PhysicsEnv):
        return 0, 0
    return base.system.nv, len(base.system.contact_body)


def ratios(names: list[str], batch: int, options: argparse.Namespace) -> None:
    """Prints what a gradient costs in every environment, relative to the step."""
    print(f"batch {batch} on {jax.devices()[0]}, thousand environment steps per second")
    print("| environment | forward | forward + backward | ratio |\n|---|---|---|---|")
    for name in names:
        forward, gradient = measure(
            name, batch, options.steps, options.horizon, options.repetitions
        )
        print(
            f"| `{name}` | {forward / 1e3:.1f} | {gradient / 1e3:.1f} | "
            f"{forward / gradient:.1f} |",
            flush=True,
        )


def lanes(name: str, options: argparse.Namespace) -> None:
    """Prints the speed by number of lanes, and by default with the numbers taken."""
    print(f"{name} on {jax.devices()[0]}, thousand environment steps per second")
    print("| batch | lanes | forward | forward + backward |\n|---|---|---|---|")
    kernels = ("step_forward", "step_backward")
    base: Any = newton_qd.create(name).unwrapped
    branches = len(build_tree(base.system).limb_level) > 2
    for batch in options.batches:
        for count in (None, *LANES):
            os.environ.pop("NEWTON_QD_LANES", None)
            chosen = [str(lane_count(kernel, batch, branches)) for kernel in kernels]
            text = f"default: {' and '.join(chosen)}"
            if count is not None:
                os.environ["NEWTON_QD_LANES"] = text = str(count)
            forward, gradient = measure(
                name, batch, options.steps, options.horizon, options.repetitions
            )
            print(
                f"| {batch} | {text} | {forward / 1e3:.1f} | {gradient / 1e3:.1f} |",
                flush=True,
            )


def main() -> None:
    """Print a table of speeds."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--env", default="ant_uni")
    parser.add_argument("--batches", type=int, nargs="+", default=[128, 1024])
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--horizon", type=int, default=32)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--suite", action="store_true")
    parser.add_argument("--clock", choices=CLOCKS, default="wall")
    parser.add_argument("--names", nargs="+", default=newton_qd.registered_envs())
    parser.add_argument("--ratios", action="store_true")
    parser.add_argument("--lanes", action="store_true")
    options = parser.parse_args()
    if options.lanes:
        lanes(options.env, options)
        return
    if options.ratios:
        for batch in options.batches:
            ratios(options.names, batch, options)
        return
    if options.suite:
        for batch in options.batches:
            compare(
                options.names,
                batch,
                options.steps,
                options.repetitions,
                options.clock,
            )
        return
    print(f"{options.env} on {jax.devices()[0]}, thousand environment steps per second")
    print("| batch | forward | forward + backward |\n|---|---|---|")
    for batch in options.batches:
        forward, gradient = measure(
            options.env, batch, options.steps, options.horizon, options.repetitions
        )
        print(f"| {batch} | {forward / 1e3:.1f} | {gradient / 1e3:.1f} |", flush=True)


if __name__ == "__main__":
    main()
