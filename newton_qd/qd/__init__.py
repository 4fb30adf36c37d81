"""Quality-Diversity with the environments: settings, loop and results.

- ``evolve(EvolveConfig(...), out=...)``: an archive for a registered environment
- ``study_config("ant_uni", "me-actor-critic")``: the settings of the study
- ``register_algorithm(AlgorithmSpec(...))``: an algorithm of your own for ``evolve``
- ``newton_qd.qd.emitters``: emitters for QDax that use exact gradients, and
  ``AnnealedRepertoire`` for one of them
- ``load_run(folder)``: a run with its settings, task, policy, elites and pictures;
  ``load_archive(folder)``, ``plot_archive(...)``: its archive alone
- ``policy_of(env, network)``: a policy from a network of Flax or Equinox
- ``make_task``, ``make_policy``, ``make_scoring_function``: parts for other algorithms
  of QDax
- ``episode_of(task, policy, length)``: the same as a ``newton_qd.Episode``;
  ``episode.scoring(episode.gradient)`` has gradients
  (``make_gradient_scoring_function`` is deprecated)
- ``robust_scoring(score, starts=4)``: each individual from several start states
- ``reevaluate(archive, score, key, offset=...)``: the corrected QD score of any archive
- ``device_mesh``, ``shard_scoring``: evaluation on several devices
- ``make_ribs_evaluation``, ``to_ribs``, ``from_ribs``: pyribs with these tasks

Importing this package imports no other module of it. Each name is loaded when it is
first used. Functions that need QDax or matplotlib (extra ``qd``) import them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from newton_qd.lazy import loaded_name

if TYPE_CHECKING:
    from newton_qd.qd.algorithms import (
        AlgorithmSpec,
        EmitterContext,
        register_algorithm,
    )
    from newton_qd.qd.algorithms.options import Options
    from newton_qd.qd.config import ConfigError, EvolveConfig
    from newton_qd.qd.emitters.annealed_repertoire import AnnealedRepertoire
    from newton_qd.qd.run.archive import Archive, ArchiveError, load_archive
    from newton_qd.qd.run.checkpoint import CheckpointError
    from newton_qd.qd.run.evaluation import Evaluation
    from newton_qd.qd.run.evolution import evolve
    from newton_qd.qd.run.evolve_result import EvolveResult
    from newton_qd.qd.run.opened import Elite, Run, load_run
    from newton_qd.qd.run.plot import plot_archive
    from newton_qd.qd.run.reevaluation import Reevaluated, reevaluate
    from newton_qd.qd.run.search import SearchError
    from newton_qd.qd.scoring.gradient_scoring import make_gradient_scoring_function
    from newton_qd.qd.scoring.networks import policy_of
    from newton_qd.qd.scoring.ribs import from_ribs, make_ribs_evaluation, to_ribs
    from newton_qd.qd.scoring.robust import robust_scoring
    from newton_qd.qd.scoring.rollout import (
        Policy,
        episode_of,
        make_policy,
        make_scoring_function,
    )
    from newton_qd.qd.scoring.scatter import Scatter
    from newton_qd.qd.scoring.sharding import device_mesh, shard_scoring
    from newton_qd.qd.scoring.task import Task, make_task
    from newton_qd.qd.study import study_config

__all__ = [
    "AlgorithmSpec",
    "AnnealedRepertoire",
    "Archive",
    "ArchiveError",
    "CheckpointError",
    "ConfigError",
    "Elite",
    "EmitterContext",
    "Evaluation",
    "EvolveConfig",
    "EvolveResult",
    "Options",
    "Policy",
    "Reevaluated",
    "Run",
    "Scatter",
    "SearchError",
    "Task",
    "device_mesh",
    "episode_of",
    "evolve",
    "from_ribs",
    "load_archive",
    "load_run",
    "make_gradient_scoring_function",
    "make_policy",
    "make_ribs_evaluation",
    "make_scoring_function",
    "make_task",
    "plot_archive",
    "policy_of",
    "reevaluate",
    "register_algorithm",
    "robust_scoring",
    "shard_scoring",
    "study_config",
    "to_ribs",
]

_HOME = {
    "AlgorithmSpec": ".algorithms",
    "AnnealedRepertoire": ".emitters.annealed_repertoire",
    "Archive": ".run.archive",
    "ArchiveError": ".run.archive",
    "CheckpointError": ".run.checkpoint",
    "ConfigError": ".config",
    "Elite": ".run.opened",
    "EmitterContext": ".algorithms",
    "Evaluation": ".run.evaluation",
    "EvolveConfig": ".config",
    "EvolveResult": ".run.evolve_result",
    "Options": ".algorithms.options",
    "Policy": ".scoring.rollout",
    "Reevaluated": ".run.reevaluation",
    "Run": ".run.opened",
    "Scatter": ".scoring.scatter",
    "SearchError": ".run.search",
    "Task": ".scoring.task",
    "device_mesh": ".scoring.sharding",
    "episode_of": ".scoring.rollout",
    "evolve": ".run.evolution",
    "from_ribs": ".scoring.ribs",
    "load_archive": ".run.archive",
    "load_run": ".run.opened",
    "make_gradient_scoring_function": ".scoring.gradient_scoring",
    "make_policy": ".scoring.rollout",
    "make_ribs_evaluation": ".scoring.ribs",
    "make_scoring_function": ".scoring.rollout",
    "make_task": ".scoring.task",
    "plot_archive": ".run.plot",
    "policy_of": ".scoring.networks",
    "reevaluate": ".run.reevaluation",
    "register_algorithm": ".algorithms",
    "robust_scoring": ".scoring.robust",
    "shard_scoring": ".scoring.sharding",
    "study_config": ".study",
    "to_ribs": ".scoring.ribs",
}


def __getattr__(name: str) -> Any:
    """Loads a name of this package when it is first used."""
    return loaded_name(globals(), name, _HOME)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
