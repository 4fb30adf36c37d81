"""Compare the speed of a control step in this checkout with that in another.

    python benchmarks/contact_speed.py BASE_CHECKOUT [--robots ant halfcheetah]

Each checkout has a worker process, which runs the physics on one thread of the CPU in
float32. The workers take turns, and each repetition reverses the order of the one
before. The table has medians over the repetitions, of processor time: it counts little
what else the machine does. On a busy machine, the ratio of the shortest times is the
steadiest. A control step is part of a jitted scan from reset states
under noise; with gradient it is forward and backward of all of them.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve()
STEPS = {"forward": 50, "gradient": 8}  # control steps of a call
ONE_THREAD = {
    "NEWTON_QD_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "JAX_PLATFORMS": "cpu",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}


def prepared(name: str, kind: str, worlds: int) -> Callable[[], float]:
    """Compiles the steps of a robot; the result times one call of them [s].

    Raises:
        RuntimeError: A result is not finite.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    import newton_qd
    from newton_qd import physics

    env: Any = newton_qd.create(name, episode_length=None, auto_reset=False).unwrapped
    keys = jax.random.split(jax.random.key(0), worlds)
    first = jax.jit(jax.vmap(env.reset))(keys).pipeline_state
    shape = (STEPS[kind], worlds, env.system.nu)
    controls = jax.random.uniform(jax.random.key(1), shape, jnp.float32, -1, 1)

    def end(controls: jax.Array) -> Any:
        def step(state: Any, control: jax.Array) -> Any:
            after, _ = jax.vmap(
                lambda state, control: physics.step(env.system, state, control)
            )(state, control)
            return after, None

        return jax.lax.scan(step, first, controls)[0]

    run: Any = jax.jit(end)
    if kind == "gradient":
        run = jax.jit(jax.grad(lambda u: end(u).q.sum() + end(u).v.sum()))
    finite = jax.tree.map(lambda x: bool(np.isfinite(x).all()), run(controls))
    if not all(jax.tree.leaves(finite)):
        raise RuntimeError(f"{name}, {kind}: a value is not finite")

    def timed() -> float:
        start = time.process_time()
        jax.block_until_ready(run(controls))
        return (time.process_time() - start) / STEPS[kind]

    return timed


def work() -> None:
    """Answers requests, one JSON object a line: ``prepare``, or times of calls."""
    # messages of Warp must not be mixed with the answers
    answers, sys.stdout = sys.stdout, sys.stderr
    timed: Callable[[], float] = float
    for line in sys.stdin:
        request = json.loads(line)
        if "robot" in request:
            timed = prepared(request["robot"], request["kind"], request["worlds"])
            timed()
        print(json.dumps([timed() for _ in range(request["calls"])]), file=answers)
        answers.flush()


class Worker:
    """A process that runs the package of one checkout."""

    def __init__(self, checkout: Path) -> None:
        environ = {**os.environ, **ONE_THREAD, "PYTHONPATH": str(checkout)}
        self._process = subprocess.Popen(
            [sys.executable, str(HERE), "--work", str(checkout)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=environ,
        )

    def ask(self, **request: Any) -> list[float]:
        """Sends a request, and waits for the times [s].

        Raises:
            RuntimeError: The worker has ended.
        """
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None and stdout is not None
        stdin.write(json.dumps(request) + "\n")
        stdin.flush()
        answer = stdout.readline()
        if not answer:
            raise RuntimeError(f"a worker ended with code {self._process.wait()}")
        return json.loads(answer)


def compare(
    workers: list[Worker], robot: str, kind: str, options: argparse.Namespace
) -> dict[str, Any]:
    """Times one robot in both checkouts."""
    for worker in workers:
        worker.ask(robot=robot, kind=kind, worlds=options.worlds, calls=1)
    times: list[list[float]] = [[], []]
    for repetition in range(options.repetitions):
        for n in (0, 1) if repetition % 2 else (1, 0):
            times[n] += workers[n].ask(calls=options.calls)
    here, base = (statistics.median(found) for found in times)
    ratios = sorted(own / other for own, other in zip(*times, strict=True))
    return {
        "robot": robot,
        "kind": kind,
        "base [ms]": 1e3 * base,
        "here [ms]": 1e3 * here,
        "time, here over base": here / base,
        "25 % of ratios": ratios[len(ratios) // 4],
        "75 % of ratios": ratios[3 * len(ratios) // 4],
        "of the shortest": min(times[0]) / min(times[1]),
    }


def main() -> None:
    """Prints a table, and writes it as csv if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("base", type=Path, help="checkout to compare with")
    parser.add_argument("--robots", nargs="+")
    parser.add_argument("--kinds", nargs="+", default=list(STEPS))
    parser.add_argument("--worlds", type=int, default=128)
    parser.add_argument("--repetitions", type=int, default=10)
    parser.add_argument("--calls", type=int, default=3)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        work()
        return
    if options.robots is None:
        from newton_qd.robots import ROBOTS

        options.robots = list(ROBOTS)
    workers = [Worker(HERE.parent.parent), Worker(options.base.resolve())]
    rows = []
    for robot in options.robots:
        for kind in options.kinds:
            row = compare(workers, robot, kind, options)
            if not rows:
                print(f"| {' | '.join(row)} |\n|{'---|' * len(row)}")
            texts = [x if isinstance(x, str) else f"{x:.3g}" for x in row.values()]
            print(f"| {' | '.join(texts)} |", flush=True)
            rows.append(row)
    if options.out is not None:
        with options.out.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
