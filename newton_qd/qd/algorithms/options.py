"""Options of algorithms: converts the ``options`` of a run to a dataclass.

This module does not import JAX, so that the command line lists options quickly.
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
from newton_qd.checks import Fact, listed, message
from newton_qd.qd.config import (
    ConfigError,
    EvolveConfig,
    check_integer,
    check_integers,
)

_MOST = 2**31 - 1  # JAX counts in 32 bits


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Options of an algorithm; the base class has no options.

    A subclass is a frozen dataclass. Its docstring describes each field under
    ``Attributes:``. Fields are numbers, booleans or tuples of integers; a user gives
    none below 0. A default of ``None`` means that the value follows from the settings
    of the run.
    """

    def check(self) -> None:
        """Checks that the values fit together.

        Raises:
            ValueError: A value is out of its range.
        """


OptionsT = TypeVar("OptionsT", bound=Options)
_DefaultT = TypeVar("_DefaultT")
_SWITCH = "switch"


def only_with(switch: str, default: _DefaultT) -> _DefaultT:
    """Returns the field of an option that has an effect only with another option.

    Args:
        switch: Name of the other option; with 0 or ``False``, this one has no effect.
        default: Default of the option.
    """
    return dataclasses.field(default=default, metadata={_SWITCH: switch})


@contextlib.contextmanager
def refused_options() -> Iterator[None]:
    """Converts the error about a value to an error about an option.

    Raises:
        ConfigError: A value is wrong.
    """
    try:
        yield
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"options: {error}") from error


def read_options(
    kind: type[OptionsT], config: EvolveConfig, *, least: int = 0, **defaults: object
) -> OptionsT:
    """Makes the options of an algorithm from those of a run.

    Args:
        kind: Dataclass of the options.
        config: Settings of the run.
        least: Smallest value of an integer option.
        **defaults: Defaults that differ from those of the dataclass.

    Raises:
        ConfigError: An option does not exist, or its value has the wrong type, is not
            finite, is negative, is less than ``least``, has more than 32 bits, or fails
            a check of the dataclass.
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


def check_effect(options: Options, config: EvolveConfig) -> None:
    """Checks that options that a user gave have an effect.

    Args:
        options: Options of the algorithm.
        config: Settings of the run from which they were made.

    Raises:
        ConfigError: The option that one of them needs is off.
    """
    given = {name for name, _ in config.options}
    for field in dataclasses.fields(options):
        switch = field.metadata.get(_SWITCH)
        if switch is None or field.name not in given or getattr(options, switch):
            continue
        off = getattr(options, switch)
        allowed = f"no value, or another {switch}"
        why = f"which has no effect with {switch} = {off}"
        value = getattr(options, field.name)
        raise ConfigError(message(f"options: {field.name}", value, allowed, why=why))


def check_fields(kind: type[Options]) -> None:
    """Checks a user's options, and the types of their fields.

    Raises:
        TypeError: They are no dataclass, or a field cannot be an option.
    """
    if not isinstance(kind, type) or not dataclasses.is_dataclass(kind):
        allowed = "a dataclass that is derived from newton_qd.qd.Options"
        raise TypeError(message("spec.options", kind, allowed))
    hints = typing.get_type_hints(kind)
    for name in [field.name for field in dataclasses.fields(kind)]:
        hint = hints[name]
        parts = _parts(hint)
        wanted = parts[0] if len(parts) == 1 else hint
        if wanted not in (float, int, bool) and wanted != tuple[int, ...]:
            allowed = "float, int, bool or tuple[int, ...], each perhaps with None"
            given = Fact(f"a field of type {hint}")
            raise TypeError(message(f"options: {name}", given, allowed))


def _parts(hint: Any) -> list[Any]:
    """Returns the types in a union, without ``None``; a user never gives ``None``."""
    if typing.get_origin(hint) not in (typing.Union, types.UnionType):
        return [hint]
    return [part for part in typing.get_args(hint) if part is not types.NoneType]


def _without_none(hint: Any) -> Any:
    """Returns the type in a union with ``None``."""
    (only,) = _parts(hint)
    return only


def _fitting(name: str, value: Any, wanted: Any, least: int) -> Any:
    """Converts the value of an option to the type of its field.

    Raises:
        ConfigError: It has the wrong type, or is out of its range.
        TypeError: The type of a field is not allowed for options.
    """
    name = f"options: {name}"
    if wanted is float:
        checks.number(name, value, least=0, error=ConfigError)
        return float(value)
    if wanted is int:
        check_integer(name, value, least, _MOST)
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
    """Lists texts ``(name, default, meaning)`` of options, for help and documentation.

    Args:
        kind: Dataclass of the options, with a docstring as in ``Options``.
        own: Whether to omit inherited options. If not, they are at the end.

    Returns:
        A row for each option. A default that follows from the run is empty.
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
    """Returns the meaning of each attribute in the docstring of a class."""
    text = inspect.cleandoc(vars(kind).get("__doc__") or "")
    section = text.partition("\nAttributes:\n")[2]
    rows = re.findall(r"^    (\w+): (.*(?:\n {8,}.*)*)", section, flags=re.MULTILINE)
    return {name: " ".join(meaning.split()) for name, meaning in rows}


def _text(default: Any) -> str:
    """Returns the text of a default as a user would write it."""
    if default is None:
        return ""
    return str(list(default)) if isinstance(default, tuple) else str(default)
