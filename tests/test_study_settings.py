"""The settings of the study that the package has."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from newton_qd.qd import ConfigError, study_config
from newton_qd.qd.algorithms import algorithm_named
from newton_qd.qd.study import _tables

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

import study_settings
from study_protocols import FIELD


def test_the_package_has_the_settings_of_the_report() -> None:
    assert study_settings.FILE.read_text(encoding="utf-8") == study_settings.document()
    assert tuple(_tables()) == FIELD.tasks


def test_every_setting_is_one_of_evolve() -> None:
    for env_name, algorithms in _tables().items():
        assert {"me", "dcrl-me", "me-actor-critic"} <= set(algorithms)
        for algorithm in algorithms:
            config = study_config(env_name, algorithm)
            assert (config.env_name, config.algorithm) == (env_name, algorithm)
            assert (config.batch_size, config.centroids) == (1024, 1024)
            algorithm_named(algorithm).check_effect(config)


def test_what_did_not_run_is_told() -> None:
    with pytest.raises(ConfigError, match=r"env_name: got 'reacher'; .* \(ant_uni, "):
        study_config("reacher")
    with pytest.raises(ConfigError, match=r"algorithm: got 'me-es'; .* ant_uni \(me, "):
        study_config("ant_uni", "me-es")
    wrong: Any = ["a"]
    for name, given in (("env_name", (wrong,)), ("algorithm", ("ant_uni", wrong))):
        with pytest.raises(ConfigError, match=rf"{name}: got \['a'\]; allowed: text"):
            study_config(*given)
