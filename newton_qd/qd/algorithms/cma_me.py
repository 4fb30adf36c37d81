"""CMA-ME of QDax."""

from __future__ import annotations

import dataclasses
from typing import Any

from newton_qd import checks
from newton_qd.qd.algorithms.options import Options
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext
from newton_qd.qd.config import ConfigError


@dataclasses.dataclass(frozen=True, kw_only=True)
class CMAMEOptions(Options):
    """Options of CMA-ME (Fontaine et al. 2020).

    Attributes:
        emitters: Number of emitters that take turns.
        sigma_g: Initial step size, in units of policy weights [-].
    """

    emitters: int = 4
    sigma_g: float = 0.5


def _make(context: EmitterContext, options: CMAMEOptions) -> Any:
    """CMA-ME with improvement emitters; its memory grows with size squared.

    Raises:
        ConfigError: ``sigma_g`` is not positive.
    """
    import jax
    from qdax.core.emitters.cma_improvement_emitter import CMAImprovementEmitter
    from qdax.core.emitters.cma_pool_emitter import CMAPoolEmitter

    checks.number("options: sigma_g", options.sigma_g, above=0, error=ConfigError)
    # QDax's constructor asks for values, also where JAX compiles a generation
    with jax.ensure_compile_time_eval():
        emitter = CMAImprovementEmitter(
            batch_size=context.config.batch_size,
            genotype_dim=context.policy.size,
            centroids=context.centroids,
            sigma_g=options.sigma_g,
            min_count=1,
        )
    return CMAPoolEmitter(num_states=options.emitters, emitter=emitter)


CMA_ME = AlgorithmSpec(
    name="cma-me",
    summary="CMA-ME with improvement emitters; its memory grows with the square of "
    "the policy's size",
    make=_make,
    options=CMAMEOptions,
    varies=False,
    least=1,
    smallest=2,
    double=False,
)
