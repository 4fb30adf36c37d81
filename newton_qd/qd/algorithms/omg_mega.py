"""OMG-MEGA."""

from __future__ import annotations

import dataclasses
from typing import Any

from newton_qd.qd.algorithms.gradient_options import (
    CHAOTIC,
    MixedOptions,
    gradient_scoring,
    initial_scale,
    on_robots_that_fall,
)
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext
from newton_qd.qd.config import EvolveConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class OMGMEGAOptions(MixedOptions):
    """Options of OMG-MEGA (Fontaine and Nikolaidis 2021).

    Attributes:
        sigma_g: Standard deviation of the coefficients of the normalized gradients, in
            units of policy weights [-].
    """

    sigma_g: float = 0.1


def _make(context: EmitterContext, options: OMGMEGAOptions) -> Any:
    """OMG-MEGA: random steps along all gradients of elites."""
    from newton_qd.qd.emitters import OMGMEGAEmitter

    return OMGMEGAEmitter(context.config.batch_size, options.sigma_g)


def _gradients(config: EvolveConfig, options: OMGMEGAOptions) -> int:
    return config.batch_size * options.episodes


OMG_MEGA = AlgorithmSpec(
    name="omg-mega",
    summary="OMG-MEGA: random steps along the gradients of fitness and descriptor of "
    "elites; every evaluation is differentiated",
    make=_make,
    options=OMGMEGAOptions,
    varies=False,
    tuned={"halfcheetah_uni": CHAOTIC, **on_robots_that_fall(sigma_g=0.02)},
    evaluations=_gradients,
    gradients=_gradients,
    scoring=gradient_scoring,
    takes_faulty=True,
    initial_scale=initial_scale,
)
