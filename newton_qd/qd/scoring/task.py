"""The task of an evolution: an environment, its descriptor and their names."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from newton_qd import checks, tasks
from newton_qd.checks import Fact, listed, message, shown
from newton_qd.envs.shown import component_names
from newton_qd.extractors import Trajectories, get_final_xy_position, reads_last
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.real_numbers import real_numbers
from newton_qd.robots import ROBOTS, Material
from newton_qd.scenes import SCENES, Scene
from newton_qd.types import DescriptorExtractor

_OWN = (
    *("auto_reset", "batch_size", "brax_views", "env_name", "episode_length"),
    "eval_metrics",
)
"""Arguments of ``create`` that are not for the settings of a run."""


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """A Quality-Diversity task.

    It compares and hashes by identity, so it can be a static argument of jitted
    functions.

    Attributes:
        env: Environment with unbatched ``reset`` and ``step`` and without
            auto-reset.
        descriptor_extractor: Maps ``(data, mask)`` to descriptors (N, D), with
            ``data.state_desc`` (N, T, D) and ``mask`` (N, T) equal to 1 after the
            end of an episode.
        limits: Lowest and highest descriptor, (D,) each. Sequences become arrays.
        labels: D names for the axes of plots.
        reward_offset: Number per control step that makes returns positive, for the QD
            score only.
        network: Network of the policies, as for ``policy_of``; ``None``: a perceptron
            with the hidden layers of the settings.
        episode_length: Control steps of the episode with which ``reads_end`` tries a
            ``descriptor_extractor`` of your own.
    """

    env: Any
    descriptor_extractor: Callable[[Any, jax.Array], jax.Array]
    limits: tuple[np.ndarray, np.ndarray]
    labels: tuple[str, ...]
    reward_offset: float
    network: Any = None
    episode_length: int = 16

    def __post_init__(self) -> None:
        """Checks that limits and labels are of the same descriptor.

        Raises:
            ConfigError: They are not, or limits are no numbers, or traced.
        """
        allowed = "lowest and highest descriptor, as two arrays of numbers"
        kinds = (tuple, list, np.ndarray, jax.Array)
        checks.instance("limits", self.limits, kinds, allowed, error=ConfigError)
        if any(isinstance(limit, Tracer) for limit in self.limits):
            given = Fact("arrays whose values jax.jit or jax.vmap does not know yet")
            allowed = "values: make the task outside of the transformed function"
            raise ConfigError(message("limits", given, allowed))
        if any(real_numbers(limit) is None for limit in self.limits):
            raise ConfigError(message("limits", self.limits, allowed))
        limits = tuple(
            limit if checks.is_array(limit) else np.asarray(limit, np.float32)
            for limit in self.limits
        )
        object.__setattr__(self, "limits", limits)
        shapes = tuple(limit.shape for limit in limits)
        length = len(self.labels)
        if shapes != ((length,), (length,)):
            given = Fact(f"{length} names, and limits of shapes {listed(shapes)}")
            allowed = "one name, one lowest and one highest value for each component"
            raise ConfigError(message("labels", given, allowed))

    @property
    def descriptor_length(self) -> int:
        """Number of components of the descriptor."""
        return len(self.labels)

    def qd_offset(self, episode_length: int) -> float:
        """Returns the number that makes returns positive, for the QD score.

        Args:
            episode_length: Control steps of an episode.
        """
        return self.reward_offset * episode_length

    @property
    def reads_end(self) -> bool:
        """Whether the descriptor depends on the end of an episode alone.

        Another one counts as a mean over the episode.

        Raises:
            ConfigError: It has another length than the state descriptor.
        """
        self.require_length()
        return reads_last(
            self.descriptor_extractor, self.episode_length, self.descriptor_length
        )

    def require_length(self) -> None:
        """Checks that descriptors are as long as state descriptors.

        An algorithm that compares the two, or steers along them, needs this.

        Raises:
            ConfigError: They are not.
        """
        length = getattr(self.env, "state_descriptor_length", self.descriptor_length)
        if length != self.descriptor_length:
            given = Fact(f"descriptors of length {self.descriptor_length}")
            allowed = f"length {length}, that of the state descriptor, for this "
            allowed += "algorithm; others, such as me, take any length"
            raise ConfigError(message("descriptor_extractor", given, allowed))


def make_task(config: EvolveConfig) -> Task:
    """Creates the registered task of a configuration.

    Args:
        config: Settings, of which ``env_name``, ``env_options`` and ``episode_length``
            are used.

    Raises:
        TypeError: ``config`` is not an ``EvolveConfig``.
        UnknownEnvironment: No environment of this name is registered.
        ConfigError: The environment has no descriptor, no reward offset, or no finite
            limits of its descriptor. Or the grid does not fit the descriptor, or an
            option of the environment is wrong.
    """
    # imported here, because the registry imports every environment
    import newton_qd

    checks.instance("config", config, EvolveConfig, "an EvolveConfig")
    name = config.env_name
    if name not in newton_qd.registered_envs():
        raise newton_qd.UnknownEnvironment(name, newton_qd.registered_envs())
    described = sorted(newton_qd.tables.descriptor_extractor)
    if name not in described:
        why = "which has no descriptor"
        raise ConfigError(message("env_name", name, listed(described), why=why))
    if name not in newton_qd.tables.reward_offset:
        allowed = "names with one, so pass reward_offset to newton_qd.register"
        why = "which has no reward_offset"
        raise ConfigError(message("env_name", name, allowed, why=why))
    length = _declared_length(name)
    if length is not None:
        config.resolve(length)  # its error comes before the slow part
    env = _environment(config)
    low, high = (np.asarray(x, np.float32) for x in env.descriptor_limits)
    if not np.all(np.isfinite([low, high])):
        allowed = "finite numbers, such as minval and maxval of XYPositionWrapper"
        given = (low.tolist(), high.tolist())
        raise ConfigError(message(f"descriptor limits of {name!r}", given, allowed))
    extractor = newton_qd.tables.descriptor_extractor[name]
    _require_length(extractor, config.episode_length, len(low))
    return Task(
        env=env,
        descriptor_extractor=extractor,
        limits=(low, high),
        labels=_labels(env, extractor, len(low)),
        reward_offset=float(newton_qd.tables.reward_offset[name]),
        episode_length=config.episode_length,
    )


def made_task(
    task_factory: Callable[[EvolveConfig], Task], config: EvolveConfig
) -> Task:
    """Returns the task that a function makes for a configuration.

    Raises:
        ConfigError: It makes something else, or cannot be called.
    """
    allowed = "a function of the settings that returns a Task"
    if not callable(task_factory):
        raise ConfigError(message("task_factory", task_factory, allowed))
    task = task_factory(config)
    if not isinstance(task, Task):
        given = Fact(f"one that returned {shown(task)}")
        raise ConfigError(message("task_factory", given, allowed))
    return task


def randomized(config: EvolveConfig, task: Task) -> Task:
    """Returns the task of a run, with random physical parameters if it wants them.

    Raises:
        ConfigError: A setting does not fit the environment.
    """
    if not config.randomize:
        return task
    from newton_qd.wrappers import RandomParamsWrapper

    try:
        env = RandomParamsWrapper(task.env, **dict(config.randomize))
    except (TypeError, ValueError) as error:
        raise ConfigError(f"randomize: {error}") from error
    return dataclasses.replace(task, env=env)


def _environment(config: EvolveConfig) -> Any:
    """Creates the environment of a configuration.

    Raises:
        ConfigError: An option of the environment is wrong.
        TypeError: As ``newton_qd.create``, without options.
        ValueError: As ``newton_qd.create``, without options.
    """
    import newton_qd

    options = dict(config.env_options)
    for name in _OWN:
        if name in options:
            why = "which evolve sets itself"
            allowed = "other arguments of newton_qd.create"
            raise ConfigError(message("env_options", name, allowed, why=why))
    try:
        if options.get("material") is not None:
            options["material"] = _material(config.env_name, options["material"])
        if options.get("scene") is not None:
            options["scene"] = _scene(options["scene"])
        return newton_qd.create(
            config.env_name,
            episode_length=config.episode_length,
            auto_reset=False,
            **options,
        )
    except (NotImplementedError, TypeError, ValueError) as error:
        if not options:
            raise
        raise ConfigError(f"env_options: {error}") from error


def _material(env_name: str, fields: Any) -> Material:
    """Returns the material of the environment's robot with other fields.

    Raises:
        TypeError: ``fields`` is not a table, or a field does not exist.
    """
    checks.instance("material", fields, Mapping, "a table of fields of Material")
    _check_fields("material", fields, Material)
    spec = tasks.ENVIRONMENTS[env_name]
    robot = spec.robot or ROBOTS.get(spec.base_name)
    return dataclasses.replace(
        Material() if robot is None else robot.material, **fields
    )


def _check_fields(name: str, given: Mapping[str, Any], kind: type) -> None:
    """Checks the fields of a table.

    Raises:
        TypeError: The dataclass ``kind`` does not have such a field, or one is missing.
    """
    fields = dataclasses.fields(kind)
    known = [field.name for field in fields]
    for key, value in given.items():
        if key not in known:
            why = f"an unexpected keyword argument {key!r}"
            raise TypeError(message(f"{name}.{key}", value, listed(known), why=why))
    needed = [f.name for f in fields if f.default is dataclasses.MISSING]
    missing = [key for key in needed if key not in given]
    if missing:
        given_text = Fact(f"a table without {missing[0]!r}")
        raise TypeError(message(name, given_text, f"a table with {listed(needed)}"))


def _scene(value: Any) -> Scene:
    """Returns a scene from its name, its URDF file or its fields.

    Raises:
        TypeError: It is none of them, a field does not exist, or one is missing.
    """
    if isinstance(value, Mapping):
        _check_fields("scene", value, Scene)
        return Scene(**value)
    if isinstance(value, str) and value in SCENES:
        return SCENES[value]
    if isinstance(value, str) and value.endswith(".urdf"):
        return Scene(Path(value).stem, value)
    allowed = f"{listed(SCENES)}, a URDF file, or a table of fields of Scene"
    raise TypeError(message("scene", value, allowed))


def _declared_length(name: str) -> int | None:
    """Returns the length of a descriptor without building its environment.

    ``None``: only the environment knows it.
    """
    from newton_qd import wrappers

    spec = tasks.ENVIRONMENTS[name]
    found = [
        wrapper.wrapper
        for wrapper in spec.wrappers
        if isinstance(wrapper.wrapper, type)
        and issubclass(wrapper.wrapper, wrappers.DescriptorWrapper)
    ]
    if not found:
        return None
    if issubclass(found[-1], wrappers.FeetContactWrapper):
        return len(spec.feet) if spec.feet else None
    match getattr(found[-1], "limits", None):
        case (tuple() | list() as lowest, _):
            return len(lowest)
    return None  # wrong limits have an error of their own


def _require_length(extractor: DescriptorExtractor, steps: int, length: int) -> None:
    """Checks that descriptors are as long as the limits.

    Raises:
        ConfigError: They are not.
    """
    values = jax.ShapeDtypeStruct((1, steps, length), np.float32)
    mask = jax.ShapeDtypeStruct((1, steps), np.float32)
    found = jax.eval_shape(
        lambda values, mask: extractor(Trajectories(values), mask), values, mask
    ).shape
    if found != (1, length):
        name = "descriptor_extractor: shape for one episode"
        allowed = f"{(1, length)}, as the limits have"
        raise ConfigError(message(name, found, allowed))


def _labels(env: Any, extractor: Any, length: int) -> tuple[str, ...]:
    """Returns names of the components of an episode's descriptor."""
    names = component_names(env, length)
    final = extractor is get_final_xy_position
    return tuple(f"final {name}" if final else name for name in names)
