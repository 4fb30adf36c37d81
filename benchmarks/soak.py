"""Long runs: does memory stay flat, and do kills and full disks lose nothing?

    python benchmarks/soak.py steps [--count 200000]
    python benchmarks/soak.py generations [--count 5000]
    python benchmarks/soak.py kills [--count 50]
    python benchmarks/soak.py full-disk [--count 10]

``steps`` calls a jitted step and, every hundredth time, a jitted gradient.
``generations`` runs ``evolve`` with small settings. Both print the memory of the
process [MB] at twenty moments. The first fifth of a run fills caches; from then on
memory may not grow by more than 2 %. ``kills`` stops ``newton-qd evolve`` with ``kill
-9`` at random moments, continues it each time, and compares the archive with that of a
run that nobody stopped, bit by bit. ``full-disk`` does the same with a small disk that
becomes full or read-only at as many random moments each; the run must end with an error
of one line, and may lose nothing but the generation that it could not write. It needs
Linux, where it mounts a disk of its own (``unshare --map-root-user --mount``). The exit
code is 1 if something of this does not hold.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

MOMENTS = 20
GROWTH = 1.02
PAGE = os.sysconf("SC_PAGE_SIZE")
EVOLVE = ("-m", "newton_qd", "evolve", "hopper_uni", "--batch-size", "16")
EVOLVE += ("--episode-length", "20", "--checkpoint-seconds", "0")
INSIDE = "NEWTON_QD_SOAK_INSIDE"
Trouble: TypeAlias = Callable[
    [Path, "subprocess.Popen[str] | None"], contextlib.AbstractContextManager[None]
]


def resident() -> float:
    """Memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * PAGE / 1e6


def flat(memory: list[float]) -> bool:
    """Whether memory grew by less than 2 % after the first fifth; prints it."""
    print("memory [MB]:", *(f"{value:.0f}" for value in memory))
    start = max(memory[: max(len(memory) // 5, 1)])
    print(f"end over start: {memory[-1] / start:.3f}")
    return memory[-1] <= GROWTH * start


def steps(count: int) -> bool:
    """Steps one world, and differentiates a step now and then."""
    import jax
    import jax.numpy as jnp

    import newton_qd

    env = newton_qd.create("ant_uni", episode_length=250)
    step, state = jax.jit(env.step), jax.jit(env.reset)(jax.random.key(0))
    slope = jax.jit(jax.grad(lambda action, state: env.step(state, action).reward))
    actions = jax.random.uniform(jax.random.key(1), (97, env.action_size), minval=-1.0)
    actions, memory = list(actions), []
    for n in range(count):
        state = step(state, actions[n % 97])
        if n % 100 == 0:
            assert jnp.isfinite(slope(actions[n % 97], state)).all()
        if (n + 1) % (count // MOMENTS) == 0:
            jax.block_until_ready(state)
            memory.append(resident())
    newton_qd.check(state)
    return flat(memory)


def generations(count: int) -> bool:
    """Runs ``evolve`` with small settings."""
    from newton_qd.qd import EvolveConfig, evolve

    config = EvolveConfig(
        env_name="hopper_uni", batch_size=16, episode_length=20, iterations=count
    )
    memory: list[tuple[int, float]] = []
    done = threading.Event()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"

        def watch() -> None:
            while not done.wait(0.2):
                table = out / "metrics.csv"
                rows = table.read_bytes().count(b"\n") if table.exists() else 0
                memory.append((rows, resident()))

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        evolve(config, out=out, progress=False)
        done.set()
        watcher.join()
    # what comes before the first generation and after the last is not repeated
    moments = [count * moment // MOMENTS for moment in range(1, MOMENTS)]
    return flat(
        [next(value for rows, value in memory if rows >= moment) for moment in moments]
    )


def kills(count: int) -> bool:
    """Stops a run with ``kill -9`` and continues it, until it is done."""
    moments = random.Random(0)
    with tempfile.TemporaryDirectory() as folder:
        expected, out = Path(folder) / "expected", Path(folder) / "run"
        arguments = [
            sys.executable,
            *EVOLVE,
            "--iterations",
            str(60 * count),
            "--quiet",
        ]
        begin = time.monotonic()
        process = subprocess.Popen([*arguments, "--out", str(expected)])
        wait_for_more(expected, process)
        begun = time.monotonic() - begin
        process.wait()
        again = [*arguments, "--out", str(out), "--resume"]
        for attempt in range(count):
            process = subprocess.Popen(
                again, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            if attempt % 2:  # between or in generations, else while it begins
                wait_for_more(out, process)
                time.sleep(moments.uniform(0.0, 0.5))
            else:
                time.sleep(moments.uniform(0.0, begun))
            process.kill()
            process.wait()
            there = generations_in(out)
            print(f"kill {attempt + 1} of {count} after generation {there}", flush=True)
        run_to_end(again)
        return same_archives(expected, out)


def wait_for_more(out: Path, process: subprocess.Popen[Any]) -> None:
    """Waits until a run has written a generation more than there was."""
    before = generations_in(out)
    while generations_in(out) <= before and process.poll() is None:
        time.sleep(0.01)


def full_disk(count: int) -> bool:
    """Fills the disk of a run, or makes it read-only, and continues the run."""
    if INSIDE not in os.environ:  # begins again where it may mount a disk
        again = [sys.executable, __file__, "full-disk", "--count", str(count)]
        alone = ["unshare", "--map-root-user", "--mount", *again]
        return not subprocess.run(alone, env={**os.environ, INSIDE: "1"}).returncode
    moments = random.Random(0)
    arguments = [sys.executable, *EVOLVE, "--iterations", str(400 * count), "--quiet"]
    with tempfile.TemporaryDirectory() as folder:
        expected, disk = Path(folder) / "expected", Path(folder) / "disk"
        run_to_end([*arguments, "--out", str(expected)])
        disk.mkdir()
        subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=8M", "soak", disk], check=True
        )
        out = disk / "run"
        again = [*arguments, "--out", str(out), "--resume"]
        good = True
        for attempt in range(2 * count):
            trouble = full if attempt % 2 == 0 else read_only
            # the first of each kind comes before the run begins
            wait = None if attempt < 2 else moments.uniform(0.0, 0.5)
            good &= survives(again, out, trouble, wait)
            print(f"{trouble.__name__} {attempt // 2 + 1} of {count}", flush=True)
        run_to_end(again)
        good &= same_archives(expected, out)
        subprocess.run(["umount", disk], check=True)
    return good


@contextlib.contextmanager
def full(disk: Path, process: subprocess.Popen[str] | None) -> Iterator[None]:
    """Fills a disk until a process ends, and keeps it full in between."""
    with (disk / "ballast").open("ab", buffering=0) as ballast:
        while True:
            for size in (65_536, 1):
                with contextlib.suppress(OSError):
                    while ballast.write(b"x" * size):
                        pass
            if process is None or process.poll() is not None:
                break
            time.sleep(0.01)
    yield
    (disk / "ballast").unlink()


@contextlib.contextmanager
def read_only(disk: Path, process: subprocess.Popen[str] | None) -> Iterator[None]:
    """Makes a disk read-only until a process ends."""
    mount = ["mount", "-o", "remount,ro", str(disk)]
    while subprocess.run(mount, capture_output=True).returncode:  # a file is open
        time.sleep(0.001)
    if process is not None:
        process.wait()
    yield
    subprocess.run(["mount", "-o", "remount,rw", str(disk)], check=True)


def survives(
    arguments: list[str], out: Path, trouble: Trouble, wait: float | None
) -> bool:
    """Whether a run keeps all but its last generation when its disk makes trouble.

    Args:
        arguments: The command that continues the run.
        out: Its results folder.
        trouble: Makes trouble on the disk.
        wait: Time from the first new checkpoint to the trouble [s]; ``None``: the
            trouble comes before the run.
    """
    from newton_qd.qd import load_run

    def start() -> subprocess.Popen[str]:
        return subprocess.Popen(
            arguments, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )

    written = -1
    if wait is None:
        with trouble(out.parent, None):
            process = start()
            error = process.communicate()[1]
    else:
        process = start()
        wait_for_more(out, process)
        time.sleep(wait)
        written = generations_in(out)
        with trouble(out.parent, process):
            error = process.communicate()[1]
    kept = load_run(out).iteration if written >= 0 else -1
    print(f"generation {written} was written, {kept} is there: {error.strip()}")
    complained = process.returncode == 1 and error.count("\n") == 1
    return complained and kept >= written


def generations_in(out: Path) -> int:
    """Number of the last generation in ``metrics.csv``; -1: none."""
    table = out / "metrics.csv"
    return table.read_bytes().count(b"\n") - 2 if table.exists() else -1


def run_to_end(arguments: list[str]) -> None:
    """Runs a command that must succeed."""
    subprocess.run(arguments, check=True, capture_output=True)


def same_archives(expected: Path, found: Path) -> bool:
    """Whether the archives of two folders are equal, bit by bit."""
    import numpy as np

    from newton_qd.qd import load_archive

    pairs = [load_archive(folder) for folder in (expected, found)]
    same = all(
        np.array_equal(a, b, equal_nan=True)
        for a, b in zip(
            (pairs[0].fitnesses, pairs[0].descriptors, pairs[0].genotypes),
            (pairs[1].fitnesses, pairs[1].descriptors, pairs[1].genotypes),
            strict=True,
        )
    )
    print("the same archive" if same else "ANOTHER archive")
    return same


RUNS = {"steps": (steps, 200_000), "generations": (generations, 5_000)}
RUNS |= {"kills": (kills, 50), "full-disk": (full_disk, 10)}


def main() -> int:
    """Runs one of the four, and returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", choices=list(RUNS))
    parser.add_argument("--count", type=int, help="default: 200000, 5000, 50 or 10")
    options = parser.parse_args()
    run, count = RUNS[options.run]
    good = run(options.count or count)
    print("holds" if good else "does NOT hold")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
