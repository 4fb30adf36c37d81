"""Compare the speed of robots with that of brax on one GPU, in one process.

    python benchmarks/compare_gpu.py [--robots ant ...] [--batches 4096 ...]
        [--libraries newton_qd "brax v1" ...] [--gradients 1024 ...]
        [--horizons 4 16 64] [--out FILE.csv]

The libraries take turns, and the table has medians, in million environment steps per
second. A step is the whole one: physics, observation, reward, episode and automatic
reset, in a scan under uniform random actions; newton_qd computes the descriptors of the
`_uni` tasks too. A gradient is that of the sum of rewards by the actions, forward and
backward; ``--horizons`` is over how many steps, with ``--horizon-worlds`` worlds. A row
counts if its rewards, and its gradient, are finite and not all equal.
``benchmarks/gpu_figures.py`` draws the csv files.

The peers need brax 0.12.3 (`pip install brax==0.12.3 gym==0.26.2`) in the same
environment. "brax v1" is the legacy spring physics that QDax used.
"""

from __future__ import annotations

import argparse
import csv
import importlib
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

ROBOTS = ("ant", "halfcheetah", "hopper", "walker2d", "humanoid")
OURS = "newton_qd"
# What brax raises where names or arguments are gone, or memory runs out.
PEER_ERRORS = (ImportError, AttributeError, TypeError, ValueError, RuntimeError)
STEPS = {"forward": 32, "gradient": 16}
SEED = 0
EPISODE_LENGTH = 1000


class Library:
    """A library's environment, for a batch of worlds.

    brax's own environments take one key and split it.
    """

    def __init__(self, env: Any, vectorized: bool) -> None:
        reset = jax.jit(env.reset if vectorized else jax.vmap(env.reset))
        self.reset = (lambda keys: reset(keys[0])) if vectorized else reset
        self.step = env.step if vectorized else jax.vmap(env.step)
        self.action_size = env.action_size


def newton_qd(robot: str, worlds: int) -> Library:
    """Returns this project's environment."""
    import newton_qd as project

    env = project.create(f"{robot}_uni", episode_length=EPISODE_LENGTH)
    return Library(env, vectorized=False)


def restore_names() -> None:
    """Put names back that brax 0.12.3 looks up and newer JAX made private."""
    from jax import core as public_core
    from jax._src import core
    from jax._src.interpreters import batching
    from jax.interpreters import batching as public

    name = "unsafe_am_i_under_a_jit_DO_NOT_USE"
    if not hasattr(public_core, name):
        setattr(public_core, name, lambda: not core.trace_state_clean())
    if not hasattr(public, "BatchTracer"):
        setattr(public, "BatchTracer", batching.BatchTracer)  # noqa: B010


def brax_v1(robot: str, worlds: int) -> Library:
    """Returns brax v1's environment with its legacy spring physics."""
    restore_names()
    envs = importlib.import_module("brax.v1.envs")

    env = envs.create(
        robot, episode_length=EPISODE_LENGTH, batch_size=worlds, legacy_spring=True
    )
    return Library(env, vectorized=True)


def brax_v2(backend: str) -> Callable[[str, int], Library]:
    """Returns a maker of brax v2's environments with a backend."""

    def make(robot: str, worlds: int) -> Library:
        restore_names()
        envs = importlib.import_module("brax.envs")

        env = envs.create(
            robot, backend=backend, episode_length=EPISODE_LENGTH, batch_size=worlds
        )
        return Library(env, vectorized=True)

    return make


LIBRARIES: dict[str, Callable[[str, int], Library]] = {
    OURS: newton_qd,
    "brax v1": brax_v1,
    "brax v2 spring": brax_v2("spring"),
    "MJX": brax_v2("mjx"),
}


def prepare(library: Library, kind: str, worlds: int, steps: int) -> Callable[[], Any]:
    """Returns a function that runs the steps and waits for their result."""
    shape = (steps, worlds, library.action_size)
    keys = jax.random.split(jax.random.PRNGKey(SEED), worlds)
    actions = jax.random.uniform(jax.random.PRNGKey(SEED), shape, minval=-1, maxval=1)
    start = library.reset(keys)

    def total(actions: jax.Array, state: Any) -> tuple[jax.Array, Any]:
        def body(state: Any, action: jax.Array) -> tuple[Any, jax.Array]:
            state = library.step(state, action)
            return state, state.reward

        last, rewards = jax.lax.scan(body, state, actions)
        return rewards.sum(), (last, rewards)

    if kind == "gradient":
        run = jax.jit(jax.grad(lambda actions: total(actions, start)[0]))
    else:
        run = jax.jit(lambda actions: total(actions, start)[1])
    return lambda: jax.block_until_ready(run(actions))


def counts(result: Any) -> bool:
    """Whether a result is finite and not all equal."""
    values = np.asarray(result[1] if isinstance(result, tuple) else result)
    return bool(np.isfinite(values).all() and np.ptp(values) > 0)


def compare(
    robot: str,
    kind: str,
    worlds: int,
    steps: int,
    libraries: list[str],
    repetitions: int,
) -> list[dict[str, Any]]:
    """Returns a row for each library; they take turns."""
    runs, rows = {}, []
    for name in libraries:
        start = time.perf_counter()
        try:
            run = prepare(LIBRARIES[name](robot, worlds), kind, worlds, steps)
            valid = counts(run())
        # a peer may not fit this JAX or this GPU, and the others still count
        except PEER_ERRORS as error:
            if name == OURS:
                raise
            reason = f"{type(error).__name__}: {str(error).splitlines()[0]}"
            rows.append({"library": name, "note": reason[:90]})
            continue
        note = "" if valid else "not valid"
        runs[name] = run
        first = time.perf_counter() - start
        rows.append({"library": name, "note": note, "first call [s]": first})
    times: dict[str, list[float]] = {name: [] for name in runs}
    for repetition in range(repetitions):
        for name in list(runs)[:: -1 if repetition % 2 else 1]:
            start = time.perf_counter()
            runs[name]()
            times[name].append(time.perf_counter() - start)
    speeds = {
        name: worlds * steps / statistics.median(found) / 1e6
        for name, found in times.items()
    }
    for row in rows:
        name = row["library"]
        if name in speeds:
            row["million steps/s"] = speeds[name]
            row["ours to it"] = speeds.get(OURS, float("nan")) / speeds[name]
    job = {"robot": robot, "kind": kind, "worlds": worlds, "steps": steps}
    return [job | row for row in rows]


COLUMNS = ("robot", "kind", "worlds", "steps", "library", "million steps/s")
COLUMNS += ("ours to it", "first call [s]", "note")


def show(row: dict[str, Any]) -> str:
    """Returns a row of the table."""
    cells = (row.get(name, "") for name in COLUMNS)
    texts = (f"{cell:.3g}" if isinstance(cell, float) else str(cell) for cell in cells)
    return "| " + " | ".join(texts) + " |"


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    """Writes the rows that are there, so that a run that ends early keeps them."""
    part = path.with_suffix(".part")
    with part.open("w", newline="", encoding="utf-8") as file:
        writer: csv.DictWriter[str] = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    part.replace(path)


def main() -> None:
    """Run the comparison and print each row when it is there."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=ROBOTS)
    batches = [4096, 16384, 65536]
    parser.add_argument("--batches", nargs="*", type=int, default=batches)
    parser.add_argument("--gradients", nargs="*", type=int, default=[])
    parser.add_argument("--horizons", nargs="*", type=int, default=[])
    parser.add_argument("--horizon-worlds", type=int, default=1024)
    names = list(LIBRARIES)
    parser.add_argument("--libraries", nargs="+", choices=names, default=names[:2])
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--out", type=Path, help="csv file for the rows")
    options = parser.parse_args()
    print(f"{jax.devices()[0].device_kind}, JAX {jax.__version__}")
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}", flush=True)
    jobs = [("forward", n, STEPS["forward"]) for n in options.batches]
    jobs += [("gradient", n, STEPS["gradient"]) for n in options.gradients]
    jobs += [("gradient", options.horizon_worlds, n) for n in options.horizons]
    found = []
    for robot in options.robots:
        for kind, worlds, steps in jobs:
            rows = compare(
                robot, kind, worlds, steps, options.libraries, options.repetitions
            )
            for row in rows:
                print(show(row), flush=True)
            found += rows
            if options.out is not None:
                write(options.out, found)


if __name__ == "__main__":
    main()
