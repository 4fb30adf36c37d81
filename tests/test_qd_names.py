"""Old names of ``newton_qd.qd``: they work, and say the new name."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

from newton_qd.qd.config import EvolveConfig
from newton_qd.qd.run.archive import Archive
from newton_qd.qd.run.evolve_result import EvolveResult
from newton_qd.qd.run.reevaluation import Reevaluated

QD = "newton_qd.qd"


@pytest.mark.parametrize(
    ("old", "name", "new"),
    [
        ("ribs", "make_ribs_evaluation", QD),
        ("sharding", "shard_scoring", QD),
        ("actor_critic", "ActorCriticSettings", f"{QD}.emitters"),
    ],
)
def test_an_old_module_has_its_names(old: str, name: str, new: str) -> None:
    module = importlib.import_module(f"{QD}.{old}")
    with pytest.warns(DeprecationWarning, match=rf"is now {new}\.{name}$"):
        value = getattr(module, name)
    assert value is getattr(importlib.import_module(new), name)
    with pytest.raises(AttributeError, match=f"'{QD}.{old}' has no attribute"):
        module.nothing  # noqa: B018


def test_old_defaults_of_environments() -> None:
    old = importlib.import_module(f"{QD}.gradient_options")
    with pytest.warns(DeprecationWarning, match="TUNED is now tuned of each"):
        tuned = old.TUNED
    falls = {"shortest": 0.0005, "longest": 0.02, "sigma_g": 0.02}
    assert tuned["halfcheetah_uni"] == {"window": 10, "clip": 0.0, "longest": 1.0}
    assert tuned["hopper_uni"] == tuned["humanoidtrap"] == falls and len(tuned) == 6
    with pytest.raises(AttributeError, match="has no attribute 'FlowOptions'"):
        old.FlowOptions  # noqa: B018


def test_old_name_of_reevaluated() -> None:
    again = Reevaluated(reevaluations=1, qd_score=1.0, coverage=2.0, max_fitness=3.0)
    nothing = np.zeros((0, 0))
    result = EvolveResult(
        config=EvolveConfig(),
        archive=Archive(nothing, nothing, nothing, nothing),
        metrics={},
        iteration=0,
        interrupted=False,
        out=None,
        seconds=0.0,
        reevaluated=again,
    )
    with pytest.warns(DeprecationWarning, match=r"is now EvolveResult\.reevaluated"):
        assert result.corrected is again


def test_old_name_of_the_type_of_a_policy() -> None:
    types = importlib.import_module("newton_qd.types")
    with pytest.warns(DeprecationWarning, match=r"is now newton_qd\.types\.PolicyF"):
        assert types.Policy is types.PolicyFunction
