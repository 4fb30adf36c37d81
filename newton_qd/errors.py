"""The errors that the package defines, all from built-in ones, and its warnings."""

from __future__ import annotations

import importlib.util
import inspect
import warnings
from collections.abc import Sequence


class UnknownEnvironment(NotImplementedError):  # noqa: N818 - a name, not an event
    """No environment of this name is registered.

    Attributes:
        name: The unknown name.
        known: The registered names.
    """

    def __init__(self, name: object, known: Sequence[str]) -> None:
        super().__init__(name, tuple(known))
        self.name = name
        self.known = tuple(known)

    def __str__(self) -> str:
        return (
            f"This environment name does not exist! env_name is {self.name!r}; "
            f"known names: {', '.join(self.known)}. The module of an environment of "
            "your own must be imported first."
        )


class FaultError(FloatingPointError):
    """A world has a fault, or a value of its state is not finite."""


class MissingExtra(ImportError):  # noqa: N818 - likewise
    """An optional dependency is not installed.

    Attributes:
        package: Package that could not be imported.
        extra: Extra of ``newton_qd`` that installs it.
    """

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(package, extra)
        self.package = package
        self.extra = extra

    def __str__(self) -> str:
        return (
            f"This needs {self.package}, which is not installed. "
            f"Install it with: pip install 'newton_qd[{self.extra}]'"
        )


def require_extra(package: str, extra: str) -> None:
    """Checks that an optional dependency is installed.

    Args:
        package: Name of the module to import.
        extra: Extra of ``newton_qd`` that installs it.

    Raises:
        MissingExtra: It is not installed.
    """
    if importlib.util.find_spec(package) is None:
        raise MissingExtra(package, extra)


def warn(text: str, category: type[Warning] = UserWarning) -> None:
    """Warns at the line that called the package, however deep in it this function is.

    Args:
        text: The warning.
        category: Its class.
    """
    package, level = __name__.partition(".")[0], 1  # level 1 is this function
    frame = inspect.currentframe()
    while frame and frame.f_globals.get("__name__", "").partition(".")[0] == package:
        frame, level = frame.f_back, level + 1
    warnings.warn(text, category, stacklevel=level)
