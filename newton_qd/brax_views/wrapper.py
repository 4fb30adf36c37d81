"""The wrapper that gives states and the robot the attributes of brax v1."""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Mapping
from typing import Any

import jax

from newton_qd.brax_views.views import QP, SystemView, qp_view
from newton_qd.envs.base import PhysicsEnv
from newton_qd.envs.env import Env
from newton_qd.envs.rollouts import RolloutOrder
from newton_qd.envs.state import State
from newton_qd.physics.system import System
from newton_qd.types import Action, Params, RNGKey
from newton_qd.wrappers import EpisodeWrapper, Wrapper

BODY_NAMES: Mapping[str, Mapping[str, str]] = types.MappingProxyType(
    {
        "ant": types.MappingProxyType(
            {
                "torso": "$ Torso",
                **{f"aux_{leg}": f"Aux {leg}" for leg in range(1, 5)},
                **{f"foot_{leg}": f"$ Body {1 + 3 * leg}" for leg in range(1, 5)},
            }
        ),
        "fetch": types.MappingProxyType(
            {
                link: link.replace("_", " ").title()
                for link in (
                    "torso",
                    "shoulders",
                    "hips",
                    *(
                        f"{end}_{side}_{half}"
                        for end in ("front", "back")
                        for side in ("right", "left")
                        for half in ("upper", "lower")
                    ),
                    "target",
                )
            }
        ),
        "grasp": types.MappingProxyType(
            {
                "object": "Object",
                "palm": "HandPalm",
                "target": "Target",
                **{
                    f"finger_{finger}_{part}": f"HandThumb{part.title()}{suffix}"
                    for finger, suffix in enumerate(("", "Two", "Three", "Four"), 1)
                    for part in ("proximal", "middle", "distal")
                },
            }
        ),
        "ur5e": types.MappingProxyType(
            {"wrist_3_link": "wrist_3_link", "target": "Target"}
        ),
    }
)
"""For each robot, the name of a link's body in the original suite.

No other robot of the suite has all links of an entry.
"""


class _Shown:
    """A robot in the structure of a pytree: compared by identity, with a short repr."""

    def __init__(self, system: System) -> None:
        self.system = system

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Shown) and self.system is other.system

    def __hash__(self) -> int:
        return hash(id(self.system))

    def __repr__(self) -> str:
        scene = self.system.scene
        place = "" if scene is None else f" in {scene.name}"
        return f"<{self.system.robot.name}{place} at {id(self.system):#x}>"


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class BraxState(State):
    """A state with a reference to its robot, for ``qp``.

    Attributes:
        shown: The robot. It is part of the pytree's structure and not a leaf.
    """

    shown: _Shown = dataclasses.field(repr=False, metadata={"static": True})

    @property
    def qp(self) -> QP:
        """Bodies in the form of brax v1, computed when read; read-only."""
        return qp_view(self.system, self.pipeline_state)

    @property
    def system(self) -> System:
        """The robot."""
        return self.shown.system


class BraxViewsWrapper(Wrapper):
    """Adds ``state.qp`` to the states of a simulated robot, and ``env.sys``.

    It goes around all other wrappers and changes no number. It has no effect on
    environments without a simulated robot. States with views have the type
    ``BraxState``. The robot is part of their structure, so ``jax.tree.map`` over states
    of two robots, or of one robot in two materials, raises an error.
    """

    rollout_order = RolloutOrder.AT_ONCE

    def __init__(self, env: Env, body_names: Mapping[str, str] | None = None) -> None:
        """Wraps an environment.

        Args:
            env: The environment.
            body_names: Name of a link's body in the original, if it differs from the
                name of the link; ``None``: the names in ``BODY_NAMES``, by the name of
                the robot or by its links.
        """
        super().__init__(env)
        self._body_names = body_names

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode.

        Raises:
            ValueError: The environment is float64 and JAX x64 is off.
        """
        return self._viewed(self.env.reset(rng))

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one step.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: The state comes from another environment, or the action has the
                wrong shape.
        """
        return self._viewed(self.env.step(state, action, params))

    def fixed_state(self) -> State:
        """Returns the state of a reset without noise.

        Raises:
            ValueError: The environment is float64 and JAX x64 is off.
        """
        inside: Any = self.env
        return self._viewed(inside.fixed_state())

    @property
    def sys(self) -> SystemView:
        """The robot for code that was written for brax v1.

        Raises:
            AttributeError: The environment inside is not a simulated robot.
        """
        system = self._system
        if system is None:
            raise AttributeError(f"sys: {self.name} is not a simulated robot")
        repeat, inside = 1, self.env
        while isinstance(inside, Wrapper):
            repeat *= inside.action_repeat if isinstance(inside, EpisodeWrapper) else 1
            inside = inside.env
        names = self._body_names
        if names is None:
            names = _original_names(system)
        return SystemView(system, repeat, names)

    @property
    def _system(self) -> System | None:
        # asks the current inner environment, because ``with_base`` may have changed it
        base = self.unwrapped
        return base.system if isinstance(base, PhysicsEnv) else None

    def _viewed(self, state: State) -> State:
        """Returns the state with its current robot."""
        system = self._system
        if system is None:
            return state
        fields = {
            field.name: getattr(state, field.name)
            for field in dataclasses.fields(State)
        }
        return BraxState(**fields, shown=_Shown(system))


def _original_names(system: System) -> Mapping[str, str]:
    """Returns the original names of bodies, also of a robot such as a damaged ant."""
    if system.robot.name in BODY_NAMES:
        return BODY_NAMES[system.robot.name]
    links = set(system.body_names)
    return next((x for x in BODY_NAMES.values() if x.keys() <= links), {})
