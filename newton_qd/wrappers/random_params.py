"""Physical parameters that are drawn at every reset."""

from __future__ import annotations

from typing import Any

import jax

from newton_qd.checks import listed, message
from newton_qd.envs.base import Env
from newton_qd.envs.inputs import require_state
from newton_qd.envs.randomization import Range, randomize_params
from newton_qd.envs.state import State
from newton_qd.physics.explicit_mesh import split_as
from newton_qd.physics.parameters import FIELDS
from newton_qd.types import Action, Params, RNGKey
from newton_qd.wrappers.base import Wrapper, refuse_second

_OWN_KEY = 0x7061  # any number, so that parameters do not follow from the start state


class RandomParamsWrapper(Wrapper):
    """Draws the physical parameters of each world at a reset (domain randomization).

    The parameters follow from the key of the reset. They stay the same until the next
    call of ``reset``, also if a finished world resets itself. Every function that
    resets and steps an environment then randomizes its worlds, for example a scoring
    function of QDax. It is the outermost wrapper.

    Attributes:
        ranges: Lowest and highest value of each parameter, as
            :func:`~newton_qd.randomize_params` takes them.
    """

    def __init__(self, env: Env, env_name: str | None = None, **ranges: Range) -> None:
        """Wraps a simulated robot.

        Args:
            env: The environment.
            env_name: Its name; not used.
            **ranges: Lowest and highest value of parameters by name, as
                :func:`~newton_qd.randomize_params` takes them; at least one.

        Raises:
            TypeError: ``env`` is not an environment, or a parameter does not exist.
            ValueError: The environment has no physical parameters, or draws them
                already, there is no range, or a range is wrong.
        """
        del env_name
        why = "and the ranges of the outer one alone would count"
        refuse_second(env, RandomParamsWrapper, why)
        for name in ranges:
            if name not in FIELDS:
                why = "which is no physical parameter"
                raise TypeError(message(name, ranges[name], listed(FIELDS), why=why))
        if all(limits is None for limits in ranges.values()):
            allowed = f"a range of at least one of {listed(FIELDS)}"
            raise ValueError(message("ranges", ranges, allowed))
        super().__init__(env)
        self.ranges = dict(ranges)
        jax.eval_shape(lambda: self._drawn(jax.random.key(0)))

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode in a world with new parameters.

        Raises:
            ValueError: The environment is float64 and JAX x64 is off.
        """
        state = self.env.reset(rng)
        drawn = split_as([rng], self._drawn(jax.random.fold_in(rng, _OWN_KEY)))
        return state.replace(info={**state.info, "params": drawn})

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one step with the parameters of the world, or with ``params``.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: The state comes from another environment, or the action has the
                wrong shape.
        """
        require_state(state, "params")
        own = state.info["params"]
        return self.env.step(state, action, own if params is None else params)

    def _drawn(self, key: RNGKey) -> Params:
        """Draws the parameters of a world, or of the worlds of a batch."""
        ranges: dict[str, Any] = self.ranges
        return randomize_params(key, self.env, **ranges)
