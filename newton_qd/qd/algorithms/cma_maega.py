"""CMA-MAEGA."""

from __future__ import annotations

import dataclasses
from typing import Any

from newton_qd.qd.algorithms.cma_mega import (
    TUNED,
    CMAMEGAOptions,
    gradients,
    make_search,
)
from newton_qd.qd.algorithms.gradient_options import initial_scale
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext, batch_and


@dataclasses.dataclass(frozen=True, kw_only=True)
class CMAMAEGAOptions(CMAMEGAOptions):
    """Options of CMA-MAEGA (Fontaine and Nikolaidis 2023).

    Attributes:
        learning_rate: Rate at which the threshold of a cell rises, 0 to 1 [-].
    """

    learning_rate: float = 0.01


def _make(context: EmitterContext, options: CMAMAEGAOptions) -> Any:
    """CMA-MAEGA: CMA-MEGA on an annealed archive."""
    from newton_qd.qd.emitters import CMAMAEGAEmitter
    from newton_qd.qd.emitters.annealed import OnAnnealedRepertoire

    return OnAnnealedRepertoire(
        make_search(CMAMAEGAEmitter, context, options),
        learning_rate=options.learning_rate,
        # The lowest return with a positive share in the QD score.
        threshold_min=-context.task.qd_offset(context.config.episode_length),
    )


CMA_MAEGA = AlgorithmSpec(
    name="cma-maega",
    summary="CMA-MAEGA: like `cma-mega`, with an annealed archive",
    make=_make,
    options=CMAMAEGAOptions,
    varies=False,
    tuned=TUNED,
    evaluations=batch_and(gradients),
    evaluates_first=True,
    gradients=gradients,
    takes_faulty=True,
    initial_scale=initial_scale,
)
