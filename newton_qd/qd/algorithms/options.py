"""Options of algorithms: how a run's ``options`` become the fields of a dataclass.

Nothing here imports JAX, so that the command line can list the options at once.
"""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import re
import types
import typing
from collections.abc import Iterator
from typing import Any, TypeVar

from newton_qd import checks
from newton_qd.checks import listed, message
from newton_qd.qd.config import (
    ConfigError,
    EvolveConfig,
    check_integer,
    check_integers,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Options of an algorithm; this class has none.

    A subclass is a frozen dataclass whose docstring describes each field under
    ``Attributes:``. Fields are numbers, booleans or tuples of integers; a field whose
    default is ``None`` follows from the settings of the run.
    """

    def check(self) -> None:
        """Refuses values that do not fit together.

        Raises:
            ValueError: A value is out of its range.
        """


OptionsT = TypeVar("OptionsT", bound=Options)


@contextlib.contextmanager
def refused_options() -> Iterator[None]:
    """Turns a refused value into the error of a refused option.

    Raises:
        ConfigError: A value was refused.
    """
    try:
        yield
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"options: {error}") from error


def read_options(
    kind: type[OptionsT], config: EvolveConfig, *, least: int = 0, **defaults: Any
) -> OptionsT:
    """Makes the options of an algorithm from those of a run.

    Args:
        kind: Dataclass of the options.
        config: Settings of the run.
        least: Least value of an option that is an integer.
        **defaults: Defaults that differ from those of the dataclass.

    Raises:
        ConfigError: There is no option of this name, or its value has the wrong type
            than the field, not finite, negative, less than ``least`` or refused by
            the dataclass.
    """
    hints = typing.get_type_hints(kind)
    allowed = {field.name for field in dataclasses.fields(kind)}
    for name, value in config.options:
        if name not in allowed:
            why = f"which {config.algorithm!r} does not have"
            known = listed(sorted(allowed))
            raise ConfigError(message("options", name, known, why=why))
        defaults[name] = _fitting(name, value, _without_none(hints[name]), least)
    with refused_options():
        options = kind(**defaults)
        options.check()
    return options


def _without_none(hint: Any) -> Any:
    """The type in a union of it with ``None``; a user gives no ``None``."""
    if typing.get_origin(hint) not in (typing.Union, types.UnionType):
        return hint
    (only,) = (part for part in typing.get_args(hint) if part is not types.NoneType)
    return only


def _fitting(name: str, value: Any, wanted: Any, least: int) -> Any:
    """Returns the value of an option in the type of its field.

    Raises:
        ConfigError: It has the wrong type, or out of its range.
        TypeError: The dataclass has a field of a type that no option can have.
    """
    name = f"options: {name}"
    if wanted is float:
        checks.number(name, value, least=0, error=ConfigError)
        return float(value)
    if wanted is int:
        check_integer(name, value, least)
    elif wanted is bool:
        checks.instance(name, value, bool, "true or false", error=ConfigError)
    elif typing.get_origin(wanted) is tuple:
        check_integers(name, value)
    else:
        raise TypeError(f"{name}: a setting of type {wanted} cannot be an option")
    return value


def option_texts(
    kind: type[Options], *, own: bool = False
) -> list[tuple[str, str, str]]:
    """Lists the texts ``(name, default, meaning)`` of options, for help and documents.

    Args:
        kind: Dataclass of the options, documented as ``Options`` says.
        own: Whether to leave out those that it inherits; if not, they come last.

    Returns:
        A row for each option; a default that follows from the run is empty.
    """
    fields = {field.name: field.default for field in dataclasses.fields(kind)}
    names: dict[str, None] = {}
    for base in (kind,) if own else kind.__mro__:
        names |= dict.fromkeys(inspect.get_annotations(base))
    meanings: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        meanings |= _attributes(base)
    return [(name, _text(fields[name]), meanings.get(name, "")) for name in names]


def _attributes(kind: type) -> dict[str, str]:
    """Meanings of the attributes that the docstring of a class itself describes."""
    text = inspect.cleandoc(vars(kind).get("__doc__") or "")
    section = text.partition("\nAttributes:\n")[2]
    rows = re.findall(r"^    (\w+): (.*(?:\n {8,}.*)*)", section, flags=re.MULTILINE)
    return {name: " ".join(meaning.split()) for name, meaning in rows}


def _text(default: Any) -> str:
    """Writes a default as a user would."""
    if default is None:
        return ""
    return str(list(default)) if isinstance(default, tuple) else str(default)
