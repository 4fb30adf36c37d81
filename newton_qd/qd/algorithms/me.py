"""MAP-Elites."""

from __future__ import annotations

from typing import Any

from newton_qd.qd.algorithms.options import Options
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext
from newton_qd.qd.algorithms.variation import isoline_emitter


def _make(context: EmitterContext, options: Options) -> Any:
    """MAP-Elites with iso+line variation (Vassiliades and Mouret 2018)."""
    del options
    return isoline_emitter(context.config, context.config.batch_size)


ME = AlgorithmSpec(
    name="me",
    summary="MAP-Elites with iso+line variation",
    make=_make,
    options=Options,
)
