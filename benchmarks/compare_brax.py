"""Compare newton_qd's ant_uni with brax v1's in one run.

Each library runs in a worker process of its own and in its own Python environment;
the workers take turns, so that whatever else the machine does hits both, and
medians are reported. A scenario counts only if every number of its last state is
finite, no world reported a fault and the robots moved. ``README.md`` says how to
make the peer's environment.

    python benchmarks/compare_brax.py --peer-python PEER/bin/python --out result.json

With ``--gaits``, it compares the motion instead: returns of the same sine gaits.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

import gaits

WORKER = Path(__file__).with_name("worker.py")
OURS, PEER = "newton_qd", "brax_v1"
# Average number of running processes above which a measurement is not to be trusted.
BUSY_LOAD = 0.5


@dataclasses.dataclass(frozen=True)
class Scenario:
    """One row of the comparison.

    Attributes:
        kind: ``"forward"``: ``env.step`` in a jitted scan; ``"gradient"``: forward
            and backward of the reward sum with respect to all actions; ``"plan"``
            and ``"plan_gradient"``: the same with our ``env.rollout``, without
            auto-reset.
        worlds: Batch size [-].
        steps: Environment steps of each world in one call [-].
        calls: Calls in one repetition [-].
        required: Ratio to the peer that the project promises, or None.
    """

    kind: str
    worlds: int
    steps: int
    calls: int = 1
    required: float | None = None

    @property
    def name(self) -> str:
        """Name in tables and files."""
        return f"{self.kind}_{self.worlds}"

    @property
    def total_steps(self) -> int:
        """Environment steps of one repetition [-]."""
        return self.worlds * self.steps * self.calls


# Sized so that a repetition takes about a second on two cores.
SCENARIOS = (
    Scenario("forward", 1, 2000),
    Scenario("forward", 16, 1000),
    Scenario("forward", 64, 500, required=2.0),
    Scenario("forward", 128, 250),
    Scenario("forward", 1024, 50, required=1.5),
    Scenario("gradient", 16, 32, calls=4),
    Scenario("gradient", 128, 32, required=3.0),
    Scenario("plan", 1, 250, calls=8),
    Scenario("plan", 16, 250, calls=4),
    Scenario("plan_gradient", 1, 32, calls=16),
)


class WorkerError(RuntimeError):
    """A worker process ended before it answered."""


class WorkerProcess:
    """One library in one child process, spoken to in lines of JSON."""

    def __init__(self, library: str, python: str, platform_name: str) -> None:
        env = dict(os.environ, JAX_PLATFORMS=platform_name)
        if library != OURS:
            # The peer has its own packages; ours must not leak into it.
            env.pop("PYTHONPATH", None)
        self.library = library
        self._process = subprocess.Popen(
            [python, str(WORKER), library],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=env,
        )

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Send a command and wait for its answer."""
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None
        assert stdout is not None
        try:
            stdin.write(json.dumps({"command": command, **arguments}) + "\n")
            stdin.flush()
            answer = stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            code = self._process.wait()
            raise WorkerError(
                f"worker {self.library!r} ended with code {code} at command "
                f"{command!r} {arguments}; its messages are above"
            )
        return json.loads(answer)

    def close(self) -> None:
        """End the worker."""
        self._process.communicate(timeout=60)


def measure(
    workers: list[WorkerProcess], scenarios: list[Scenario], repetitions: int
) -> list[dict[str, Any]]:
    """Prepare all scenarios, then take turns; returns a row a scenario and library."""
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for scenario in scenarios:
        for worker in workers:
            prepared = worker.ask(
                "prepare",
                name=scenario.name,
                kind=scenario.kind,
                worlds=scenario.worlds,
                steps=scenario.steps,
                calls=scenario.calls,
            )
            rows[scenario.name, worker.library] = {
                "scenario": scenario.name,
                "library": worker.library,
                **prepared,
                "wall_s": [],
                "cpu_s": [],
            }
            print(f"prepared {scenario.name} {worker.library} {prepared}", flush=True)
    for repetition in range(repetitions):
        for scenario in scenarios:
            # Neither library always runs first.
            for worker in workers if repetition % 2 == 0 else workers[::-1]:
                seconds = worker.ask("measure", name=scenario.name)
                row = rows[scenario.name, worker.library]
                row["wall_s"].append(seconds["wall_s"])
                row["cpu_s"].append(seconds["cpu_s"])
    for scenario in scenarios:
        for worker in workers:
            row = rows[scenario.name, worker.library]
            row["steps_per_s"] = scenario.total_steps / statistics.median(row["wall_s"])
            row["cores_used"] = sum(row["cpu_s"]) / sum(row["wall_s"])
    return list(rows.values())


def table(rows: list[dict[str, Any]], scenarios: list[Scenario]) -> str:
    """Return the comparison as a Markdown table."""
    by_name = {(row["scenario"], row["library"]): row for row in rows}
    lines = [
        "| scenario | newton_qd [k steps/s] | cores | brax v1 [k steps/s] | cores "
        "| ratio | promised |",
        "|---|---|---|---|---|---|---|",
    ]
    for scenario in scenarios:
        cells = [scenario.name]
        for library in (OURS, PEER):
            row = by_name.get((scenario.name, library))
            if row is None:
                cells += ["-", "-"]
            elif not row["valid"]:
                cells += ["invalid", "-"]
            else:
                cells += [f"{row['steps_per_s'] / 1e3:.1f}", f"{row['cores_used']:.2f}"]
        ratio = find_ratio(by_name, scenario)
        cells.append("-" if ratio is None else f"{ratio:.2f}")
        cells.append("-" if scenario.required is None else f"{scenario.required:g}")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def find_ratio(
    by_name: dict[tuple[str, str], dict[str, Any]], scenario: Scenario
) -> float | None:
    """Return how many times faster ours is, or None where a side does not count."""
    pair = [by_name.get((scenario.name, library)) for library in (OURS, PEER)]
    ours, peer = pair
    if ours is None or peer is None or not (ours["valid"] and peer["valid"]):
        return None
    return ours["steps_per_s"] / peer["steps_per_s"]


def parse_arguments() -> argparse.Namespace:
    """Return the command line's options."""
    parser = argparse.ArgumentParser(
        description="Compare newton_qd's ant_uni with brax v1's."
    )
    parser.add_argument(
        "--peer-python",
        help="Python of the environment with brax v1; without it only newton_qd runs",
    )
    parser.add_argument(
        "--python", default=sys.executable, help="Python with newton_qd"
    )
    parser.add_argument("--only-peer", action="store_true", help="leave newton_qd out")
    parser.add_argument(
        "--scenarios",
        nargs="+",
        choices=[scenario.name for scenario in SCENARIOS],
        help="default: all",
    )
    parser.add_argument("--repetitions", type=int, default=5, help="default: 5")
    parser.add_argument(
        "--platform", default="cpu", help="JAX platform of both sides, default: cpu"
    )
    parser.add_argument(
        "--out",
        type=Path,
        help="JSON file for the result; with --gaits, folder for csv files",
    )
    add_gait_options(parser)
    arguments = parser.parse_args()
    if arguments.repetitions < 1:
        parser.error(f"--repetitions is {arguments.repetitions}; it must be at least 1")
    if arguments.only_peer and not arguments.peer_python:
        parser.error("--only-peer needs --peer-python")
    for option in ("python", "peer_python"):
        python = getattr(arguments, option)
        if python is not None and shutil.which(python) is None:
            name = "--" + option.replace("_", "-")
            parser.error(f"{name} is {python!r}; it must be a Python interpreter")
    return arguments


def add_gait_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``--gaits``."""
    group = parser.add_argument_group("gaits")
    group.add_argument(
        "--gaits", action="store_true", help="compare returns of gaits, not speeds"
    )
    group.add_argument(
        "--robots",
        nargs="+",
        choices=list(gaits.ROBOTS),
        default=list(gaits.ROBOTS),
        help="default: all",
    )
    group.add_argument(
        "--ours",
        type=json.loads,
        default={},
        help="JSON with changes to our robots, such as "
        '{"substeps": 20, "material": {"friction": 0.8}}',
    )


def main() -> int:
    """Run the comparison; returns 1 if a scenario does not count."""
    arguments = parse_arguments()
    chosen = arguments.scenarios or [scenario.name for scenario in SCENARIOS]
    scenarios = [scenario for scenario in SCENARIOS if scenario.name in chosen]
    load = os.getloadavg()[0]
    if load > BUSY_LOAD and not arguments.gaits:
        print(f"warning: the load is {load:.1f}: other processes share the cores")
    pythons = {}
    if not arguments.only_peer:
        pythons[OURS] = arguments.python
    if arguments.peer_python:
        pythons[PEER] = arguments.peer_python
    workers = [
        WorkerProcess(library, python, arguments.platform)
        for library, python in pythons.items()
    ]
    try:
        if arguments.gaits:
            asks = {worker.library: worker.ask for worker in workers}
            print(gaits.compare(asks, arguments.robots, arguments.ours, arguments.out))
            return 0
        described = {worker.library: worker.ask("describe") for worker in workers}
        rows = measure(workers, scenarios, arguments.repetitions)
    finally:
        for worker in workers:
            worker.close()
    print(json.dumps(described, indent=2))
    print(table(rows, scenarios))
    if arguments.out:
        result = {
            "machine": {
                "platform": platform.platform(),
                "cores": os.cpu_count(),
                "load_before": load,
            },
            "libraries": described,
            "repetitions": arguments.repetitions,
            "scenarios": [dataclasses.asdict(scenario) for scenario in scenarios],
            "rows": rows,
        }
        arguments.out.write_text(json.dumps(result, indent=2) + "\n")
    return 0 if all(row["valid"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
