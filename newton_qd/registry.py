"""Environments by name: build them, and add new ones."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax

from newton_qd import brax_views as brax
from newton_qd import checks, tasks
from newton_qd.checks import Fact, listed, message
from newton_qd.envs.base import Env
from newton_qd.envs.changes import ROBOT
from newton_qd.envs.methods import check_methods, random_key
from newton_qd.envs.shown import REGISTERED
from newton_qd.errors import UnknownEnvironment
from newton_qd.moved import moved_name
from newton_qd.registration import (
    ENVIRONMENT,
    check_class,
    check_extractor_arguments,
    check_made,
    check_names,
    check_wrappers,
    descriptor_specs,
    needs_robot,
    takes_any,
    takes_robot,
)
from newton_qd.robots import Material, RobotSpec
from newton_qd.tasks import EnvironmentSpec, WrapperSpec
from newton_qd.types import DescriptorExtractor
from newton_qd.wrappers import (
    AutoResetWrapper,
    CompletedEvalWrapper,
    DescriptorWrapper,
    EpisodeWrapper,
    EvalWrapper,
    FixedInitialStateWrapper,
    VectorWrapper,
)

_MOVED = {
    "COG_NAMES": "newton_qd.tables.COG_NAMES",
    "EnvironmentRow": "newton_qd.tasks.EnvironmentSpec",
    "FEET_NAMES": "newton_qd.tables.FEET_NAMES",
    "FORWARD_REWARD_NAMES": "newton_qd.tables.FORWARD_REWARD_NAMES",
    "WrapperRow": "newton_qd.tasks.WrapperSpec",
    "behavior_descriptor_extractor": "newton_qd.tables.behavior_descriptor_extractor",
    "descriptor_extractor": "newton_qd.tables.descriptor_extractor",
    "original_reward_offset": "newton_qd.tables.original_reward_offset",
    "reward_offset": "newton_qd.tables.reward_offset",
}


def __getattr__(name: str) -> Any:
    """Returns a moved object by its old name."""
    return moved_name(__name__, name, _MOVED)


def registered_envs() -> tuple[str, ...]:
    """Returns the names that ``create`` knows."""
    return tuple(tasks.ENVIRONMENTS)


def register(
    env_name: str,
    base: Callable[..., Env],
    *,
    base_name: str | None = None,
    wrappers: Sequence[WrapperSpec] = (),
    descriptor: WrapperSpec | Callable[..., Env] | None = None,
    descriptor_extractor: DescriptorExtractor | None = None,
    reward_offset: float | None = None,
    robot: RobotSpec | None = None,
    replace: bool = False,
    **options: object,
) -> None:
    """Adds an environment to the names that ``create`` knows.

    Args:
        env_name: A new name: up to 100 ASCII letters, digits and ``_``, not beginning
            with a digit.
        base: Class of environments, or function that makes one, without wrappers. A
            function is called once, if it needs no other arguments than ``options``.
        base_name: Name that the wrappers receive; ``None``: ``env_name``.
        wrappers: Wrappers, from the inside to the outside.
        descriptor: Wrapper that writes the state descriptor, outside of ``wrappers``:
            a class such as ``FeetContactWrapper``, or a ``WrapperSpec``.
        descriptor_extractor: Computes the descriptor of an episode, for QD tasks;
            ``None``: the attribute of the class ``descriptor``, if there is one.
        reward_offset: Added to each step's reward to keep QD scores positive.
        robot: Spec of the robot inside. ``base`` gets it if it has an argument
            ``robot``. Otherwise it replaces the robot that ``base`` makes, as
            ``env.with_robot`` does. ``FEET_NAMES`` and ``COG_NAMES`` use it. ``None``:
            the robot ``base_name`` of the suite, if there is one.
        replace: Whether ``env_name`` may be a name that was registered before, as in a
            notebook whose cells run again. Environments of the suite stay.
        **options: Keyword arguments of ``base``. ``create`` may replace them.

    Raises:
        TypeError: An argument has the wrong type, or ``base`` does not take an option
            or makes no environment.
        ValueError: The name is in use, a name is not text, is empty or has characters
            that are not allowed, or ``reward_offset`` is not finite.
    """
    check_names(env_name, base_name, replace)
    checks.function("base", base, "a class or a function")
    check_class(base)
    checks.instance("robot", robot, RobotSpec, ROBOT, optional=True)
    checks.number("reward_offset", reward_offset, optional=True)
    check_wrappers(wrappers)
    described = descriptor_specs(descriptor)
    if descriptor_extractor is None and described:
        descriptor_extractor = getattr(
            described[0].wrapper, "descriptor_extractor", None
        )
    check_extractor_arguments(descriptor_extractor)
    if robot is not None and takes_robot(base):
        options = {"robot": robot, **options}
    if options:
        _require_keywords(env_name, base, options)
    check_made(base, options)
    tasks.ENVIRONMENTS[env_name] = EnvironmentSpec(
        functools.partial(base, **options) if options else base,
        env_name if base_name is None else base_name,
        (*wrappers, *described),
        descriptor_extractor,
        reward_offset,
        robot=robot,
    )


def create(
    env_name: str,
    episode_length: int | None = 1000,
    action_repeat: int = 1,
    auto_reset: bool = True,
    batch_size: int | None = None,
    eval_metrics: bool = False,
    fixed_init_state: bool = False,
    qdax_wrappers_kwargs: Sequence[Mapping[str, object]] | None = None,
    material: Material | None = None,
    brax_views: bool = False,
    robot: RobotSpec | None = None,
    **kwargs: object,
) -> Env:
    """Builds an environment by its name.

    Args:
        env_name: One of ``registered_envs()``.
        episode_length: Control steps of an episode; ``None``: no limit.
        action_repeat: Control steps for each action.
        auto_reset: Whether a step that ends an episode returns the state of the last
            reset, from which the next episode begins.
        batch_size: Number of worlds of a reset; ``None`` or 0: one world, without a
            batch axis.
        eval_metrics: Whether ``info`` sums the metrics of episodes.
        fixed_init_state: Whether a reset has no noise.
        qdax_wrappers_kwargs: Keyword arguments for each wrapper of the environment's
            spec. They replace the arguments in the spec.
        material: Softness of contacts and limits; ``None``: as in the robot's spec.
        brax_views: Whether to add ``state.qp`` and ``env.sys`` for code for brax v1.
            Without physics there are none.
        robot: Another robot for the task, such as a damaged one: see
            ``env.with_robot``. A base with an argument ``robot``, or with any keyword
            arguments, gets it instead. ``None``: that of the environment.
        **kwargs: Options of the environment inside, such as ``dtype``.

    Returns:
        The environment.

    Raises:
        UnknownEnvironment: ``env_name`` is not registered.
        TypeError: An argument has the wrong type, or a keyword argument is unknown.
        ValueError: A value or a combination of values is not allowed.
        NotImplementedError: ``material`` or ``robot`` is given, and the environment
            has no physics.
    """
    spec = _spec(env_name)
    checks.flag("auto_reset", auto_reset)
    checks.flag("eval_metrics", eval_metrics)
    checks.flag("fixed_init_state", fixed_init_state)
    checks.flag("brax_views", brax_views)
    options = _wrapper_options(env_name, spec, qdax_wrappers_kwargs)
    if episode_length is None and (action_repeat != 1 or eval_metrics):
        given = Fact(
            f"None with action_repeat={action_repeat!r}, eval_metrics={eval_metrics!r}"
        )
        allowed = "an episode length, or None with 1 and False"
        raise ValueError(message("episode_length", given, allowed))
    checks.integer("batch_size", batch_size, least=0, optional=True)
    env = _base(env_name, spec, robot, material, kwargs)
    if fixed_init_state:
        fixed = (
            brax.FixedInitialStateWrapper if brax_views else FixedInitialStateWrapper
        )
        env = fixed(env, spec.base_name)
    for wrapper_spec, chosen in zip(spec.wrappers, options, strict=True):
        env = wrapper_spec.wrapper(env, spec.base_name, **chosen)
        if isinstance(env, DescriptorWrapper):
            jax.eval_shape(env.reset, random_key())  # checks what ``describe`` returns
    if episode_length is not None:
        env = EpisodeWrapper(env, episode_length, action_repeat)
    if batch_size:
        env = VectorWrapper(env, batch_size)
    if auto_reset:
        env = AutoResetWrapper(env)
    if eval_metrics:
        env = CompletedEvalWrapper(EvalWrapper(env))
    if brax_views:
        env = brax.BraxViewsWrapper(env)
    vars(env)[REGISTERED] = env_name
    return env


def create_fn(env_name: str, **kwargs: Any) -> Callable[..., Env]:
    """Returns ``create`` with these arguments; does not build the environment yet."""
    return functools.partial(create, env_name, **kwargs)


def _spec(env_name: str) -> EnvironmentSpec:
    """Returns the spec of an environment.

    Raises:
        UnknownEnvironment: The name is not registered.
    """
    spec = tasks.ENVIRONMENTS.get(env_name) if isinstance(env_name, str) else None
    if spec is None:
        raise UnknownEnvironment(env_name, registered_envs())
    return spec


def _base(
    env_name: str,
    spec: EnvironmentSpec,
    robot: RobotSpec | None,
    material: Material | None,
    options: Mapping[str, Any],
) -> Env:
    """Returns the environment inside all wrappers.

    Raises:
        TypeError: ``robot`` or ``material`` has a wrong type, an option is unknown, the
            robot is missing, or a method does not return an array.
        ValueError: A method returns a wrong shape, or the robot does not fit.
    """
    allowed = "newton_qd.robots.Material"
    checks.instance("material", material, Material, allowed, optional=True)
    takes = takes_robot(spec.base) or (robot is not None and takes_any(spec.base))
    if not takes:
        checks.instance("robot", robot, RobotSpec, ROBOT, optional=True)
    elif robot is not None:
        options = {**options, "robot": robot}
    _require_keywords(env_name, spec.base, options)
    if "robot" not in options and needs_robot(spec.base):
        why = f"and {getattr(spec.base, '__name__', 'base')} needs a robot"
        allowed = "a newton_qd.robots.RobotSpec, as robot=... of register or of create"
        raise TypeError(message("robot", None, allowed, why=why))
    env = spec.base(**options)
    if not isinstance(env, Env):
        why = f"which {env_name!r} makes"
        raise TypeError(message("base", env, ENVIRONMENT, why=why))
    if not takes:
        env = _on_robot(env, robot, spec.robot)
    check_methods(env)
    return env if material is None else env.with_material(material)


def _on_robot(env: Env, robot: RobotSpec | None, registered: RobotSpec | None) -> Env:
    """Returns the environment with the robot of ``create``, or else of ``register``.

    Raises:
        NotImplementedError: The environment is not a simulated robot.
        ValueError: The robot has other joints or actuators.
    """
    if robot is not None:
        return env.with_robot(robot)
    made = getattr(env.unwrapped, "robot", None)
    if registered is None or not isinstance(made, RobotSpec):
        return env
    # the base may have chosen another softness, and the number of substeps
    chosen = {"material": registered.material, "substeps": registered.substeps}
    same = dataclasses.replace(made, **chosen) == registered
    return env if same else env.with_robot(registered)


def _require_keywords(
    env_name: str, base: Callable[..., Env], given: Mapping[str, Any]
) -> None:
    """Checks the keyword arguments of the environment inside.

    Raises:
        TypeError: One of them is unknown.
    """
    if takes_any(base):
        return
    parameters = inspect.signature(base).parameters.values()
    allowed = [p.name for p in parameters if p.kind is not p.POSITIONAL_ONLY]
    for name in given:
        if name not in allowed:
            why = f"which is not an argument of {env_name!r}"
            known = f"those of create, and {listed(allowed, 'no other')}"
            raise TypeError(message(name, given[name], known, why=why))


def _wrapper_options(
    env_name: str,
    spec: EnvironmentSpec,
    given: Sequence[Mapping[str, Any]] | None,
) -> list[Mapping[str, Any]]:
    """Returns the keyword arguments of each wrapper of a spec.

    Raises:
        TypeError: They are not a sequence of dictionaries, or a wrapper does not take
            an argument.
        ValueError: Their number is not the number of wrappers.
    """
    if given is None:
        return [wrapper_spec.options for wrapper_spec in spec.wrappers]
    rows = isinstance(given, Sequence) and all(isinstance(x, Mapping) for x in given)
    if not rows:
        allowed = "None, or a sequence of dictionaries, one for each wrapper"
        raise TypeError(message("qdax_wrappers_kwargs", given, allowed))
    if len(given) != len(spec.wrappers):
        names = [
            getattr(wrapper_spec.wrapper, "__name__", repr(wrapper_spec.wrapper))
            for wrapper_spec in spec.wrappers
        ]
        allowed = f"None, or {len(names)} for {env_name!r} "
        allowed += f"({listed(names, 'no wrapper')})"
        count = Fact(f"{len(given)} entries")
        raise ValueError(message("qdax_wrappers_kwargs", count, allowed))
    for index, wrapper_spec in enumerate(spec.wrappers):
        wrapper_spec.check_options(f"qdax_wrappers_kwargs[{index}]", given[index])
    return list(given)
