"""Quality-Diversity on the environments: settings, loop and results.

- ``evolve(EvolveConfig(...), out=...)``: MAP-Elites on a registered environment
- ``newton_qd.qd.emitters``: emitters of QDax that are fed with exact gradients, and
  ``AnnealedRepertoire`` for one of them
- ``load_archive(folder)``, ``plot_archive(...)``: what a run has found
- ``make_task``, ``make_policy``, ``make_scoring_function``: the parts, for other
  algorithms of QDax
- ``make_gradient_scoring_function``: scores with the gradients of fitness and
  descriptor

Importing this package imports none of its parts: each name is loaded when it is
first used. QDax and matplotlib (extra ``qd``) are imported by the functions that
need them.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from newton_qd.qd.annealed_repertoire import AnnealedRepertoire
    from newton_qd.qd.archive import Archive, ArchiveError, load_archive
    from newton_qd.qd.checkpoint import CheckpointError
    from newton_qd.qd.config import ConfigError, EvolveConfig
    from newton_qd.qd.evolution import EvolveResult, evolve
    from newton_qd.qd.gradient_scoring import make_gradient_scoring_function
    from newton_qd.qd.plot import plot_archive
    from newton_qd.qd.rollout import Policy, make_policy, make_scoring_function
    from newton_qd.qd.search import SearchError
    from newton_qd.qd.task import Task, make_task

__all__ = [
    "AnnealedRepertoire",
    "Archive",
    "ArchiveError",
    "CheckpointError",
    "ConfigError",
    "EvolveConfig",
    "EvolveResult",
    "Policy",
    "SearchError",
    "Task",
    "evolve",
    "load_archive",
    "make_gradient_scoring_function",
    "make_policy",
    "make_scoring_function",
    "make_task",
    "plot_archive",
]

_HOME = {
    "AnnealedRepertoire": "annealed_repertoire",
    "Archive": "archive",
    "ArchiveError": "archive",
    "CheckpointError": "checkpoint",
    "ConfigError": "config",
    "EvolveConfig": "config",
    "EvolveResult": "evolution",
    "Policy": "rollout",
    "SearchError": "search",
    "Task": "task",
    "evolve": "evolution",
    "load_archive": "archive",
    "make_gradient_scoring_function": "gradient_scoring",
    "make_policy": "rollout",
    "make_scoring_function": "rollout",
    "make_task": "task",
    "plot_archive": "plot",
}


def __getattr__(name: str) -> Any:
    """Loads a name of this package when it is first used."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
