"""MAP-Elites whose elites climb along gradients of whole episodes."""

from __future__ import annotations

import dataclasses
from typing import Any

from newton_qd import checks
from newton_qd.qd.algorithms.climbing import CLIMBING, ClimbingOptions, ascent_emitter
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext, batch_and
from newton_qd.qd.algorithms.variation import with_isoline
from newton_qd.qd.config import EvolveConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class MEAscentOptions(ClimbingOptions):
    """Options of MAP-Elites with elites that climb.

    Attributes:
        climbers: Number of elites that climb at a time, at least 1; each is one
            offspring of a generation. The rest are iso+line variations.
    """

    climbers: int = 64

    def check(self) -> None:
        """Checks the climbers.

        Raises:
            ValueError: There is none, or a value is out of its range.
        """
        checks.integer("climbers", self.climbers, most=None)
        super().check()


def _make(context: EmitterContext, options: MEAscentOptions) -> Any:
    """MAP-Elites with elites that climb.

    Raises:
        ConfigError: There are more climbers than a generation can contain.
    """
    emitter = ascent_emitter(context, options, context.config.batch_size)
    return with_isoline(emitter, context.config)


def _gradients(config: EvolveConfig, options: MEAscentOptions) -> int:
    del config
    return options.climbing_episodes


ME_ASCENT = AlgorithmSpec(
    name="me-ascent",
    summary="MAP-Elites; a part of the offspring are elites that climb along exact "
    "gradients of whole episodes, one step in each generation",
    make=_make,
    options=MEAscentOptions,
    tuned=CLIMBING,
    evaluations=batch_and(_gradients),
    gradients=_gradients,
)
