"""Speed and memory of the doors to other libraries, compared with ``env.step``.

    python benchmarks/adapters.py speed [--env ant_uni] [--worlds 1024]
    python benchmarks/adapters.py memory [--count 10000]

``speed`` steps one batch of worlds through each door and through ``env.step``, with the
same random actions. All take turns in one process, so that what else the machine does
slows down all of them. A row is the time of ``env.step`` divided by that of the door:
the median over the turns, and the range between the quartiles. PyTorch has a row with
the gradient of the reward with respect to the actions, compared with ``jax.grad``. The
exit code is 1 if a door is slower than promised.

``memory`` makes many steps through each door and reads the memory of the process at
twenty moments. After the first fifth, it may not grow by more than 2 %. Doors whose
library is not installed are left out.
"""

from __future__ import annotations

import argparse
import importlib.util
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from soak import MOMENTS, flat, resident

import newton_qd

Advance = Callable[[np.ndarray], None]
PROMISED = {"brax": 0.9, "torch": 0.9, "torch gradient": 0.7, "gymnasium": 0.8}
BURST = 5  # steps of a turn


def installed(package: str) -> bool:
    """Whether a package can be imported."""
    found = importlib.util.find_spec(package) is not None
    if not found:
        print(f"{package} is not installed", file=sys.stderr)
    return found


def plain(name: str, worlds: int) -> Advance:
    """Steps without a door."""
    env = newton_qd.create(name, auto_reset=False, batch_size=worlds)
    step, state = jax.jit(env.step), jax.jit(env.reset)(jax.random.key(0))

    def advance(actions: np.ndarray) -> None:
        nonlocal state
        state = jax.block_until_ready(step(state, actions))

    return advance


def plain_gradient(name: str, worlds: int) -> Advance:
    """Steps, with the gradient of the reward."""
    env = newton_qd.create(name, auto_reset=False, batch_size=worlds)
    state = jax.jit(env.reset)(jax.random.key(0))

    @jax.jit
    def both(state: Any, actions: jax.Array) -> Any:
        def rewards(actions: jax.Array) -> Any:
            after = env.step(state, actions)
            return after.reward.sum(), after

        return jax.value_and_grad(rewards, has_aux=True)(actions)

    def advance(actions: np.ndarray) -> None:
        nonlocal state
        (_, state), _ = jax.block_until_ready(both(state, actions))

    return advance


def gymnasium(name: str, worlds: int) -> Advance:
    """Steps of the vector environment of Gymnasium."""
    from newton_qd.adapters import make_gymnasium_vector

    env = make_gymnasium_vector(name, worlds)
    env.reset(seed=0)

    def advance(actions: np.ndarray) -> None:
        env.step(actions)

    return advance


def brax(name: str, worlds: int) -> Advance:
    """Steps of brax's environment, in brax's wrappers for batch and episode."""
    from brax import envs

    from newton_qd.adapters import BraxEnv

    env = envs.training.EpisodeWrapper(
        envs.training.VmapWrapper(BraxEnv(name)), 1000, 1
    )
    keys = jax.random.split(jax.random.PRNGKey(0), worlds)
    step, state = jax.jit(env.step), jax.jit(env.reset)(keys)

    def advance(actions: np.ndarray) -> None:
        nonlocal state
        state = jax.block_until_ready(step(state, actions))

    return advance


def torch(name: str, worlds: int) -> Advance:
    """Steps of PyTorch's door, without a graph."""
    import torch  # pyright: ignore[reportMissingImports]

    from newton_qd.adapters.torch import make_torch_step

    env = newton_qd.create(name, auto_reset=False, batch_size=worlds)
    reset, step = make_torch_step(env)
    state = reset(0)

    def advance(actions: np.ndarray) -> None:
        nonlocal state
        state = step(state, torch.from_numpy(actions))
        _ = state.obs, state.reward, state.done  # waits for the step

    return advance


def torch_gradient(name: str, worlds: int) -> Advance:
    """Steps of PyTorch's door, with the gradient of the reward."""
    import torch  # pyright: ignore[reportMissingImports]

    from newton_qd.adapters.torch import detached, make_torch_step

    env = newton_qd.create(name, auto_reset=False, batch_size=worlds)
    reset, step = make_torch_step(env)
    state = reset(0)

    def advance(actions: np.ndarray) -> None:
        nonlocal state
        given = torch.from_numpy(actions).requires_grad_()
        after = step(state, given)
        after.reward.sum().backward()
        state = detached(after)

    return advance


def doors(name: str, worlds: int) -> dict[str, tuple[Advance, str]]:
    """Every door whose library is installed, and what it is compared with."""
    found = {
        "env.step": (plain(name, worlds), "env.step"),
        "gradient": (plain_gradient(name, worlds), "gradient"),
    }
    if installed("brax"):
        found["brax"] = brax(name, worlds), "env.step"
    if installed("gymnasium"):
        found["gymnasium"] = gymnasium(name, worlds), "env.step"
    if installed("torch"):
        found["torch"] = torch(name, worlds), "env.step"
        found["torch gradient"] = torch_gradient(name, worlds), "gradient"
    return found


def plans(name: str, worlds: int) -> np.ndarray:
    """Random actions (8, worlds, nu)."""
    size = newton_qd.create(name).action_size
    rows = np.random.default_rng(0).uniform(-1, 1, (8, worlds, size))
    return rows.astype(np.float32)


def speed(name: str, worlds: int, turns: int) -> bool:
    """Prints the speed of each door, and returns whether all are as promised."""
    found, rows = doors(name, worlds), plans(name, worlds)
    seconds: dict[str, list[float]] = {door: [] for door in found}
    for turn in range(turns + 1):
        order = list(found) if turn % 2 else list(reversed(found))
        for door in order:
            begin = time.perf_counter()
            for number in range(BURST):
                found[door][0](rows[(turn + number) % len(rows)])
            seconds[door].append((time.perf_counter() - begin) / BURST)
    good = True
    print(f"{name}, {worlds} worlds, {turns} turns of {BURST} steps")
    for door, (_, other) in found.items():
        # the first turn compiles
        times, others = np.array(seconds[door][1:]), np.array(seconds[other][1:])
        ratio = statistics.median(others / times)
        low, high = np.quantile(others / times, [0.25, 0.75])
        line = f"{door:15s} {1e3 * statistics.median(times):7.2f} ms for a step"
        if door != other:
            line += f", speed {ratio:.2f} ({low:.2f} to {high:.2f}) of {other}"
            good = good and ratio >= PROMISED[door]
        print(line)
    return good


def memory(name: str, worlds: int, count: int) -> bool:
    """Steps through each door, and returns whether memory stays flat."""
    good, rows = True, plans(name, worlds)
    for door, (advance, _) in doors(name, worlds).items():
        seen = []
        for number in range(count):
            advance(rows[number % len(rows)])
            if (number + 1) % (count // MOMENTS) == 0:
                seen.append(resident())
        print(door, end=": ")
        good = flat(seen) and good
    return good


def main() -> int:
    """Measures, and returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("speed", "memory"))
    parser.add_argument("--env", default="ant_uni")
    parser.add_argument("--worlds", type=int, help="default: 1024 or 4")
    parser.add_argument("--turns", type=int, default=40)
    parser.add_argument("--count", type=int, default=10_000)
    options = parser.parse_args()
    if options.what == "speed":
        good = speed(options.env, options.worlds or 1024, options.turns)
    else:
        good = memory(options.env, options.worlds or 4, options.count)
    print("holds" if good else "does NOT hold")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
