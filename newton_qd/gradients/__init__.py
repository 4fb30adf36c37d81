"""Gradients of fitness and descriptor over whole episodes, and what they are worth.

- ``make_episode_gradient``: of a policy or of open-loop actions
- ``make_directional_gradient``: of weighted sums of fitness and descriptor alone
- ``make_mixed_gradient``: the same under noise, of first and zeroth order at once
- ``GradientOptions``: windows, clipping, discounting, memory
- ``diagnose_gradients``: over how many steps the gradient can be used
- ``soft_to_stiff``, ``softened``: softer contacts, and the way back
- ``with_smooth_descriptor``: an environment whose descriptor has a gradient

Importing this package imports none of its parts: each name is loaded when it is
first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from newton_qd.gradients.doctor import diagnose_gradients
    from newton_qd.gradients.episode import Outcome, make_episode
    from newton_qd.gradients.exact import (
        EpisodeGradients,
        make_directional_gradient,
        make_episode_gradient,
    )
    from newton_qd.gradients.flow import GradientOptions
    from newton_qd.gradients.mixed import MixedGradients, make_mixed_gradient
    from newton_qd.gradients.report import GradientReport
    from newton_qd.gradients.smooth import with_smooth_descriptor
    from newton_qd.gradients.softness import soft_to_stiff, softened

__all__ = [
    "EpisodeGradients",
    "GradientOptions",
    "GradientReport",
    "MixedGradients",
    "Outcome",
    "diagnose_gradients",
    "make_directional_gradient",
    "make_episode",
    "make_episode_gradient",
    "make_mixed_gradient",
    "soft_to_stiff",
    "softened",
    "with_smooth_descriptor",
]

_HOME = {
    "EpisodeGradients": "exact",
    "GradientOptions": "flow",
    "GradientReport": "report",
    "MixedGradients": "mixed",
    "Outcome": "episode",
    "diagnose_gradients": "doctor",
    "make_directional_gradient": "exact",
    "make_episode": "episode",
    "make_episode_gradient": "exact",
    "make_mixed_gradient": "mixed",
    "soft_to_stiff": "softness",
    "softened": "softness",
    "with_smooth_descriptor": "smooth",
}


def __getattr__(name: str) -> Any:
    """Loads a name of this package when it is first used."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
