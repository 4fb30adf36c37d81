"""The arguments of ``newton-qd evolve``, and the settings that they make."""

from __future__ import annotations

import argparse
import ast
import contextlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.cli import modules
from newton_qd.cli.arguments import Commands, integers, warn_of_changes, widths
from newton_qd.cli.changes import merged, other_cells, with_defaults
from newton_qd.qd.algorithms import ALGORITHMS
from newton_qd.qd.config import ConfigError, EvolveConfig, read_config
from newton_qd.qd.study import study_config

_DEFAULTS = EvolveConfig()

_UNNAMED = message("ENV", None, "the name of an environment, as in evolve ant_uni")


def add_arguments(commands: Commands, run: Callable[..., int]) -> None:
    """Adds the command to the subparsers of ``newton-qd``.

    Args:
        commands: The subparsers.
        run: The command.
    """
    parser = commands.add_parser(
        "evolve",
        help="run a Quality-Diversity algorithm on an environment",
        description="Evolves an archive of policies and writes a results folder: "
        "archive.npz, archive.png, metrics.csv, corrected.json, config.json and a "
        "checkpoint. With --algorithm NAME, this help also lists the options of the "
        "algorithm.",
        add_help=False,
    )
    parser.set_defaults(run=run)
    # shown by ``run``, because the options of an algorithm may be those of a module
    parser.add_argument(
        "-h", "--help", action="store_true", help="show this help and exit"
    )
    parser.set_defaults(parser=parser)
    _add_run_arguments(parser)
    _add_setting_arguments(parser)


def _add_run_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "env_name",
        nargs="?",
        metavar="ENV",
        help="environment, for example ant_uni (newton-qd envs lists them)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="results folder (default: results/ENV-seedSEED)",
    )
    parser.add_argument(
        "--resume",
        action="store_true",
        help="continue the run in the results folder, with its settings; start it if "
        "the folder has none; with more --iterations it goes on beyond its end",
    )
    _add_beginnings(parser)
    parser.add_argument(
        "--checkpoint-seconds",
        type=float,
        default=5.0,
        metavar="S",
        help="minimum time between two checkpoints [s] (default: 5); longer where one "
        "takes long, 0: one after each generation",
    )
    parser.add_argument(
        "--tensorboard",
        action="store_true",
        help="also write the metrics as event files for TensorBoard",
    )
    parser.add_argument(
        "--devices",
        type=int,
        metavar="N",
        help="number of devices for each evaluation; does not change the result",
    )
    parser.add_argument(
        "--device",
        metavar="NAME",
        help="device of the whole run: cpu, gpu or gpu:1 (default: that of JAX, a GPU "
        "if there is one)",
    )
    modules.add_argument(parser)
    parser.add_argument("--quiet", action="store_true", help="show no progress")


def _add_beginnings(parser: argparse.ArgumentParser) -> None:
    """Adds where elites and settings come from."""
    parser.add_argument(
        "--start-from",
        type=Path,
        metavar="DIR",
        help="start from the elites of another results folder, not a random population",
    )
    base = parser.add_mutually_exclusive_group()
    base.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="read settings from a TOML file, or from config.json of an earlier run",
    )
    base.add_argument(
        "--study",
        action="store_true",
        help="take the settings that the algorithm has for ENV in the study "
        "(docs/study.md), which are for a GPU; with --resume, the run knows both",
    )
    parser.add_argument(
        "--unset",
        action="append",
        metavar="NAME",
        help="give a setting of --config or --study its default again, such as "
        "new_starts, options.discount or env_options.material.friction; may be "
        "repeated",
    )


def _add_setting_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("settings that determine the result")
    for name, kind, text in (
        ("seed", int, "seed of all random numbers"),
        ("iterations", int, "generations after the initial population"),
        ("batch_size", int, "individuals evaluated in one generation"),
        ("episode_length", int, "control steps of one evaluation"),
        ("iso_sigma", float, "standard deviation of the isotropic variation"),
        ("line_sigma", float, "standard deviation of the step to a second parent"),
        ("tournament", int, "elites of which the fittest is a second parent"),
        ("reevaluations", int, "evaluations of each elite at the end; 0: none"),
        ("starts", int, "start states from which each individual is evaluated"),
    ):
        group.add_argument(
            f"--{name.replace('_', '-')}",
            type=kind,
            metavar="N" if kind is int else "X",
            help=f"{text} (default: {getattr(_DEFAULTS, name)})",
        )
    group.add_argument(
        "--algorithm",
        metavar="NAME",
        help=f"{', '.join(spec.name for spec in ALGORITHMS)} (default: "
        f"{_DEFAULTS.algorithm}); 'newton-qd algorithms' says what they are",
    )
    group.add_argument(
        "--option",
        dest="options",
        type=_option,
        action="append",
        metavar="NAME=VALUE",
        help="option of the algorithm, for example discount=0.95; may be "
        "repeated; 'newton-qd algorithms ALGORITHM' lists them",
    )
    group.add_argument(
        "--env-option",
        dest="env_options",
        type=_env_option,
        action="append",
        metavar="NAME=VALUE",
        help="argument of newton_qd.create, for example healthy_reward=0.5, scene=maze "
        "or material.friction=0.8; may be repeated",
    )
    _add_start_arguments(group)
    _add_policy_and_cell_arguments(group)


def _add_policy_and_cell_arguments(group: argparse._ArgumentGroup) -> None:
    """Adds the size of the policy, and the cells of the archive."""
    group.add_argument(
        "--hidden",
        type=widths,
        metavar="N,N",
        help="hidden layers of the policy; none: a linear policy (default: "
        f"{','.join(map(str, _DEFAULTS.hidden))})",
    )
    cells = group.add_mutually_exclusive_group()
    cells.add_argument(
        "--grid",
        type=_grid,
        metavar="NxN",
        help="cells along each descriptor dimension (default with four: 5x5x5x5)",
    )
    cells.add_argument(
        "--centroids",
        type=int,
        metavar="N",
        help="number of cells of a centroidal Voronoi tessellation, instead of a grid",
    )


def _add_start_arguments(group: argparse._ArgumentGroup) -> None:
    """Adds what an individual is evaluated from, beside the number of starts."""
    group.add_argument(
        "--statistic",
        metavar="NAME",
        help="mean or median of the results of several start states (default: "
        f"{_DEFAULTS.statistic})",
    )
    group.add_argument(
        "--scatter",
        type=float,
        metavar="CELLS",
        help="lower the fitness of individuals whose episodes end apart: half of it, "
        "with offset, at a scatter of so many widths of a cell; needs several start "
        "states (default: 0, no price)",
    )
    group.add_argument(
        "--new-starts",
        action="store_const",
        const=True,
        help="other start states in each generation",
    )
    group.add_argument(
        "--randomize",
        type=_range,
        action="append",
        metavar="NAME=LOW,HIGH",
        help="range of a physical parameter, for example friction=0.5,1.5; each start "
        "state has its own; may be repeated",
    )


def _option(text: str) -> tuple[str, Any]:
    name, separator, value = text.partition("=")
    found = _value(value)
    if name and separator and not isinstance(found, str):
        return name, found
    raise argparse.ArgumentTypeError(
        f"got {text!r}; allowed: a name and a value like discount=0.95"
    )


def _range(text: str) -> tuple[str, Any]:
    name, separator, value = text.partition("=")
    with contextlib.suppress(ValueError):
        low, high = (float(part) for part in value.split(","))
        if name and separator:
            return name, (low, high)
    raise argparse.ArgumentTypeError(
        f"got {text!r}; allowed: a name and two numbers like friction=0.5,1.5"
    )


def _env_option(text: str) -> tuple[str, Any]:
    name, separator, value = text.partition("=")
    if not (name and separator and value):
        raise argparse.ArgumentTypeError(
            f"got {text!r}; allowed: a name and a value like healthy_reward=0.5"
        )
    return name, _value(value)


def _value(text: str) -> Any:
    """Returns a value that JSON or Python writes so; other text, as in scene=maze."""
    for parse in (json.loads, ast.literal_eval):
        with contextlib.suppress(RecursionError, SyntaxError, ValueError):
            return parse(text)
    return text


def _grid(text: str) -> tuple[int, ...]:
    return integers(text, "x")


def settle(arguments: argparse.Namespace) -> tuple[EvolveConfig, Path]:
    """Combines the settings of the arguments, and of what they are based on.

    That is a config file, the study, or the run to resume.

    Raises:
        ConfigError: No environment is named, or a setting is not allowed. The results
            folder is not checked, because other wrong arguments come first.
    """
    from newton_qd.qd.run.folder import CONFIG, RunFolder

    names = vars(_DEFAULTS)
    given = {
        name: value
        for name, value in vars(arguments).items()
        if name in names and value is not None
    }
    base = None
    if arguments.config is not None:
        base, facts = read_config(arguments.config, given.get("env_name"))
        warn_of_changes(facts, "when this config was written")
    if arguments.study:
        base = _of_study(arguments, given)
    # without an environment, the study has no settings, and the error below says so
    if arguments.unset and not (arguments.study and base is None):
        base = with_defaults(base, arguments.unset)
    out = arguments.out
    if out is None:
        named = other_cells(base or _DEFAULTS, given).replace(**given)
        if base is None and "env_name" not in given:
            raise ConfigError(_UNNAMED)
        # the name becomes a folder, so it must not be a path
        checks.identifier("env_name", named.env_name, error=ConfigError)
        out = Path("results") / f"{named.env_name}-seed{named.seed}"
    folder = RunFolder(out)
    if arguments.resume and folder.has_config and arguments.config is None:
        kept = read_config(out / CONFIG)[0]
        # the study has no number of generations
        base = kept if base is None else base.replace(iterations=kept.iterations)
    if base is None and "env_name" not in given:
        folder.check(resume=arguments.resume)
        if not arguments.resume:
            raise ConfigError(_UNNAMED)
        why = "which holds no run"
        refused = message("out", Fact(out), "the results folder of a run", why=why)
        raise ConfigError(f"{refused}. To start a run there: {_UNNAMED}")
    base = other_cells(base or _DEFAULTS, given)
    if "options" in given:
        given["options"] = {**dict(base.options), **dict(given["options"])}
    if "randomize" in given:
        given["randomize"] = {**dict(base.randomize), **dict(given["randomize"])}
    if "env_options" in given:
        given["env_options"] = merged(dict(base.env_options), given["env_options"])
    return base.replace(**given), out


def _of_study(
    arguments: argparse.Namespace, given: Mapping[str, Any]
) -> EvolveConfig | None:
    """Returns the settings of the study; ``None`` if no environment is named.

    The run to resume names what the arguments do not: environment and algorithm.

    Raises:
        ConfigError: The study has no such run, or the run to resume is of another
            environment.
    """
    from newton_qd.qd.run.folder import CONFIG, RunFolder

    names = {"algorithm": _DEFAULTS.algorithm}
    if arguments.resume and arguments.out is not None:
        folder = RunFolder(arguments.out)
        if folder.has_config:
            kept = read_config(folder.path / CONFIG)[0]
            names = {"env_name": kept.env_name, "algorithm": kept.algorithm}
            folder.compare_environment(given.get("env_name", kept.env_name))
    names |= {name: given[name] for name in ("env_name", "algorithm") if name in given}
    return study_config(**names) if "env_name" in names else None
