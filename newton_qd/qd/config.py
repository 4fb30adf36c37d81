"""Settings of an evolution: one frozen dataclass, and its file."""

from __future__ import annotations

import dataclasses
import json
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, listed, message

FORMAT = 1
MAX_CELLS = 1_000_000
MAX_TOURNAMENT = 1000
DEFAULT_GRIDS = {1: (64,), 2: (32, 32), 3: (9, 9, 9), 4: (5, 5, 5, 5)}
"""Default number of cells per descriptor dimension."""

STATISTICS = ("mean", "median")
"""Ways to join the results of several start states."""


class ConfigError(ValueError):
    """A setting is wrong, unknown, or differs from that of the run to resume."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvolveConfig:
    """Everything that determines the result of an evolution.

    Attributes:
        env_name: Registered name of a Quality-Diversity environment.
        seed: Seed of every random number, ``0`` to ``2**32 - 1``.
        iterations: Generations after the initial population.
        batch_size: Individuals evaluated in one generation.
        episode_length: Control steps of one evaluation.
        hidden: Widths of the hidden layers of the policy.
        grid: Cells along each descriptor dimension. ``None`` takes the default
            grid of the descriptor's length unless ``centroids`` is given.
        centroids: Number of cells of a centroidal Voronoi tessellation instead
            of a grid.
        iso_sigma: Standard deviation of the isotropic part of a variation, in
            units of policy weights [-].
        line_sigma: Standard deviation of the step towards the second parent,
            relative to the distance of the parents [-].
        tournament: Elites that are drawn for the second parent, which is the fittest of
            them; 1: it is drawn uniformly, as in MAP-Elites.
        reevaluations: Evaluations of each elite at the end of the run, for metrics
            without luck; 0: none.
        algorithm: Name of one of ``newton_qd.qd.algorithms.ALGORITHMS``.
        options: Settings of this algorithm, as ``(name, value)`` sorted by name. A
            dictionary is allowed too.
        env_options: Options of the environment, as ``(name, value)`` or as a
            dictionary: arguments of ``newton_qd.create``, as plain values. ``material``
            is a table with the fields of ``Material`` that differ from the robot's;
            ``scene`` is a name in ``newton_qd.scenes.SCENES``, a URDF file, or a table
            with the fields of ``Scene``.
        starts: Start states from which each individual is evaluated.
        statistic: ``"mean"`` or ``"median"`` of fitness and descriptor over them.
        scatter: Scatter of an individual's descriptors over its start states that
            halves its fitness with offset (see ``Scatter``); 0: scatter costs nothing.
            Its unit is the edge of a cube with the volume of a cell.
        new_starts: Whether every generation has other start states.
        randomize: Ranges of physical parameters, as ``(name, (lowest, highest))`` or
            as a dictionary; each start state has its own parameters
            (:func:`~newton_qd.randomize_params`).
        warm_start: SHA-256 of the genotypes that the run starts from; ``None``: random
            ones. ``evolve`` sets it from ``start_from``.

    Raises:
        ConfigError: A value is wrong, or both ``grid`` and ``centroids`` are given.
    """

    env_name: str = "ant_uni"
    seed: int = 0
    iterations: int = 400
    batch_size: int = 128
    episode_length: int = 100
    hidden: tuple[int, ...] = (32,)
    grid: tuple[int, ...] | None = None
    centroids: int | None = None
    iso_sigma: float = 0.02
    line_sigma: float = 0.2
    tournament: int = 1
    reevaluations: int = 32
    algorithm: str = "me"
    options: tuple[tuple[str, Any], ...] = ()
    env_options: tuple[tuple[str, Any], ...] = ()
    starts: int = 1
    statistic: str = "mean"
    scatter: float = 0.0
    new_starts: bool = False
    randomize: tuple[tuple[str, Any], ...] = ()
    warm_start: str | None = None

    def __post_init__(self) -> None:
        """Converts sequences to tuples and checks every value."""
        for name in ("hidden", "grid"):
            value = getattr(self, name)
            if isinstance(value, list):
                object.__setattr__(self, name, tuple(value))
        for name in ("options", "env_options", "randomize"):
            frozen = tuple(
                (key, plain_value(f"{name}: {key}", value))
                for key, value in _pairs(name, getattr(self, name))
            )
            object.__setattr__(self, name, frozen)
        self._check()
        for name in ("iso_sigma", "line_sigma", "scatter"):
            object.__setattr__(self, name, float(getattr(self, name)))

    def _check(self) -> None:
        checks.text("env_name", self.env_name, error=ConfigError)
        checks.text("algorithm", self.algorithm, error=ConfigError)
        checks.text("warm_start", self.warm_start, optional=True, error=ConfigError)
        check_integer("seed", self.seed, 0, 2**32 - 1)
        check_integer("iterations", self.iterations, 0)
        check_integer("batch_size", self.batch_size, 1)
        check_integer("tournament", self.tournament, 1, MAX_TOURNAMENT)
        check_integer("starts", self.starts, 1)
        if self.statistic not in STATISTICS:
            raise ConfigError(message("statistic", self.statistic, listed(STATISTICS)))
        checks.number("scatter", self.scatter, least=0, most=1e6, error=ConfigError)
        checks.instance(
            "new_starts", self.new_starts, bool, "True, False", error=ConfigError
        )
        check_integer("reevaluations", self.reevaluations, 0)
        check_integer("episode_length", self.episode_length, 1)
        check_integers("hidden", self.hidden)
        checks.number("iso_sigma", self.iso_sigma, least=0, error=ConfigError)
        checks.number("line_sigma", self.line_sigma, least=0, error=ConfigError)
        if self.grid is not None and self.centroids is not None:
            given = (self.grid, self.centroids)
            raise ConfigError(message("grid, centroids", given, "one of the two"))
        if self.grid is not None:
            check_integers("grid", self.grid)
            if not self.grid:
                raise ConfigError(message("grid", (), "at least one dimension"))
            check_integer("grid's number of cells", math.prod(self.grid), 2, MAX_CELLS)
        if self.centroids is not None:
            check_integer("centroids", self.centroids, 2, MAX_CELLS)

    def resolve(self, descriptor_length: int) -> EvolveConfig:
        """Sets a default grid and checks that it fits the descriptor.

        Args:
            descriptor_length: Number of components of the descriptor.

        Returns:
            Settings in which exactly one of ``grid`` and ``centroids`` is given.

        Raises:
            ConfigError: There is no default grid for this length, or the grid has the
                wrong number of dimensions.
        """
        if self.centroids is not None:
            return self
        if self.grid is None:
            if descriptor_length not in DEFAULT_GRIDS:
                why = (
                    f"and a descriptor of {descriptor_length} components has no default"
                )
                allowed = "a grid, or centroids (a number of cells), such as 1024"
                raise ConfigError(message("grid", None, allowed, why=why))
            return dataclasses.replace(self, grid=DEFAULT_GRIDS[descriptor_length])
        if len(self.grid) != descriptor_length:
            cells = "x".join(map(str, self.grid))
            count = len(self.grid)
            plural = "" if count == 1 else "s"
            given = Fact(f"{cells}, which has {count} dimension{plural}")
            allowed = f"as many as the descriptor of {self.env_name!r} has: "
            allowed += str(descriptor_length)
            raise ConfigError(message("grid", given, allowed))
        return self

    def replace(self, **changes: object) -> EvolveConfig:
        """Returns a copy with some settings changed.

        Raises:
            ConfigError: A setting does not exist, or a value is wrong.
        """
        known = {field.name for field in dataclasses.fields(self)}
        unknown = sorted(set(changes) - known)
        if unknown:
            raise ConfigError(message("setting", unknown[0], listed(sorted(known))))
        return dataclasses.replace(self, **changes)

    def differences(self, other: EvolveConfig) -> list[tuple[str, object, object]]:
        """Lists ``(name, own value, other's value)`` of settings that differ."""
        pairs = (
            (field.name, getattr(self, field.name), getattr(other, field.name))
            for field in dataclasses.fields(self)
        )
        return [row for row in pairs if row[1] != row[2]]


class Table(dict[str, Any]):
    """A table inside of the settings, which are hashable. It is never changed."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self.items()))


def plain_value(name: str, value: Any) -> Any:
    """Returns a value that files of settings can hold, with tuples instead of lists.

    Raises:
        ConfigError: Files of settings cannot hold it.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list | tuple):
        return tuple(plain_value(f"{name}[{i}]", x) for i, x in enumerate(value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    if isinstance(value, Mapping):
        return Table({str(k): plain_value(f"{name}.{k}", x) for k, x in value.items()})
    allowed = "numbers, text, True, False, and lists or tables of them"
    raise ConfigError(message(name, value, allowed))


def _pairs(name: str, options: Any) -> tuple[tuple[str, Any], ...]:
    """Sorts options by name, and converts lists to tuples.

    Raises:
        ConfigError: They are not names with values.
    """
    items = options.items() if isinstance(options, Mapping) else options
    try:
        pairs = {
            str(key): tuple(value) if isinstance(value, list) else value
            for key, value in items
        }
    except (TypeError, ValueError) as error:
        raise ConfigError(message(name, options, "names with values")) from error
    return tuple(sorted(pairs.items()))


def check_integer(
    name: str, value: object, least: int, most: int | None = None
) -> None:
    """Checks that a value is a Python integer within bounds.

    Raises:
        ConfigError: The value is not such an integer.
    """
    checks.integer(name, value, least=least, most=most, error=ConfigError)
    # the file of settings cannot contain other integers, such as NumPy's
    checks.instance(name, value, int, "integers of Python", error=ConfigError)


def check_integers(name: str, values: object) -> None:
    """Checks that values are a tuple of integers of at least 1.

    Raises:
        ConfigError: The values are not such a tuple.
    """
    checks.instance(name, values, tuple, "a tuple of integers", error=ConfigError)
    for index, value in enumerate(cast("tuple[object, ...]", values)):
        check_integer(f"{name}[{index}]", value, 1)


def config_to_json(config: EvolveConfig, facts: dict[str, object]) -> str:
    """Returns settings and the facts of the machine as readable JSON."""
    document = {
        "format": FORMAT,
        "settings": dataclasses.asdict(config),
        "environment": facts,
    }
    return json.dumps(document, indent=2) + "\n"


def settings_text(config: EvolveConfig) -> str:
    """Returns the settings as one line, for ``same_run``."""
    return json.dumps(dataclasses.asdict(config), sort_keys=True)


def same_run(one: str, other: str) -> bool:
    """Returns whether two lines of ``settings_text`` are those of the same run.

    1 is equal to 1.0. The number of generations may differ, because a run can go on
    beyond its end. An earlier version wrote fewer settings; it had their defaults.
    """
    plain = json.loads(settings_text(EvolveConfig()))
    known = [{**plain, **json.loads(text), "iterations": 0} for text in (one, other)]
    return known[0] == known[1]


def read_config(
    path: Path, env_name: str | None = None
) -> tuple[EvolveConfig, dict[str, object]]:
    """Reads a ``config.json``, or settings in a TOML file.

    Args:
        path: File to read. A ``.toml`` file has settings as ``name = value``, and the
            tables ``options`` and ``env_options``.
        env_name: Environment, if the file does not name one.

    Returns:
        Settings, and the facts of the machine that wrote them. These may be empty.

    Raises:
        ConfigError: The file is missing, has the wrong format, has a wrong setting, or
            the environment is missing.
    """
    written_by_hand = path.suffix == ".toml"
    kind, parse = ("TOML", tomllib.loads) if written_by_hand else ("JSON", json.loads)
    try:
        # an editor of Windows may write a mark at the beginning
        document = parse(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from error
    except (RecursionError, ValueError) as error:  # recursion: deeply nested lists
        raise ConfigError(f"{path} is not valid {kind}: {error}") from error
    if written_by_hand:
        document = {"format": FORMAT, "settings": document}
    if not isinstance(document, dict) or "settings" not in document:
        raise ConfigError(f"{path} is not a newton-qd config: no 'settings'")
    if document.get("format") != FORMAT:
        raise ConfigError(
            f"{path} has format {document.get('format')!r}; this version of "
            f"newton_qd reads format {FORMAT}"
        )
    settings = document["settings"]
    if not isinstance(settings, dict):
        raise ConfigError(message(f"{path}: settings", settings, "an object"))
    facts = document.get("environment", {})
    if not isinstance(facts, dict) or not isinstance(facts.get("packages", {}), dict):
        raise ConfigError(message(f"{path}: environment", facts, "facts by name"))
    if env_name is not None:
        settings = {"env_name": env_name, **settings}
    try:
        config = EvolveConfig().replace(**settings)
        if "env_name" not in settings:
            raise ConfigError(message("env_name", None, "the name of an environment"))
        return config, facts
    except (ConfigError, TypeError, ValueError) as error:
        raise ConfigError(f"{path}: {error}") from error
