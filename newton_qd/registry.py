"""Environments by name: what builds them, and tables of what their rows say."""

from __future__ import annotations

import functools
import inspect
import math
import numbers
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Generic, TypeVar

from newton_qd.envs.base import Env
from newton_qd.envs.options import check_flag
from newton_qd.errors import UnknownEnvironment
from newton_qd.robots import Material, Robot
from newton_qd.tasks import ROWS as _ROWS
from newton_qd.tasks import EnvironmentRow, Extractor, WrapperRow
from newton_qd.wrappers import (
    AutoResetWrapper,
    CompletedEvalWrapper,
    EpisodeWrapper,
    EvalWrapper,
    FixedInitialStateWrapper,
    VectorWrapper,
)

Value = TypeVar("Value")


class _Column(Mapping[str, Value], Generic[Value]):
    """Read-only table of one attribute of the rows that have it."""

    def __init__(self, attribute: str) -> None:
        self._attribute = attribute

    def __getitem__(self, env_name: str) -> Value:
        for name, value in self._items():
            if name == env_name:
                return value
        raise KeyError(
            f"{env_name!r} has no {self._attribute}; known: {', '.join(self)}"
        )

    def __iter__(self) -> Iterator[str]:
        return iter(dict(self._items()))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __repr__(self) -> str:
        return repr(dict(self))

    def _items(self) -> Iterator[tuple[str, Value]]:
        for name, row in self._rows():
            value = getattr(row, self._attribute)
            if value is not None:
                yield name, value

    def _rows(self) -> Iterator[tuple[str, EnvironmentRow]]:
        yield from _ROWS.items()


class _BaseColumn(_Column[Value]):
    """Read-only table of one attribute by the name that the wrappers receive."""

    def _rows(self) -> Iterator[tuple[str, EnvironmentRow]]:
        for row in _ROWS.values():
            yield row.base_name, row


descriptor_extractor: Mapping[str, Extractor] = _Column("descriptor_extractor")
behavior_descriptor_extractor: Mapping[str, Extractor] = descriptor_extractor
reward_offset: Mapping[str, float] = _Column("reward_offset")
original_reward_offset: Mapping[str, float] = _Column("original_reward_offset")
FEET_NAMES: Mapping[str, tuple[str, ...]] = _BaseColumn("feet")
COG_NAMES: Mapping[str, str] = _BaseColumn("torso")
FORWARD_REWARD_NAMES: Mapping[str, str] = _BaseColumn("forward_reward")


def registered_envs() -> tuple[str, ...]:
    """Returns the names that ``create`` knows."""
    return tuple(_ROWS)


def register(
    env_name: str,
    base: Callable[..., Env],
    *,
    base_name: str | None = None,
    wrappers: Sequence[WrapperRow] = (),
    descriptor_extractor: Extractor | None = None,
    reward_offset: float | None = None,
    robot: Robot | None = None,
) -> None:
    """Adds an environment to the names that ``create`` knows.

    Args:
        env_name: A new name.
        base: Class or function that makes the environment without wrappers.
        base_name: Name that the wrappers receive; ``None``: ``env_name``.
        wrappers: Wrappers, from the inside to the outside.
        descriptor_extractor: Reads the descriptor of an episode, for QD tasks.
        reward_offset: Added to each step's reward to keep QD scores positive.
        robot: Row of the robot inside, for ``FEET_NAMES`` and ``COG_NAMES``; ``None``:
            that of the suite called ``base_name``, if there is one.

    Raises:
        TypeError: An argument is of another type.
        ValueError: The name is taken, a name is not a name, or ``reward_offset`` is
            not finite.
    """
    if not isinstance(env_name, str) or not env_name:
        raise ValueError(f"env_name={env_name!r}: allowed: a string that is not empty")
    if env_name in _ROWS:
        raise ValueError(
            f"env_name={env_name!r}: taken; allowed: any but {', '.join(_ROWS)}"
        )
    if not callable(base):
        raise TypeError(f"base={base!r}: allowed: a class or a function")
    # A row is read by every table: one that is wrong would break them all.
    if base_name is not None and (not isinstance(base_name, str) or not base_name):
        raise ValueError(
            f"base_name={base_name!r}: allowed: None, or a string that is not empty"
        )
    if descriptor_extractor is not None and not callable(descriptor_extractor):
        raise TypeError(
            f"descriptor_extractor={descriptor_extractor!r}: allowed: None, or a "
            "function of (data, mask)"
        )
    if robot is not None and not isinstance(robot, Robot):
        raise TypeError(f"robot={robot!r}: allowed: None, or a newton_qd.robots.Robot")
    _check_offset(reward_offset)
    _check_wrappers(wrappers)
    _ROWS[env_name] = EnvironmentRow(
        base,
        env_name if base_name is None else base_name,
        tuple(wrappers),
        descriptor_extractor,
        reward_offset,
        robot=robot,
    )


def _check_offset(reward_offset: object) -> None:
    """Raises for a ``reward_offset`` of ``register`` that is not a finite number."""
    allowed = "allowed: None, or a finite number"
    if reward_offset is None:
        return
    if not isinstance(reward_offset, numbers.Real) or isinstance(reward_offset, bool):
        raise TypeError(f"reward_offset={reward_offset!r}: {allowed}")
    if not math.isfinite(reward_offset):
        raise ValueError(f"reward_offset={reward_offset!r}: {allowed}")


def _check_wrappers(wrappers: object) -> None:
    """Raises for ``wrappers`` of ``register`` that are not rows of wrappers."""
    if not isinstance(wrappers, Sequence) or isinstance(wrappers, str):
        raise TypeError(
            f"wrappers={wrappers!r}: allowed: a tuple or list of WrapperRow, such as "
            "(WrapperRow(FeetContactWrapper),)"
        )
    for index, row in enumerate(wrappers):
        if not isinstance(row, WrapperRow):
            raise TypeError(
                f"wrappers[{index}]={row!r}: allowed: a WrapperRow, such as "
                "WrapperRow(FeetContactWrapper)"
            )
        if not callable(row.wrapper):
            raise TypeError(
                f"wrappers[{index}].wrapper={row.wrapper!r}: allowed: a class or a "
                "function"
            )
        if not isinstance(row.options, Mapping):
            raise TypeError(
                f"wrappers[{index}].options={row.options!r}: allowed: a mapping of "
                "keyword arguments"
            )


def create(
    env_name: str,
    episode_length: int | None = 1000,
    action_repeat: int = 1,
    auto_reset: bool = True,
    batch_size: int | None = None,
    eval_metrics: bool = False,
    fixed_init_state: bool = False,
    qdax_wrappers_kwargs: Sequence[Mapping[str, Any]] | None = None,
    material: Material | None = None,
    **kwargs: Any,
) -> Env:
    """Builds an environment by its name.

    Args:
        env_name: One of ``registered_envs()``.
        episode_length: Control steps of an episode; ``None``: no end.
        action_repeat: Control steps for each action.
        auto_reset: Whether a finished world returns to its first state.
        batch_size: Number of worlds of a reset; ``None`` or 0: one, without a
            batch axis.
        eval_metrics: Whether ``info`` sums the metrics of episodes.
        fixed_init_state: Whether a reset is free of noise.
        qdax_wrappers_kwargs: Keyword arguments for each of the environment's own
            wrappers, replacing those of the registry.
        material: Softness of contacts and limits; ``None``: that of the robot's row.
        **kwargs: To the environment inside, as ``dtype`` or ``ctrl_cost_weight``.

    Returns:
        The environment.

    Raises:
        UnknownEnvironment: ``env_name`` is not registered.
        TypeError: A keyword argument is unknown.
        ValueError: A value or a combination is not allowed.
    """
    row = _row(env_name)
    check_flag("auto_reset", auto_reset)
    check_flag("eval_metrics", eval_metrics)
    check_flag("fixed_init_state", fixed_init_state)
    options = _wrapper_options(env_name, row, qdax_wrappers_kwargs)
    if episode_length is None and (action_repeat != 1 or eval_metrics):
        raise ValueError(
            f"episode_length=None with action_repeat={action_repeat!r}, eval_metrics="
            f"{eval_metrics!r}; allowed: 1 and False, or an episode length"
        )
    env = _base(env_name, row, material, kwargs)
    if fixed_init_state:
        env = FixedInitialStateWrapper(env, row.base_name)
    for wrapper_row, chosen in zip(row.wrappers, options, strict=True):
        env = wrapper_row.wrapper(env, row.base_name, **chosen)
    if episode_length is not None:
        env = EpisodeWrapper(env, episode_length, action_repeat)
    if batch_size:
        env = VectorWrapper(env, batch_size)
    if auto_reset:
        env = AutoResetWrapper(env)
    if eval_metrics:
        env = CompletedEvalWrapper(EvalWrapper(env))
    return env


def create_fn(env_name: str, **kwargs: Any) -> Callable[..., Env]:
    """Returns ``create`` with its arguments filled in; nothing is built yet."""
    return functools.partial(create, env_name, **kwargs)


def _row(env_name: str) -> EnvironmentRow:
    """Returns the row of an environment; raises where there is none."""
    row = _ROWS.get(env_name) if isinstance(env_name, str) else None
    if row is None:
        raise UnknownEnvironment(env_name, registered_envs())
    return row


def _base(
    env_name: str,
    row: EnvironmentRow,
    material: Material | None,
    options: Mapping[str, Any],
) -> Env:
    """Returns the environment inside all wrappers."""
    if material is not None and not isinstance(material, Material):
        raise TypeError(
            f"material={material!r}: allowed: None, newton_qd.robots.Material"
        )
    _require_keywords(env_name, row.base, options)
    env = row.base(**options)
    return env if material is None else env.with_material(material)


def _require_keywords(
    env_name: str, base: Callable[..., Env], given: Mapping[str, Any]
) -> None:
    """Raises for keyword arguments that the environment inside does not take."""
    parameters = inspect.signature(base).parameters.values()
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        return
    allowed = [p.name for p in parameters if p.kind is not p.POSITIONAL_ONLY]
    for name in given:
        if name not in allowed:
            raise TypeError(
                f"{name}={given[name]!r}: not an argument of {env_name!r}; allowed: "
                f"those of create, and {', '.join(allowed) or 'no other'}"
            )


def _wrapper_options(
    env_name: str,
    row: EnvironmentRow,
    given: Sequence[Mapping[str, Any]] | None,
) -> list[Mapping[str, Any]]:
    """Returns the keyword arguments of each wrapper of a row."""
    if given is None:
        return [wrapper_row.options for wrapper_row in row.wrappers]
    if isinstance(given, Mapping) or not all(isinstance(x, Mapping) for x in given):
        raise TypeError(
            f"qdax_wrappers_kwargs={given!r}: allowed: None, or a sequence of "
            "dictionaries, one for each wrapper"
        )
    if len(given) != len(row.wrappers):
        names = ", ".join(
            getattr(wrapper_row.wrapper, "__name__", repr(wrapper_row.wrapper))
            for wrapper_row in row.wrappers
        )
        raise ValueError(
            f"qdax_wrappers_kwargs has {len(given)} entries; allowed: None, or "
            f"{len(row.wrappers)} for {env_name!r} ({names or 'no wrapper'})"
        )
    return list(given)
