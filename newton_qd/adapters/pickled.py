"""Objects that pickle, copy and go to other processes, without what cannot."""

from __future__ import annotations

import abc
from typing import Any, ClassVar


class Pickled(abc.ABC):
    """Leaves some attributes out of a pickle; builds them again where it is read.

    Attributes:
        rebuilt: Names of the attributes that ``_rebuild`` sets, such as functions that
            JAX compiled.
    """

    rebuilt: ClassVar[tuple[str, ...]]

    @abc.abstractmethod
    def _rebuild(self) -> None:
        """Sets the attributes in ``rebuilt``."""

    def __getstate__(self) -> dict[str, Any]:
        kept = vars(self).items()
        return {name: value for name, value in kept if name not in self.rebuilt}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._rebuild()
