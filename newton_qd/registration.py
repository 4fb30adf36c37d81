"""What ``newton_qd.register`` takes: names, bases and wrappers."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

from newton_qd import checks, tasks
from newton_qd.checks import listed, message, shown
from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.tasks import WrapperSpec

ENVIRONMENT = "a subclass of newton_qd's Env, or a function that makes an environment"
"""What a base may be."""


def check_names(env_name: object, base_name: object, replace: bool) -> None:
    """Checks the names of ``register``.

    Raises:
        TypeError: ``replace`` is not True or False.
        ValueError: A name is not text, is empty, is in use, or has characters that are
            not allowed.
    """
    # A results folder has the name of the environment, so it must not be a path.
    checks.identifier("env_name", env_name)
    checks.flag("replace", replace)
    if env_name in (tasks.SUITE if replace else tasks.ENVIRONMENTS):
        allowed = "a new name, or replace=True"
        if env_name in tasks.SUITE:
            allowed = f"any name but {listed(sorted(tasks.SUITE))}"
        raise ValueError(message("env_name", env_name, allowed, why="which is taken"))
    # Every table reads every spec, so one wrong spec would break all tables.
    checks.identifier("base_name", base_name, optional=True)


def check_class(base: Callable[..., Env]) -> None:
    """Checks that a class is one of environments.

    Raises:
        TypeError: It is not.
    """
    kind: object = base
    while isinstance(kind, functools.partial):
        kind = kind.func
    if isinstance(kind, type) and not issubclass(kind, Env):
        raise TypeError(message("base", base, ENVIRONMENT))


def check_made(base: Callable[..., Env], options: Mapping[str, Any]) -> None:
    """Checks that a function makes an environment, if it needs no other arguments.

    Raises:
        TypeError: It does not.
    """
    if isinstance(base, type):
        return
    try:
        inspect.signature(base).bind(**options)
    except TypeError:  # arguments are missing, which ``create`` may give
        return
    made = base(**options)
    if not isinstance(made, Env):
        why = f"which makes {shown(made)}"
        raise TypeError(message("base", base, ENVIRONMENT, why=why))


def descriptor_specs(
    descriptor: WrapperSpec | Callable[..., Env] | None,
) -> tuple[WrapperSpec, ...]:
    """Returns the descriptor wrapper, if there is one.

    Raises:
        TypeError: It is not a wrapper.
    """
    if descriptor is None:
        return ()
    if not isinstance(descriptor, WrapperSpec):
        allowed = "None, a class such as FeetContactWrapper, or a WrapperSpec of one"
        checks.function("descriptor", descriptor, allowed)
        _refuse_robot("descriptor", descriptor)
        descriptor = WrapperSpec(descriptor)
    _check_wrapper("descriptor", descriptor)
    return (descriptor,)


def check_extractor_arguments(extractor: object) -> None:
    """Checks that a descriptor extractor is a function of transitions and a mask.

    Raises:
        TypeError: It cannot be called, or does not take two arguments.
    """
    name = "descriptor_extractor"
    allowed = "a function of (data, mask); in a class, staticmethod(function)"
    checks.function(name, extractor, allowed, optional=True)
    if extractor is None:
        return
    try:
        inspect.signature(cast(Callable[..., object], extractor)).bind(None, None)
    except TypeError as error:
        raise TypeError(message(name, extractor, allowed, why=str(error))) from None
    except ValueError:  # Python cannot read the arguments of some compiled functions
        return


def _refuse_robot(name: str, wrapper: object) -> None:
    """Checks that a wrapper is no class of robots.

    Raises:
        TypeError: It is one.
    """
    if isinstance(wrapper, type) and issubclass(wrapper, PhysicsEnv):
        raise TypeError(message(name, wrapper, "wrappers, such as FeetContactWrapper"))


def takes_robot(base: Callable[..., Env]) -> bool:
    """Returns whether ``base`` has an argument ``robot``."""
    return "robot" in inspect.signature(base).parameters


def takes_any(base: Callable[..., Env]) -> bool:
    """Returns whether ``base`` takes every keyword argument, as ``**options``."""
    parameters = inspect.signature(base).parameters.values()
    return any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)


def needs_robot(base: Callable[..., Env]) -> bool:
    """Returns whether ``base`` has an argument ``robot`` without a value."""
    parameter = inspect.signature(base).parameters.get("robot")
    return parameter is not None and parameter.default is parameter.empty


def check_wrappers(wrappers: object) -> None:
    """Checks the ``wrappers`` of ``register``.

    Raises:
        TypeError: They are not a sequence of ``WrapperSpec``, one is a class of robots,
            or a wrapper does not take one of its options.
    """
    if not isinstance(wrappers, Sequence) or isinstance(wrappers, str):
        allowed = "a tuple or list of WrapperSpec, such as "
        allowed += "(WrapperSpec(FeetContactWrapper),)"
        raise TypeError(message("wrappers", wrappers, allowed))
    for index, spec in enumerate(wrappers):
        allowed = "a WrapperSpec, such as WrapperSpec(FeetContactWrapper)"
        checks.instance(f"wrappers[{index}]", spec, WrapperSpec, allowed)
        _check_wrapper(f"wrappers[{index}]", spec)


def _check_wrapper(name: str, spec: WrapperSpec) -> None:
    """Checks a wrapper and its options.

    Raises:
        TypeError: It is a class of robots, or does not take one of its options.
    """
    checks.function(f"{name}.wrapper", spec.wrapper, "a class or a function")
    _refuse_robot(f"{name}.wrapper", spec.wrapper)
    allowed = "a mapping of keyword arguments"
    checks.instance(f"{name}.options", spec.options, Mapping, allowed)
    spec.check_options(f"{name}.options", spec.options)
