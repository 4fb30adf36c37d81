"""DCRL-ME with elites that climb along gradients of whole episodes."""

from __future__ import annotations

import dataclasses
from typing import Any

from newton_qd import checks
from newton_qd.qd.algorithms.climbing import CLIMBING, ClimbingOptions, ascent_emitter
from newton_qd.qd.algorithms.dcrl_me import DCRLMEOptions, dcrl_emitter
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext
from newton_qd.qd.config import EvolveConfig

_LEAST = 4  # individuals of DCRL-ME: a quarter for the critic, one for the actor


@dataclasses.dataclass(frozen=True, kw_only=True)
class DCRLMEAscentOptions(DCRLMEOptions, ClimbingOptions):
    """Options of DCRL-ME with elites that climb.

    Attributes:
        climbers: Number of elites that climb at a time, at least 1; each is one
            offspring of a generation. The rest of the generation is that of DCRL-ME.
        ga_batch_size: Iso+line variations in a generation; by default what is left.
        dcrl_batch_size: Individuals that follow the critic; by default a quarter of
            those that do not climb.
        ai_batch_size: Individuals from the actor; by default as many.
    """

    climbers: int = 64
    ga_batch_size: int | None = None
    dcrl_batch_size: int | None = None
    ai_batch_size: int | None = None

    def check(self) -> None:
        """Checks the climbers.

        Raises:
            ValueError: There is none, or a value is out of its range.
        """
        checks.integer("climbers", self.climbers, most=None)
        super().check()


def _make(context: EmitterContext, options: DCRLMEAscentOptions) -> Any:
    """DCRL-ME with elites that climb.

    Raises:
        ConfigError: There are more climbers than a generation can contain.
    """
    from newton_qd.qd.algorithms.beside import Beside

    climbing = ascent_emitter(
        context, options, others=_LEAST, whose="critic, actor and variations"
    )
    rest = context.config.batch_size - options.climbers
    config = context.config.replace(batch_size=rest)
    learning = dcrl_emitter(dataclasses.replace(context, config=config), options)
    return Beside(learning, climbing)


def _gradients(config: EvolveConfig, options: DCRLMEAscentOptions) -> int:
    del config
    return options.climbing_episodes


def _evaluations(config: EvolveConfig, options: DCRLMEAscentOptions) -> int:
    return config.batch_size + options.climbing_episodes


DCRL_ME_ASCENT = AlgorithmSpec(
    name="dcrl-me-ascent",
    summary="DCRL-ME; a part of the offspring are elites that climb along exact "
    "gradients of whole episodes, as in `me-ascent`",
    make=_make,
    options=DCRLMEAscentOptions,
    tuned=CLIMBING,
    least=1,
    transitions=True,
    evaluations=_evaluations,
    gradients=_gradients,
    smallest=_LEAST + 1,
    double=False,
)
