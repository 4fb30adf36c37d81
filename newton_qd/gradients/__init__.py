"""Gradients of fitness and descriptor over whole episodes, and checks of their quality.

- ``Episode``: an environment with a policy or open-loop actions; its methods are
  ``gradient``, ``directional`` (only of weighted sums), ``mixed`` (first and zeroth
  order, under noise) and ``scoring`` (QDax's contract)
- ``GradientOptions``: windows, clipping, discounting, memory
- ``diagnose_gradients``: the number of steps for which the gradient is useful
- ``soft_to_stiff``, ``softened``: softer contacts, and a series back to stiff ones
- ``with_smooth_descriptor``: an environment whose descriptor has a gradient
- ``with_smooth_termination``: an environment whose ``done`` has a gradient
- ``make_episode``, ``make_episode_gradient``, ``make_directional_gradient``,
  ``make_mixed_gradient``: deprecated; methods of ``Episode``

Importing this package imports no other module of it. Each name is loaded when it is
first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from newton_qd.lazy import loaded_name

if TYPE_CHECKING:
    from newton_qd.gradients.doctor import diagnose_gradients
    from newton_qd.gradients.episode import Episode
    from newton_qd.gradients.exact import EpisodeGradients
    from newton_qd.gradients.factories import (
        make_directional_gradient,
        make_episode,
        make_episode_gradient,
        make_mixed_gradient,
    )
    from newton_qd.gradients.flow import GradientOptions
    from newton_qd.gradients.mixed import MixedGradients
    from newton_qd.gradients.outcome import Outcome
    from newton_qd.gradients.report import GradientReport
    from newton_qd.gradients.smooth import (
        with_smooth_descriptor,
        with_smooth_termination,
    )
    from newton_qd.gradients.softness import soft_to_stiff, softened

__all__ = [
    "Episode",
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
    "with_smooth_termination",
]

_HOME = {
    "Episode": ".episode",
    "EpisodeGradients": ".exact",
    "GradientOptions": ".flow",
    "GradientReport": ".report",
    "MixedGradients": ".mixed",
    "Outcome": ".outcome",
    "diagnose_gradients": ".doctor",
    "make_directional_gradient": ".factories",
    "make_episode": ".factories",
    "make_episode_gradient": ".factories",
    "make_mixed_gradient": ".factories",
    "soft_to_stiff": ".softness",
    "softened": ".softness",
    "with_smooth_descriptor": ".smooth",
    "with_smooth_termination": ".smooth",
}


def __getattr__(name: str) -> Any:
    """Loads a name of this package when it is first used."""
    return loaded_name(globals(), name, _HOME)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
