"""Cross-references of docstrings, for the API reference.

Docstrings name other objects as ``:func:`~newton_qd.create` ``. In the site, this is a
link if the object has a place there, and its name if not.
"""

from __future__ import annotations

import re

import griffe

ROLE = re.compile(r":(?:attr|class|data|exc|func|meth|mod|obj):`(~?)([\w.]+)`")


class Roles(griffe.Extension):
    """Replaces the roles in all docstrings."""

    def on_instance(self, *, obj: griffe.Object, **kwargs: object) -> None:
        """Replaces the roles in the docstring of an object."""
        if obj.docstring is not None:
            obj.docstring.value = ROLE.sub(link, obj.docstring.value)


def link(role: re.Match[str]) -> str:
    """Returns HTML that becomes a link where its target exists."""
    short, target = role.groups()
    name = target.rpartition(".")[2] if short else target
    return f'<autoref optional identifier="{target}"><code>{name}</code></autoref>'
