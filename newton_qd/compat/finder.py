"""Replaces modules of QDax by modules of this library."""

from __future__ import annotations

import contextlib
import importlib
import importlib.metadata
import sys
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec, spec_from_loader
from types import ModuleType
from typing import Any

from newton_qd.compat.contents import BRAX_V1, CONTENTS, Contents
from newton_qd.compat.mending import MENDED, MendingLoader
from newton_qd.errors import MissingExtra

SUPPORTED = ("0.5.0",)
"""Tested releases of QDax."""


class _Finder(MetaPathFinder, Loader):
    """Finds and fills the modules of ``CONTENTS``, and mends those of ``MENDED``.

    Attributes:
        contents: The modules that it fills: ``CONTENTS``, and ``BRAX_V1`` if brax v1 is
            not installed.
        kept: Whether it stays when ``installed`` ends.
        users: Blocks of ``installed`` that have not ended.
    """

    kept = False
    users = 0
    contents: Mapping[str, Contents] = CONTENTS

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None,
        target: ModuleType | None = None,
    ) -> ModuleSpec | None:
        if fullname in self.contents:
            package = any(name.startswith(f"{fullname}.") for name in self.contents)
            return spec_from_loader(fullname, self, is_package=package)
        if fullname not in MENDED:
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader = MendingLoader(spec)
        return spec

    def exec_module(self, module: ModuleType) -> None:
        for home, names in self.contents[module.__name__].items():
            source = importlib.import_module(home)
            for name in names:
                setattr(module, name, getattr(source, name))
        for name in self.contents:  # as the originals, which import their submodules
            if name.rpartition(".")[0] == module.__name__:
                importlib.import_module(name)


_FINDER = _Finder()
_CHANGING = threading.RLock()


def install() -> None:
    """Makes QDax import and run on the environments of this library.

    Call it before the first import of QDax. A second call has no effect.

    Raises:
        MissingExtra: QDax is not installed.
        ImportError: The installed release of QDax is not in ``SUPPORTED``, or it is
            already imported with its own environments.
    """
    with _CHANGING:
        _install()
        _FINDER.kept = True


def _install() -> None:
    """Installs, if it is not installed.

    Raises:
        MissingExtra: QDax is not installed.
        ImportError: As ``install``.
    """
    if _FINDER in sys.meta_path:
        return
    if find_spec("qdax") is None:
        raise MissingExtra("qdax", "qd")
    version = importlib.metadata.version("qdax")
    if version not in SUPPORTED:
        raise ImportError(
            f"qdax {version} is installed; newton_qd.compat knows "
            f"{', '.join(SUPPORTED)}: pip install 'qdax=={SUPPORTED[-1]}'"
        )
    imported = [name for name in CONTENTS if name in sys.modules]
    if imported:
        raise ImportError(
            f"{imported[0]} is imported already, from QDax itself; call "
            "newton_qd.compat.install() before importing QDax"
        )
    _restore_jax()  # first, so that a warning as an error leaves nothing half done
    _FINDER.contents = CONTENTS if _has_brax_v1() else {**CONTENTS, **BRAX_V1}
    sys.meta_path.insert(0, _FINDER)
    for name, mend in MENDED.items():
        if name in sys.modules:
            mend(sys.modules[name])


@contextlib.contextmanager
def installed() -> Iterator[None]:
    """Installs for a while: for modules of QDax that import its environments.

    Raises:
        MissingExtra: QDax is not installed.
        ImportError: The installed release of QDax is not in ``SUPPORTED``.
    """
    with _CHANGING:
        inside = _FINDER in sys.meta_path
        if not inside and any(name in sys.modules for name in CONTENTS):
            borrowed = False  # QDax has its own environments
        else:
            _install()
            borrowed = True
            _FINDER.kept = _FINDER.kept if inside else False
            _FINDER.users += 1
    try:
        yield
    finally:
        with _CHANGING:
            _FINDER.users -= borrowed
            if borrowed and not _FINDER.users and not _FINDER.kept:
                uninstall()


def uninstall() -> None:
    """Reverts ``install``; imported modules of QDax do not change."""
    with _CHANGING:
        if _FINDER not in sys.meta_path:
            return
        sys.meta_path.remove(_FINDER)
        for name in _FINDER.contents:
            module = sys.modules.pop(name, None)
            parent, _, child = name.rpartition(".")
            if module is not None and parent in sys.modules:
                vars(sys.modules[parent]).pop(child, None)


def _has_brax_v1() -> bool:
    return find_spec("brax") is not None and find_spec("brax.v1") is not None


def _restore_jax() -> None:
    """Makes TensorFlow Probability importable, which QDax's DADS needs."""
    from jax import core

    # TensorFlow Probability 0.25, the last release, registers a type under a name
    # that JAX has moved.
    with warnings.catch_warnings():
        # JAX has deprecated the new place too, but there is no other.
        warnings.simplefilter("ignore", DeprecationWarning)
        xla: Any = importlib.import_module("jax.interpreters.xla")
        if not hasattr(xla, "pytype_aval_mappings"):
            xla.pytype_aval_mappings = core.pytype_aval_mappings
