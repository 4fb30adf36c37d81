"""Settings of the study: those that an algorithm has there for an environment."""

from __future__ import annotations

import functools
import tomllib
from importlib.resources import files
from typing import Any

from newton_qd import checks
from newton_qd.checks import listed, message
from newton_qd.qd.config import ConfigError, EvolveConfig


@functools.cache
def _tables() -> dict[str, dict[str, dict[str, Any]]]:
    """Returns the settings by environment and algorithm."""
    text = files("newton_qd.qd").joinpath("study.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def study_config(env_name: str, algorithm: str = "me") -> EvolveConfig:
    """Returns the settings that an algorithm has for an environment in the study.

    They are for a GPU (``docs/study.md``): generations of 1,024 individuals, and up to
    sixteen start states for each. ``iterations`` and ``seed`` have their defaults;
    ``EvolveConfig.replace`` changes them.

    Args:
        env_name: Environment of the study, such as ``walker2d_uni``.
        algorithm: Algorithm that ran there.

    Returns:
        Settings for ``evolve``.

    Raises:
        ConfigError: The study has no such run.
    """
    checks.text("env_name", env_name, error=ConfigError)
    checks.text("algorithm", algorithm, error=ConfigError)
    tables = _tables()
    if env_name not in tables:
        names = f"environments of the study ({listed(tables)})"
        raise ConfigError(message("env_name", env_name, names))
    if algorithm not in tables[env_name]:
        own = listed(tables[env_name])
        names = f"algorithms of the study on {env_name} ({own})"
        raise ConfigError(message("algorithm", algorithm, names))
    settings = tables[env_name][algorithm]
    return EvolveConfig(env_name=env_name, algorithm=algorithm, **settings)
