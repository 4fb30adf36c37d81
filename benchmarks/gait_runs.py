"""Roll-outs of sine gaits, in newton_qd or in brax v1.

``worker.py`` imports this module in the environment of either library, so it imports
neither of them at the top, and it runs on old releases of JAX too.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def make_newton_qd(
    robot: str, noise: dict[str, Any], substeps: int | None, material: dict[str, Any]
) -> Any:
    """Returns this project's environment, with other substeps or material if asked."""
    import newton_qd

    env: Any = newton_qd.create(robot, episode_length=None, auto_reset=False, **noise)
    spec = dataclasses.replace(
        env.robot, material=dataclasses.replace(env.robot.material, **material)
    )
    if substeps is not None:
        spec = dataclasses.replace(spec, substeps=substeps)
    if spec != env.robot:
        env.robot = spec
        env._load(env.system.scene)
    return env


def make_brax_v1(
    robot: str, noise: dict[str, Any], scale_substeps: int, legacy_spring: bool
) -> Any:
    """Returns brax v1's environment, with more substeps or other dynamics if asked."""
    from qdax.tasks.brax import v1

    create: Any = v1.create
    env = create(
        robot,
        episode_length=None,
        auto_reset=False,
        legacy_spring=legacy_spring,
        **noise,
    )
    if scale_substeps != 1:
        config = env.sys.config
        config.substeps *= scale_substeps
        env.sys = type(env.sys)(config)
    return env


def make(library: str, robot: str, noise: dict[str, Any], options: Any) -> Any:
    """Returns an environment without time limit and without automatic reset."""
    if library == "newton_qd":
        defaults = {"substeps": None, "material": {}}
        return make_newton_qd(robot, noise, **{**defaults, **options})
    defaults = {"scale_substeps": 1, "legacy_spring": True}
    return make_brax_v1(robot, noise, **{**defaults, **options})


class GaitRuns:
    """Environments and compiled roll-outs of one library."""

    def __init__(self, library: str) -> None:
        self._library = library
        self._made: dict[str, tuple[Any, Any, Any]] = {}

    def run(
        self,
        robot: str,
        gaits: list[Any],
        seeds: list[int],
        steps: int,
        options: dict[str, Any],
    ) -> dict[str, Any]:
        """Runs every gait from every start.

        Args:
            robot: Name of the environment.
            gaits: (gaits, nu, 3) amplitude [-], frequency [Hz] and phase [rad] of the
                sine of each action.
            seeds: One random start each; -1 is the default pose at rest.
            steps: Control steps.
            options: Changes to the simulation: arguments of ``make_newton_qd`` or
                ``make_brax_v1``.

        Returns:
            Lists (starts, gaits): ``returns`` up to the end of the episode,
            ``endless``: returns of all steps, as if no fall ended the episode (the
            bonus of a step is always paid), ``steps`` of the episode, ``forward``: way
            of the torso along x in all steps [m]. And the number of ``faults``.
        """
        name = f"{robot} {sorted(options.items())}"
        if name not in self._made:
            self._made[name] = self._prepare(robot, options)
        resets, step, dt = self._made[name]
        table = np.asarray(gaits, np.float32)
        if table.shape[1] != step.action_size:
            raise ValueError(f"gaits: {table.shape}; {robot} has {step.action_size}")
        starts = [
            resets[0 if seed < 0 else 1](jax.random.PRNGKey(max(seed, 0)))
            for seed in seeds
        ]
        first = jax.tree_util.tree_map(
            lambda *leaves: jnp.repeat(jnp.stack(leaves), len(table), axis=0), *starts
        )
        found = step.roll_out(
            first, jnp.asarray(np.tile(table, (len(seeds), 1, 1))), steps, dt
        )
        shape = (len(seeds), len(table))
        out: dict[str, Any] = {
            key: np.asarray(value, np.float64).reshape(shape).tolist()
            for key, value in found.items()
        }
        out["faults"] = int(np.sum(np.asarray(out["faults"]) > 0))
        return out

    def _prepare(self, robot: str, options: dict[str, Any]) -> tuple[Any, Any, Any]:
        still = make(self._library, robot, {"reset_noise_scale": 0.0}, options)
        noisy = make(self._library, robot, {}, options)
        sys = getattr(noisy, "sys", None)
        dt = float(noisy.dt if sys is None else sys.config.dt)
        return (jax.jit(still.reset), jax.jit(noisy.reset)), _Stepper(noisy), dt


class _Stepper:
    """The compiled roll-out of one environment."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self.action_size = int(env.action_size)
        self.roll_out = jax.jit(self._roll_out, static_argnums=(2, 3))

    def _roll_out(
        self, first: Any, gaits: jax.Array, steps: int, dt: float
    ) -> dict[str, jax.Array]:
        amplitude, frequency, phase = (gaits[..., k] for k in range(3))
        worlds = gaits.shape[0]
        zero = jnp.zeros((worlds,), jnp.float32)

        def torso_x(state: Any) -> jax.Array:
            if hasattr(state, "qp"):
                return state.qp.pos[:, 0, 0]
            return state.pipeline_state.q[:, 0]

        def body(carry: Any, index: jax.Array) -> Any:
            state, alive, total, endless, length = carry
            turns = 2 * jnp.pi * frequency * index.astype(jnp.float32) * dt
            action = amplitude * jnp.sin(turns + phase)
            state = jax.vmap(self._env.step)(state, action)
            total, length = total + alive * state.reward, length + alive
            endless = endless + state.reward
            alive = alive * (1 - state.done)
            return (state, alive, total, endless, length), None

        carry = (first, zero + 1, zero, zero, zero)
        carry, _ = jax.lax.scan(body, carry, jnp.arange(steps))
        state, _, total, endless, length = carry
        return {
            "returns": total,
            "endless": endless,
            "steps": length,
            "forward": torso_x(state) - torso_x(first),
            "faults": state.info.get("fault", zero),
        }
