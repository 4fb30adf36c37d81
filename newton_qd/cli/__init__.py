"""The command ``newton-qd``: environments, evolution, runs, the gradient doctor."""

from __future__ import annotations

import argparse
import atexit
import gc
import io
import os
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from newton_qd.cli import algorithms, doctor, envs, evolve, runs, viewing
from newton_qd.cli.arguments import BAD_ARGUMENTS, FAILED, OK, abandon, complain
from newton_qd.cli.modules import import_modules
from newton_qd.cli.version import ShowVersion
from newton_qd.errors import FaultError, MissingExtra, UnknownEnvironment
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.run.archive import ArchiveError
from newton_qd.qd.run.checkpoint import CheckpointError
from newton_qd.qd.run.interrupt import INTERRUPTED

if TYPE_CHECKING:
    from newton_qd.qd.scoring.task import Task

__all__ = ["BAD_ARGUMENTS", "FAILED", "INTERRUPTED", "OK", "main"]

_WITH_TASKS = ("evolve", "eval", "plot", "replay", "explore", "render")
"""Commands that make the task of a run."""


def main(
    argv: Sequence[str] | None = None,
    *,
    task_factory: Callable[[EvolveConfig], Task] | None = None,
) -> int:
    """Runs the command line.

    Args:
        argv: Arguments without the name of the program. ``None``: the arguments of the
            process.
        task_factory: Function that creates the task of a run. ``None``: the task
            of a registered environment.

    Returns:
        Exit code: 0 success, 1 failure, 2 wrong arguments, 130 interrupted with all
        results saved.
    """
    parser = argparse.ArgumentParser(
        prog="newton-qd", description="Quality-Diversity with differentiable physics."
    )
    parser.add_argument(
        "--version",
        action=ShowVersion,
        help="show the versions of newton_qd and of what results depend on",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in (envs, algorithms, evolve, doctor):
        command.add_parser(commands)
    runs.add_parsers(commands)
    viewing.add_parsers(commands)
    _repair_streams()
    # Python would look through all objects of JAX and Warp before it ends
    atexit.register(gc.freeze)
    code = OK
    try:
        arguments = _parsed(parser, argv)
        code = _run(arguments, task_factory)
        sys.stdout.flush()
    except BrokenPipeError:  # as in: newton-qd envs | head
        pass
    except OSError as error:  # as in: newton-qd envs > /dev/full
        print(f"newton-qd: error: output: {error}", file=sys.stderr)
        code = FAILED
    finally:
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except OSError:
                abandon(stream)
    return code


def _parsed(
    parser: argparse.ArgumentParser, argv: Sequence[str] | None
) -> argparse.Namespace:
    """Parses the arguments.

    Raises:
        OSError: The output does not take the help.
        SystemExit: They are wrong, or help is wanted.
    """
    try:
        return parser.parse_args(argv)
    except SystemExit:
        sys.stdout.flush()
        raise


def _repair_streams() -> None:
    """Makes output possible that is closed or has few characters.

    Python has no stream in the place of one that is closed (``newton-qd envs >&-``).
    A name of a file may have a character that a terminal does not.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _run(
    arguments: argparse.Namespace,
    task_factory: Callable[[EvolveConfig], Task] | None,
) -> int:
    """Runs a command and returns its exit code.

    Raises:
        BrokenPipeError: Nobody reads the output any more.
    """
    try:
        import_modules(arguments.modules)
        if arguments.command in _WITH_TASKS:
            return arguments.run(arguments, task_factory)
        return arguments.run(arguments)
    except UnknownEnvironment as error:
        hint = " If a module of yours registers it, add --module NAME."
        return complain(arguments, f"{error}{hint}", BAD_ARGUMENTS)
    except ConfigError as error:
        return complain(arguments, error, BAD_ARGUMENTS)
    except BrokenPipeError:
        raise
    except (ArchiveError, CheckpointError, FaultError, MissingExtra, OSError) as error:
        return complain(arguments, error, FAILED)
    except KeyboardInterrupt:
        return complain(arguments, "interrupted", INTERRUPTED)
