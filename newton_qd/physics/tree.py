"""Index tables of a kinematic tree."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from newton_qd.physics.system import System


def _ragged(rows: Sequence[Sequence[int]]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the row starts and the concatenated items of a list of lists.

    If there are no items, the result has one item 0.
    """
    starts = np.cumsum([0, *map(len, rows)], dtype=np.int32)
    items = [item for row in rows for item in row] or [0]
    return starts, np.asarray(items, np.int32)


def _limbs(children: Sequence[Sequence[int]]) -> list[list[list[int]]]:
    """Returns the limbs by level: those at the world, those that branch off them, ...

    A limb is a run of bodies, each but the last of which has one child. Row 0 of
    ``children`` is the world.
    """
    levels, first = [], list(children[0])
    while first:
        limbs = []
        for body in first:
            limb = [body]
            while len(children[limb[-1]]) == 1:
                limb.append(children[limb[-1]][0])
            limbs.append(limb)
        levels.append(limbs)
        first = [child for limb in limbs for child in children[limb[-1]]]
    return levels


@dataclasses.dataclass(frozen=True)
class Tree:
    """Index tables of a system. Bodies are counted from 1; row 0 is the world.

    Attributes:
        body_parent: (nb + 1,) parent of each body.
        limb_level: (levels + 1,) first limb of each level; roots are in the first one.
        limb: Start of each limb, and the bodies by limb, each from root to tip.
        child: (nb + 2,) start of each body's children, and the children.
        contact: (nb + 2,) start of each body's contacts.
    """

    body_parent: np.ndarray
    limb_level: np.ndarray
    limb: tuple[np.ndarray, np.ndarray]
    child: tuple[np.ndarray, np.ndarray]
    contact: np.ndarray


def build_tree(system: System) -> Tree:
    """Returns the index tables of ``system``."""
    nb = system.nb
    parent = [-1, *(int(p) + 1 for p in system.parent)]
    children = [[c for c in range(1, nb + 1) if parent[c] == b] for b in range(nb + 1)]
    levels = _limbs(children)

    contact_counts = np.bincount(system.contact_body + 1, minlength=nb + 1)
    return Tree(
        body_parent=np.asarray(parent, np.int32),
        limb_level=np.asarray([0, *np.cumsum([len(row) for row in levels])], np.int32),
        limb=_ragged([limb for row in levels for limb in row]),
        child=_ragged(children),
        contact=np.asarray([0, *np.cumsum(contact_counts)], np.int32),
    )
