"""Protocols of the study: which runs there are, and where their scores are read."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

HUMANOIDS = ("humanoid_uni", "humanoid_omni", "humanoidtrap")
"""Their policies are larger: CMA-ME's matrix of all weights would not fit in memory."""

SLOW = ("pga-me", "dcrl-me", "cma-me")
"""Baselines whose generation takes long: they get fewer seeds."""


@dataclasses.dataclass(frozen=True)
class Stop:
    """A point of a run at which its scores are read.

    Attributes:
        unit: ``evaluations`` or ``s``.
        amount: Number of evaluations, or of seconds without compilation.
    """

    unit: str
    amount: int

    def __str__(self) -> str:
        return f"{self.amount} {self.unit}"

    def reached(self, evaluations: float, seconds: float) -> bool:
        """Whether a run has come so far."""
        return (seconds if self.unit == "s" else evaluations) >= self.amount


@dataclasses.dataclass(frozen=True)
class Protocol:
    """The tasks, settings and stops of a comparison.

    Attributes:
        name: Name of the protocol.
        tasks: Names of the environments.
        algorithms: Names of the algorithms.
        settings: Settings of all runs.
        own: Settings of some tasks, by name.
        stops: Points at which the scores are read; the last ends a run.
        seeds: Number of seeds.
        slow_seeds: Number of seeds of the slow baselines.
        defaults: Whether algorithms have the defaults of ``newton-qd evolve`` without
            tuning. If not, they have the variant of the report.
    """

    name: str
    tasks: tuple[str, ...]
    algorithms: tuple[str, ...]
    settings: Mapping[str, Any]
    own: Mapping[str, Mapping[str, Any]]
    stops: tuple[Stop, ...]
    seeds: int
    slow_seeds: int
    defaults: bool = False

    def settings_of(self, task: str) -> dict[str, Any]:
        """Settings of the runs of a task."""
        return {**self.settings, **self.own.get(task, {})}

    def seeds_of(self, algorithm: str) -> int:
        """Number of seeds of an algorithm."""
        return self.slow_seeds if algorithm in SLOW else self.seeds

    def has(self, task: str, algorithm: str) -> bool:
        """Whether an algorithm can run on a task."""
        return not (algorithm == "cma-me" and task in HUMANOIDS)

    def stops_until(self, seconds: float) -> tuple[Stop, ...]:
        """The stops that end within some seconds, and the one by evaluations."""
        return tuple(x for x in self.stops if x.unit != "s" or x.amount <= seconds)


BASELINES = ("me", "ascii-me", "cma-me", "pga-me", "dcrl-me")
OURS = (
    "me-actor-critic",
    "ascii-me-exact",
    "me-conditioned",
    "cma-maega-actor-critic",
)

FIELD = Protocol(
    name="field",
    tasks=(
        *("ant_uni", "ant_omni", "anttrap", "antmaze"),
        *("halfcheetah_uni", "hopper_uni", "walker2d_uni"),
        *HUMANOIDS,
    ),
    algorithms=(*BASELINES, *OURS),
    settings={
        "batch_size": 1024,
        "episode_length": 250,
        "hidden": [64, 64],
        "centroids": 1024,
        "reevaluations": 8,
    },
    own={name: {"hidden": [256, 256]} for name in HUMANOIDS},
    stops=(
        Stop("evaluations", 1_000_000),
        Stop("s", 20),
        Stop("s", 60),
        Stop("s", 250),
        Stop("s", 1000),
    ),
    seeds=20,
    slow_seeds=5,
)
"""As in the evaluations of ASCII-ME and DCRL-ME, on one GPU; 20 s are for tuning."""

SMALL = Protocol(
    name="small",
    tasks=(
        *("ant_uni", "ant_omni", "anttrap", "antmaze"),
        *("halfcheetah_uni", "hopper_uni", "walker2d_uni", "humanoid_uni"),
    ),
    algorithms=(*BASELINES, *OURS),
    settings={**FIELD.settings, "batch_size": 256, "reevaluations": 4},
    own={},
    stops=(Stop("evaluations", 20_000), Stop("s", 20), Stop("s", 60)),
    seeds=3,
    slow_seeds=1,
    defaults=True,
)
"""The same episodes and cells, for minutes on a core of a CPU, with the defaults."""

PROTOCOLS = {protocol.name: protocol for protocol in (FIELD, SMALL)}
