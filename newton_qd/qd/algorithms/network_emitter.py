"""Emitters of QDax that see the parameters of networks, among weight vectors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

from newton_qd.qd.scoring.rollout import Policy


class OfParameters:
    """An emitter of network parameters as one of weight vectors.

    Args:
        emitter: Emitter of QDax.
        policy: Says how weights and parameters belong together.
        convert: Makes QDax's transitions from the dictionary of the scores.
    """

    def __init__(
        self, emitter: Any, policy: Policy, convert: Callable[[Any], Any]
    ) -> None:
        self._emitter = emitter
        self._policy = policy
        self._convert = convert

    def init(self, key: jax.Array, **told: Any) -> Any:
        """Returns the state before the second generation."""
        return self._emitter.init(key=key, **self._told(told))

    def emit(self, repertoire: Any, state: Any, key: jax.Array) -> Any:
        """Returns weights (N, size) and what the emitter remembers of them."""
        parameters, remembered = self._emitter.emit(self._seen(repertoire), state, key)
        return jax.vmap(self._policy.ravel)(parameters), remembered

    def state_update(self, emitter_state: Any, **told: Any) -> Any:
        """Learns from a generation."""
        return self._emitter.state_update(emitter_state, **self._told(told))

    def _seen(self, repertoire: Any) -> Any:
        return repertoire.replace(genotypes=self._unravel(repertoire.genotypes))

    def _unravel(self, genotypes: jax.Array) -> Any:
        return jax.vmap(self._policy.unravel)(genotypes)

    def _told(self, told: dict[str, Any]) -> dict[str, Any]:
        extra = told["extra_scores"]
        return {
            **told,
            "repertoire": self._seen(told["repertoire"]),
            "genotypes": self._unravel(told["genotypes"]),
            "extra_scores": {
                **extra,
                "transitions": self._convert(extra["transitions"]),
            },
        }
