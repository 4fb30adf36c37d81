"""Old names of ``newton_qd.qd``: they work, and say the new name."""

from __future__ import annotations

import importlib

import pytest

QD = "newton_qd.qd"


@pytest.mark.parametrize(
    ("old", "name", "new"),
    [
        ("ribs", "make_ribs_evaluation", QD),
        ("sharding", "shard_scoring", QD),
        ("actor_critic", "ActorCriticSettings", f"{QD}.emitters"),
        ("gradient_options", "TUNED", f"{QD}.algorithms.gradient_options"),
    ],
)
def test_an_old_module_has_its_names(old: str, name: str, new: str) -> None:
    module = importlib.import_module(f"{QD}.{old}")
    with pytest.warns(DeprecationWarning, match=rf"is now {new}\.{name}$"):
        value = getattr(module, name)
    assert value is getattr(importlib.import_module(new), name)
    with pytest.raises(AttributeError, match=f"'{QD}.{old}' has no attribute"):
        module.nothing  # noqa: B018
