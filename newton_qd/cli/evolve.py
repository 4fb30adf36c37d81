"""``newton-qd evolve``: runs a Quality-Diversity algorithm on an environment."""

from __future__ import annotations

import argparse
import contextlib
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from newton_qd import checks
from newton_qd.cli.algorithms import details
from newton_qd.cli.arguments import FAILED, OK, Commands, complain, say
from newton_qd.cli.evolve_arguments import add_arguments, settle
from newton_qd.qd.algorithms import algorithm_named
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.run.folder import RunFolder
from newton_qd.qd.run.interrupt import INTERRUPTED, graceful_stop

if TYPE_CHECKING:
    from newton_qd.qd.run.evolve_result import EvolveResult
    from newton_qd.qd.scoring.task import Task


def add_parser(commands: Commands) -> None:
    """Adds the command to the subparsers of ``newton-qd``."""
    add_arguments(commands, run)


def run(
    arguments: argparse.Namespace,
    task_factory: Callable[[EvolveConfig], Task] | None,
) -> int:
    """Starts or resumes a run, and returns the exit code.

    Raises:
        ConfigError: A setting is missing or not allowed.
        KeyboardInterrupt: A signal arrived during the imports.
    """
    if arguments.help:
        return _help(arguments)
    config, out = settle(arguments)
    seconds = arguments.checkpoint_seconds
    checks.number(
        "checkpoint_seconds", seconds, least=0, endless=True, error=ConfigError
    )
    algorithm = algorithm_named(config.algorithm)
    algorithm.read_options(config)
    if not arguments.resume:
        algorithm.check_effect(config)
    if arguments.device == "cpu" and "jax" not in sys.modules:
        os.environ["JAX_PLATFORMS"] = "cpu"  # so that JAX reserves no GPU memory
    if arguments.device is arguments.devices is None:  # else they are checked first
        folder = RunFolder(out)
        folder.check(resume=arguments.resume)
        folder.compare_environment(config.env_name)
    # These imports load JAX and the physics. They come after the argument checks, so
    # that argument errors are fast. The signal is delayed until the imports end,
    # because an exception during the import of an extension module can crash Python.
    with graceful_stop(b"\nstopping\n") as stop:
        from newton_qd.qd.run.evolution import evolve
        from newton_qd.qd.run.search import SearchError
        from newton_qd.qd.scoring.task import make_task
    if stop.requested:
        raise KeyboardInterrupt
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
            device=arguments.device,
            task_factory=make_task if task_factory is None else task_factory,
        )
    except SearchError as error:
        return complain(arguments, error, FAILED)
    with contextlib.suppress(BrokenPipeError):  # the exit code says it too
        _report(result, out, arguments.modules)
    return INTERRUPTED if result.interrupted else OK


def _help(arguments: argparse.Namespace) -> int:
    """Prints the help, and the options of the algorithm if one is named.

    Raises:
        ConfigError: The algorithm does not exist.
    """
    print(arguments.parser.format_help().rstrip())
    if arguments.algorithm is not None:
        print()
        print("\n".join(details(algorithm_named(arguments.algorithm))))
        print("\nGive them as --option NAME=VALUE.")
    sys.stdout.flush()
    return arguments.parser.exit(OK)


def _report(result: EvolveResult, out: Path, modules: Sequence[str]) -> None:
    """Prints the results of the run. After an interrupt, prints how to resume it."""
    config = result.config
    own = "".join(f" --module {shlex.quote(name)}" for name in modules)
    if result.iteration >= 0:
        first, last = (
            {name: values[index] for name, values in result.metrics.items()}
            for index in (0, -1)
        )
        say(
            f"{config.env_name}: {last['evaluations']:,.0f} evaluations in "
            f"{result.iteration} generations; this call took {result.seconds:.0f} s"
        )
        say(
            f"QD score {first['qd_score']:,.0f} -> {last['qd_score']:,.0f}, "
            f"coverage {first['coverage']:.1f} -> {last['coverage']:.1f} %, "
            f"best fitness {first['max_fitness']:.1f} -> {last['max_fitness']:.1f}"
        )
        if (again := result.reevaluated) is not None:
            say(
                f"reevaluated ({again.reevaluations} evaluations of each elite): "
                f"QD score {again.qd_score:,.0f}, coverage {again.coverage:.1f} %, "
                f"best fitness {again.max_fitness:.1f}"
            )
        print(f"results in {out}")
        print(f"see them: newton-qd explore {_argument(out)}{own}")
    if result.interrupted:
        when = "before the initial population"
        if result.iteration >= 0:
            when = (
                f"after generation {result.iteration} of {config.iterations}, "
                "everything up to it is saved"
            )
        if result.iteration == config.iterations:
            when = "during the re-evaluation, the archive is saved"
        say(f"interrupted {when}; continue with:")
        print(f"  newton-qd evolve --resume --out {_argument(out)}{own}")


def _argument(folder: Path) -> str:
    """Returns a folder as an argument of a shell, which is never an option."""
    text = str(folder)
    return shlex.quote(f"./{text}" if text.startswith("-") else text)
