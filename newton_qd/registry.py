"""The environments by name: one row each, and what builds them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Generic, TypeVar

from newton_qd.envs.ant import Ant
from newton_qd.envs.base import Env
from newton_qd.envs.humanoid import Humanoid
from newton_qd.errors import UnknownEnvironment
from newton_qd.extractors import get_feet_contact_proportion
from newton_qd.wrappers import (
    AutoResetWrapper,
    CompletedEvalWrapper,
    EpisodeWrapper,
    EvalWrapper,
    FeetContactWrapper,
    FixedInitialStateWrapper,
    VectorWrapper,
)

Extractor = Callable[[Any, Any], Any]
Value = TypeVar("Value")


@dataclasses.dataclass(frozen=True)
class WrapperRow:
    """A wrapper of an environment, called as ``wrapper(env, name, **options)``.

    Attributes:
        wrapper: Class or function.
        options: Keyword arguments, replaced by ``qdax_wrappers_kwargs``.
    """

    wrapper: Callable[..., Env]
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class EnvironmentRow:
    """Everything about an environment that has a name.

    Attributes:
        base: Makes the environment from the keyword arguments of ``create``.
        base_name: Name that wrappers receive.
        wrappers: From the inside to the outside.
        descriptor_extractor: Reads the descriptor of an episode, for QD tasks.
        reward_offset: Added to each step's reward to keep QD scores positive.
    """

    base: Callable[..., Env]
    base_name: str
    wrappers: tuple[WrapperRow, ...] = ()
    descriptor_extractor: Extractor | None = None
    reward_offset: float | None = None


_ROWS: dict[str, EnvironmentRow] = {
    "ant": EnvironmentRow(Ant, "ant"),
    "ant_uni": EnvironmentRow(
        Ant,
        "ant",
        wrappers=(WrapperRow(FeetContactWrapper),),
        descriptor_extractor=get_feet_contact_proportion,
        reward_offset=3.24,
    ),
    "humanoid": EnvironmentRow(Humanoid, "humanoid"),
    "humanoid_uni": EnvironmentRow(
        Humanoid,
        "humanoid",
        wrappers=(WrapperRow(FeetContactWrapper),),
        descriptor_extractor=get_feet_contact_proportion,
        reward_offset=0.0,
    ),
}


class _Column(Mapping[str, Value], Generic[Value]):
    """Read-only table of one attribute of the rows that have it."""

    def __init__(self, attribute: str) -> None:
        self._attribute = attribute

    def __getitem__(self, env_name: str) -> Value:
        row = _ROWS.get(env_name)
        value = None if row is None else getattr(row, self._attribute)
        if value is None:
            raise KeyError(
                f"{env_name!r} has no {self._attribute}; known: {', '.join(self)}"
            )
        return value

    def __iter__(self) -> Iterator[str]:
        rows = _ROWS.items()
        return (name for name, row in rows if getattr(row, self._attribute) is not None)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __repr__(self) -> str:
        return repr(dict(self))


descriptor_extractor: Mapping[str, Extractor] = _Column("descriptor_extractor")
behavior_descriptor_extractor: Mapping[str, Extractor] = descriptor_extractor
reward_offset: Mapping[str, float] = _Column("reward_offset")


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
) -> None:
    """Adds an environment to the names that ``create`` knows.

    Args:
        env_name: A new name.
        base: Class or function that makes the environment without wrappers.
        base_name: Name that the wrappers receive; ``None``: ``env_name``.
        wrappers: Wrappers, from the inside to the outside.
        descriptor_extractor: Reads the descriptor of an episode, for QD tasks.
        reward_offset: Added to each step's reward to keep QD scores positive.

    Raises:
        ValueError: The name is taken, or is not a name.
    """
    if not isinstance(env_name, str) or not env_name:
        raise ValueError(f"env_name={env_name!r}: allowed: a string that is not empty")
    if env_name in _ROWS:
        raise ValueError(
            f"env_name={env_name!r}: taken; allowed: any but {', '.join(_ROWS)}"
        )
    if not callable(base):
        raise TypeError(f"base={base!r}: allowed: a class or a function")
    _ROWS[env_name] = EnvironmentRow(
        base,
        env_name if base_name is None else base_name,
        tuple(wrappers),
        descriptor_extractor,
        reward_offset,
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
        **kwargs: To the environment inside, as ``dtype`` or ``ctrl_cost_weight``.

    Returns:
        The environment.

    Raises:
        UnknownEnvironment: ``env_name`` is not registered.
        ValueError: A value or a combination is not allowed.
    """
    row = _ROWS.get(env_name) if isinstance(env_name, str) else None
    if row is None:
        raise UnknownEnvironment(env_name, registered_envs())
    options = _wrapper_options(env_name, row, qdax_wrappers_kwargs)
    if episode_length is None and (action_repeat != 1 or eval_metrics):
        raise ValueError(
            f"episode_length=None with action_repeat={action_repeat!r}, eval_metrics="
            f"{eval_metrics!r}; allowed: 1 and False, or an episode length"
        )
    env = row.base(**kwargs)
    if fixed_init_state:
        env = FixedInitialStateWrapper(env)
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


def _wrapper_options(
    env_name: str,
    row: EnvironmentRow,
    given: Sequence[Mapping[str, Any]] | None,
) -> list[Mapping[str, Any]]:
    """Returns the keyword arguments of each wrapper of a row."""
    if given is None:
        return [wrapper_row.options for wrapper_row in row.wrappers]
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
