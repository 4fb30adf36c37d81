"""Breaks the package in ten places, one at a time: tests must notice each.

    python tests/mutate.py [--only NAME]

Each mutation changes one expression in a copy of the package and runs the tests of one
file on that copy. A mutation that no test notices, or whose text is gone, is an error.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TIMEOUT_S = 1200.0


@dataclasses.dataclass(frozen=True)
class Mutation:
    """One wrong expression.

    Attributes:
        file: File below ``newton_qd``.
        before: Text that occurs there once.
        after: Wrong text.
        tests: File that must fail, below ``tests``.
    """

    file: str
    before: str
    after: str
    tests: str


MUTATIONS = {
    # friction of a contact pushes the way it slips
    "friction": Mutation(
        "physics/kernels/contact.py",
        "push * normal - wt * vt",
        "push * normal + wt * vt",
        "test_contact.py",
    ),
    # coordinates move with the velocity at the start of the substep
    "euler": Mutation(
        "physics/kernels/integration.py",
        "load(sc.q, offsets.q + a) + h * load(sc.v, offsets.v_next + k)",
        "load(sc.q, offsets.q + a) + h * load(sc.v, offsets.v + k)",
        "test_free_flight.py",
    ),
    # an adjoint has the wrong sign
    "adjoint": Mutation(
        "physics/kernels/cpp/operators.py",
        "adj_A += x; adj_B -= x * A * y;",
        "adj_A += x; adj_B += x * A * y;",
        "test_algebra.py",
    ),
    # the cost of control is a reward
    "reward": Mutation(
        "envs/ant.py",
        "reward = velocity[0] + bonus - control - contact",
        "reward = velocity[0] + bonus + control - contact",
        "test_ant.py",
    ),
    # an episode is one step too long
    "episode": Mutation(
        "wrappers/episode.py",
        "over = steps >= self.episode_length",
        "over = steps > self.episode_length",
        "test_wrappers.py",
    ),
    # steps after the end count
    "descriptor": Mutation(
        "extractors.py",
        "return folded_sum(values * valid, 1)",
        "return folded_sum(values, 1)",
        "test_extractors.py",
    ),
    # a world at fault goes on
    "fault": Mutation(
        "envs/base.py",
        "done=jnp.where(faulty, jnp.ones_like(done), done)",
        "done=done",
        "test_bad_input.py",
    ),
    # of the individuals of a cell only the first counts
    "ties": Mutation(
        "qd/emitters/cells.py",
        "fitnesses[order][1:] == fitnesses[order][:-1]",
        "fitnesses[order][1:] >= fitnesses[order][:-1]",
        "test_generation.py",
    ),
    # windows of the gradient are one step longer
    "window": Mutation(
        "gradients/flow.py",
        "factors[:: self.window] = 0.0",
        "factors[:: self.window + 1] = 0.0",
        "test_episode_gradients.py",
    ),
    # an offset is not the one that was measured
    "offset": Mutation(
        "tasks.py",
        '"ant_uni": _uni(Ant, "ant", (4.35, 3.24))',
        '"ant_uni": _uni(Ant, "ant", (4.53, 3.24))',
        "test_survey.py",
    ),
}


def build(mutation: Mutation, folder: Path) -> None:
    """Copies the package to a folder and breaks it there.

    Raises:
        ValueError: The text is not in the file once.
    """
    for name in ("newton_qd", "urdf", "tests", "docs", "examples", "benchmarks"):
        skip = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, folder / name, ignore=skip)
    for name in ("pyproject.toml", "README.md", ".ci"):
        source = ROOT / name
        copy = shutil.copytree if source.is_dir() else shutil.copy
        copy(source, folder / name)
    path = folder / "newton_qd" / mutation.file
    text = path.read_text(encoding="utf-8")
    if text.count(mutation.before) != 1:
        raise ValueError(
            f"{mutation.file}: got {mutation.before!r} {text.count(mutation.before)} "
            "times; allowed: once"
        )
    path.write_text(text.replace(mutation.before, mutation.after), encoding="utf-8")


def is_noticed(mutation: Mutation) -> bool:
    """Whether a test of the mutation's file fails."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        build(mutation, folder)
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
        command += ["-m", "not slow", str(folder / "tests" / mutation.tests)]
        done = subprocess.run(
            command,
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(folder)},
            capture_output=True,
            text=True,
            check=False,
            timeout=TIMEOUT_S,
        )
    if done.returncode not in (0, 1):
        raise RuntimeError(f"pytest ended with {done.returncode}: {done.stdout}")
    return done.returncode == 1


def main() -> int:
    """Runs all mutations; returns how many no test noticed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=MUTATIONS, help="one of them")
    only = parser.parse_args().only
    lost = 0
    for name, mutation in MUTATIONS.items():
        if only in (None, name):
            noticed = is_noticed(mutation)
            lost += not noticed
            result = "noticed by" if noticed else "NOT NOTICED by"
            print(f"{name}: {result} {mutation.tests}", flush=True)
    return lost


if __name__ == "__main__":
    sys.exit(main())
