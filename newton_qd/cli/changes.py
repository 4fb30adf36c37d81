"""Changes of the settings on which those of a run are based."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from newton_qd.checks import listed, message
from newton_qd.qd.config import ConfigError, EvolveConfig

_DEFAULTS = vars(EvolveConfig())
_TABLES = ("options", "env_options", "randomize")
_NAMES = sorted(set(_DEFAULTS) - {"env_name"})


def with_defaults(base: EvolveConfig | None, paths: Iterable[str]) -> EvolveConfig:
    """Returns settings in which some have their defaults again.

    Args:
        base: Settings of a file or of the study; ``None``: there are none.
        paths: Names of settings. ``options.discount`` is an entry of a table.

    Raises:
        ConfigError: There are no settings, or a name does not exist.
    """
    for path in paths:
        if base is None:
            allowed = "only with --config or --study, whose settings it takes back"
            raise ConfigError(message("unset", path, allowed))
        name, *inside = path.split(".")
        if name not in _NAMES:
            raise ConfigError(message("unset", path, listed(_NAMES)))
        if inside and name not in _TABLES:
            allowed = f"{name}, or entries of {listed(_TABLES)}"
            raise ConfigError(message("unset", path, allowed))
        value: Any = _DEFAULTS[name]
        if inside:
            value = _without(dict(getattr(base, name)), inside, path)
        base = base.replace(**{name: value})
    assert base is not None
    return base


def _without(table: Any, names: Sequence[str], path: str) -> dict[str, Any]:
    """Returns a table without one entry, which may be that of a table inside.

    Raises:
        ConfigError: There is no such entry.
    """
    name, *inside = names
    if not isinstance(table, Mapping) or name not in table:
        known = listed(table) if isinstance(table, Mapping) else "none"
        above = path.removesuffix(f".{'.'.join(names)}")
        raise ConfigError(message("unset", path, f"entries of {above}: {known}"))
    others = {key: value for key, value in table.items() if key != name}
    below = _without(table[name], inside, path) if inside else {}
    # without its last entry, a table is not there, as by default
    return {**others, name: below} if below else others


def other_cells(base: EvolveConfig, given: Mapping[str, Any]) -> EvolveConfig:
    """Returns settings without the cells that given ones replace, of either kind."""
    if "grid" in given:
        base = base.replace(centroids=None)
    if "centroids" in given:
        base = base.replace(grid=None)
    return base


def merged(options: dict[str, Any], given: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Returns options with others; ``material.friction`` is an entry of a table.

    Raises:
        ConfigError: A name with a dot does not belong to a table.
    """
    for path, value in given:
        *tables, name = path.split(".")
        inside = options
        for table in tables:
            below = inside.get(table, {})
            if not isinstance(below, Mapping):
                given_text = f"{path}, where {table} is {below!r}"
                raise ConfigError(
                    message("env_options", given_text, "names of a table")
                )
            inside[table] = inside = dict(below)
        inside[name] = value
    return options
