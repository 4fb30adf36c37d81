"""``--module``: imports modules of the user, which register what the command uses."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

from newton_qd.checks import message
from newton_qd.qd.config import ConfigError


def add_argument(parser: argparse.ArgumentParser) -> None:
    """Adds the argument ``--module``."""
    parser.add_argument(
        "--module",
        dest="modules",
        action="append",
        default=[],
        metavar="NAME",
        help="import a module of yours first, which calls newton_qd.register or "
        "newton_qd.qd.register_algorithm; a name as in Python, or a file like "
        "tasks.py; may be repeated",
    )


def import_modules(names: Sequence[str]) -> None:
    """Imports modules from the present folder or from Python's path.

    Args:
        names: Dotted names, or paths of files that end with ``.py``.

    Raises:
        ConfigError: A module cannot be found, or its import fails.
    """
    if names and (folder := os.getcwd()) not in sys.path:
        sys.path.insert(0, folder)  # as python -m does
    for name in names:
        try:
            _import(name)
        except ConfigError:
            raise
        except SystemExit as error:  # a script, whose exit code is not that of ours
            why = f"whose import ends the program with code {error.code!r}"
            allowed = "a module that only registers when it is imported"
            raise ConfigError(message("--module", name, allowed, why=why)) from error
        except Exception as error:
            traceback.print_exc()
            kind = type(error).__name__
            why = f"whose import fails with {kind}: {error}"
            allowed = "a module that can be imported"
            raise ConfigError(message("--module", name, allowed, why=why)) from error


def _import(name: str) -> None:
    """Imports one module.

    Raises:
        ConfigError: It cannot be found, or has the name of a module of Python.
        ModuleNotFoundError: A module that it imports cannot be found.
    """
    path = Path(name)
    if path.suffix == ".py" and path.is_file():
        if path.stem in sys.stdlib_module_names:
            why = f"which has the name of Python's own module {path.stem}"
            allowed = "a file with a name of its own, like tasks.py"
            raise ConfigError(message("--module", name, allowed, why=why))
        spec = importlib.util.spec_from_file_location(path.stem, path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[path.stem] = module
        try:
            spec.loader.exec_module(module)
        except BaseException:  # as Python's import does
            sys.modules.pop(path.stem, None)
            raise
        return
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise  # a module that it imports is missing
        why = "which cannot be found"
        allowed = "a module on Python's path or in this folder, or a file like tasks.py"
        raise ConfigError(message("--module", name, allowed, why=why)) from error
