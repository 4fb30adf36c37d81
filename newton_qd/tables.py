"""Read-only tables of properties of the environments by name, as in QDax.

By the name of an environment:

- ``descriptor_extractor``, with the older name ``behavior_descriptor_extractor``:
  function that computes the descriptor of an episode
- ``reward_offset``: added to the reward of each step to keep QD scores positive
- ``original_reward_offset``: reward offset of the original, with its physics

By the name that wrappers receive:

- ``FEET_NAMES``: links of the feet
- ``COG_NAMES``: link of the torso
- ``FORWARD_REWARD_NAMES``: metric with the forward part of the reward

``newton_qd.register`` extends these tables.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Generic, TypeAlias, TypeVar

from newton_qd import tasks
from newton_qd.checks import message
from newton_qd.tasks import EnvironmentSpec
from newton_qd.types import DescriptorExtractor

Value = TypeVar("Value")

__all__ = [
    "COG_NAMES",
    "FEET_NAMES",
    "FORWARD_REWARD_NAMES",
    "behavior_descriptor_extractor",
    "descriptor_extractor",
    "original_reward_offset",
    "reward_offset",
]


class _Column(Mapping[str, Value], Generic[Value]):
    """Read-only table of one attribute of the environments that have it."""

    def __init__(self, attribute: str) -> None:
        self._attribute = attribute

    def __getitem__(self, env_name: str) -> Value:
        for name, value in self._items():
            if name == env_name:
                return value
        raise KeyError(
            f"{env_name!r} has no {self._attribute}; known: {', '.join(self)}"
        )

    def __setitem__(self, env_name: str, value: Value) -> None:
        """Refuses to change the table.

        Raises:
            TypeError: Always.
        """
        name, why = f"{self._attribute}[{env_name!r}]", "and the table is read-only"
        allowed = "environments of newton_qd.register, with what belongs to them"
        raise TypeError(message(name, value, allowed, why=why))

    def __iter__(self) -> Iterator[str]:
        return iter(dict(self._items()))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __repr__(self) -> str:
        return repr(dict(self))

    def _items(self) -> Iterator[tuple[str, Value]]:
        for name, spec in self._specs():
            value = getattr(spec, self._attribute)
            if value is not None:
                yield name, value

    def _specs(self) -> Iterator[tuple[str, EnvironmentSpec]]:
        yield from tasks.ENVIRONMENTS.items()


class _BaseColumn(_Column[Value]):
    """Read-only table of one attribute by the name that the wrappers receive."""

    def _specs(self) -> Iterator[tuple[str, EnvironmentSpec]]:
        for spec in tasks.ENVIRONMENTS.values():
            yield spec.base_name, spec


Extractors: TypeAlias = Mapping[str, DescriptorExtractor]

descriptor_extractor: Extractors = _Column("descriptor_extractor")
behavior_descriptor_extractor: Extractors = descriptor_extractor
reward_offset: Mapping[str, float] = _Column("reward_offset")
original_reward_offset: Mapping[str, float] = _Column("original_reward_offset")
FEET_NAMES: Mapping[str, tuple[str, ...]] = _BaseColumn("feet")
COG_NAMES: Mapping[str, str] = _BaseColumn("torso")
FORWARD_REWARD_NAMES: Mapping[str, str] = _BaseColumn("forward_reward")
