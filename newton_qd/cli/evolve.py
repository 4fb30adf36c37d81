"""``newton-qd evolve``: runs a Quality-Diversity algorithm on an environment."""

from __future__ import annotations

import argparse
import ast
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.cli.arguments import (
    FAILED,
    OK,
    Commands,
    complain,
    integers,
    warn_of_changes,
    widths,
)
from newton_qd.qd.algorithms import ALGORITHMS
from newton_qd.qd.config import (
    ConfigError,
    EvolveConfig,
    read_config,
)
from newton_qd.qd.run.interrupt import INTERRUPTED, graceful_stop

if TYPE_CHECKING:
    from newton_qd.qd.run.evolution import EvolveResult
    from newton_qd.qd.scoring.task import Task

_DEFAULTS = EvolveConfig()


def add_parser(commands: Commands) -> None:
    """Adds the command to the subparsers of ``newton-qd``."""
    parser = commands.add_parser(
        "evolve",
        help="run a Quality-Diversity algorithm on an environment",
        description="Evolves an archive of policies and writes a results folder: "
        "archive.npz, archive.png, metrics.csv, corrected.json, config.json and a "
        "checkpoint.",
    )
    parser.set_defaults(run=run)
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
    parser.add_argument(
        "--start-from",
        type=Path,
        metavar="DIR",
        help="start from the elites of another results folder, not a random population",
    )
    parser.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="read settings from a TOML file, or from config.json of an earlier run",
    )
    parser.add_argument(
        "--checkpoint-seconds",
        type=float,
        default=5.0,
        metavar="S",
        help="minimum time between two checkpoints [s] (default: 5)",
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
    parser.add_argument("--quiet", action="store_true", help="show no progress")


def _add_setting_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("settings that determine the result")
    for name, kind, text in (
        ("seed", int, "seed of all random numbers"),
        ("iterations", int, "generations after the initial population"),
        ("batch_size", int, "individuals evaluated in one generation"),
        ("episode_length", int, "control steps of one evaluation"),
        ("iso_sigma", float, "standard deviation of the isotropic variation"),
        ("line_sigma", float, "standard deviation of the step to a second parent"),
        ("reevaluations", int, "evaluations of each elite at the end; 0: none"),
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
        "repeated; 'newton-qd algorithms NAME' lists them",
    )
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


_UNNAMED = message("ENV", None, "the name of an environment, as in evolve ant_uni")


def _option(text: str) -> tuple[str, Any]:
    name, separator, value = text.partition("=")
    try:
        if name and separator:
            return name, ast.literal_eval(value)
    except (SyntaxError, ValueError):
        pass
    raise argparse.ArgumentTypeError(
        f"got {text!r}; allowed: a name and a value like discount=0.95"
    )


def _grid(text: str) -> tuple[int, ...]:
    return integers(text, "x")


def run(
    arguments: argparse.Namespace,
    task_factory: Callable[[EvolveConfig], Task] | None,
) -> int:
    """Starts or resumes a run, and returns the exit code.

    Raises:
        ConfigError: A setting is missing or not allowed.
        KeyboardInterrupt: A signal arrived during the imports.
    """
    config, out = _settle(arguments)
    seconds = arguments.checkpoint_seconds
    checks.number(
        "checkpoint_seconds", seconds, least=0, endless=True, error=ConfigError
    )
    # These imports load JAX and the physics. They come after the argument checks, so
    # that argument errors are fast. The signal is delayed until the imports end,
    # because an exception during the import of an extension module can crash Python.
    with graceful_stop(b"\nstopping\n") as stop:
        from newton_qd.physics.precision import quiet
        from newton_qd.qd.run.evolution import evolve
        from newton_qd.qd.run.search import SearchError
        from newton_qd.qd.scoring.task import make_task
    if stop.requested:
        raise KeyboardInterrupt
    quiet()
    try:
        result = evolve(
            config,
            out=out,
            resume=arguments.resume,
            start_from=arguments.start_from,
            progress=not arguments.quiet,
            tensorboard=arguments.tensorboard,
            checkpoint_seconds=arguments.checkpoint_seconds,
            devices=arguments.devices,
            task_factory=make_task if task_factory is None else task_factory,
        )
    except SearchError as error:
        return complain(arguments, error, FAILED)
    _report(result, out)
    return INTERRUPTED if result.interrupted else OK


def _settle(arguments: argparse.Namespace) -> tuple[EvolveConfig, Path]:
    """Combines the settings of the arguments, the config file and the run to resume.

    Raises:
        ConfigError: No environment is named, or a setting is not allowed.
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
    out = arguments.out
    if out is None:
        named = (base or _DEFAULTS).replace(**given)
        if base is None and "env_name" not in given:
            raise ConfigError(_UNNAMED)
        out = Path("results") / f"{named.env_name}-seed{named.seed}"
    folder = RunFolder(out)
    folder.check(resume=arguments.resume)
    if base is None and arguments.resume and folder.has_config:
        base = read_config(out / CONFIG)[0]
    if base is None and "env_name" not in given:
        raise ConfigError(_UNNAMED)
    base = base or _DEFAULTS
    # A grid replaces centroids of the config, and centroids replace its grid.
    if "grid" in given:
        base = base.replace(centroids=None)
    if "centroids" in given:
        base = base.replace(grid=None)
    if "options" in given:
        given["options"] = {**dict(base.options), **dict(given["options"])}
    return base.replace(**given), out


def _report(result: EvolveResult, out: Path) -> None:
    """Prints the results of the run. After an interrupt, prints how to resume it."""
    config = result.config
    if result.iteration >= 0:
        first, last = (
            {name: values[index] for name, values in result.metrics.items()}
            for index in (0, -1)
        )
        print(
            f"{config.env_name}: {last['evaluations']:,.0f} evaluations in "
            f"{result.iteration} generations; this call took {result.seconds:.0f} s"
        )
        print(
            f"QD score {first['qd_score']:,.0f} -> {last['qd_score']:,.0f}, "
            f"coverage {first['coverage']:.1f} -> {last['coverage']:.1f} %, "
            f"best fitness {first['max_fitness']:.1f} -> {last['max_fitness']:.1f}"
        )
        if (again := result.reevaluated) is not None:
            print(
                f"reevaluated ({again.reevaluations} evaluations of each elite): "
                f"QD score {again.qd_score:,.0f}, coverage {again.coverage:.1f} %, "
                f"best fitness {again.max_fitness:.1f}"
            )
        print(f"results in {out}")
    if result.interrupted:
        when = "before the initial population"
        if result.iteration >= 0:
            when = (
                f"after generation {result.iteration} of {config.iterations}, "
                "everything up to it is saved"
            )
        print(
            f"interrupted {when}; continue with:\n"
            f"  newton-qd evolve --resume --out {shlex.quote(str(out))}"
        )
