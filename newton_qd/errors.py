"""The errors that the package defines; all derive from built-in ones."""

from __future__ import annotations

import importlib.util
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
