"""The algorithms of ``evolve``.

One file has one algorithm: its options with their defaults, the defaults that depend on
the environment, and the function that makes its emitter for QDax. The file exports one
``AlgorithmSpec``. ``ALGORITHMS`` lists them; ``register_algorithm`` adds one. The
command line and the documentation are generated from this list, which does not import
JAX. All genotypes are weight vectors (size,).
"""

from __future__ import annotations

from typing import Any

from newton_qd import checks
from newton_qd.checks import listed, message
from newton_qd.qd.algorithms.ascii_me import ASCII_ME, ASCII_ME_EXACT
from newton_qd.qd.algorithms.cma_maega import CMA_MAEGA
from newton_qd.qd.algorithms.cma_maega_actor_critic import CMA_MAEGA_ACTOR_CRITIC
from newton_qd.qd.algorithms.cma_me import CMA_ME
from newton_qd.qd.algorithms.cma_mega import CMA_MEGA
from newton_qd.qd.algorithms.dcrl_me import DCRL_ME
from newton_qd.qd.algorithms.me import ME
from newton_qd.qd.algorithms.me_actor_critic import ME_ACTOR_CRITIC
from newton_qd.qd.algorithms.me_ascent import ME_ASCENT
from newton_qd.qd.algorithms.me_conditioned import ME_CONDITIONED
from newton_qd.qd.algorithms.me_es import ME_ES
from newton_qd.qd.algorithms.me_gradient import ME_GRADIENT
from newton_qd.qd.algorithms.omg_mega import OMG_MEGA
from newton_qd.qd.algorithms.options import check_fields
from newton_qd.qd.algorithms.pga_me import PGA_ME
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext
from newton_qd.qd.config import ConfigError

__all__ = [
    "ALGORITHMS",
    "AlgorithmSpec",
    "EmitterContext",
    "algorithm_named",
    "algorithms",
    "register_algorithm",
]

ALGORITHMS: tuple[AlgorithmSpec[Any], ...] = (
    ME,
    CMA_ME,
    PGA_ME,
    DCRL_ME,
    ME_ES,
    ASCII_ME,
    ME_GRADIENT,
    ME_ASCENT,
    ASCII_ME_EXACT,
    ME_ACTOR_CRITIC,
    ME_CONDITIONED,
    OMG_MEGA,
    CMA_MEGA,
    CMA_MAEGA,
    CMA_MAEGA_ACTOR_CRITIC,
)
"""The algorithms of ``evolve`` that come with the package."""

_REGISTERED: dict[str, AlgorithmSpec[Any]] = {}


def algorithms() -> tuple[AlgorithmSpec[Any], ...]:
    """Returns the algorithms of the package, then the registered ones."""
    return (*ALGORITHMS, *_REGISTERED.values())


def register_algorithm(spec: AlgorithmSpec[Any], *, replace: bool = False) -> None:
    """Adds an algorithm to ``evolve``.

    Args:
        spec: The algorithm: a name, a function that makes an emitter for QDax, and a
            dataclass of its options.
        replace: Whether the name may be one that was registered before, as in a
            notebook whose cells run again. Algorithms of the library stay.

    Raises:
        TypeError: ``spec`` is not an ``AlgorithmSpec``, its functions cannot be called,
            its options are no dataclass, or a field of them has a type that an option
            cannot have.
        ValueError: The name is in use, or is not text.
    """
    checks.instance("spec", spec, AlgorithmSpec, "an AlgorithmSpec")
    checks.text("spec.name", spec.name)
    allowed = "a function of a context and options that makes an emitter"
    checks.function("spec.make", spec.make, allowed)
    allowed = "a function that makes a scoring function"
    checks.function("spec.scoring", spec.scoring, allowed, optional=True)
    allowed = "a function of settings and options that counts episodes"
    for name in ("evaluations", "gradients", "from_one_start"):
        optional = name != "evaluations"
        count = getattr(spec, name)
        checks.function(f"spec.{name}", count, allowed, optional=optional)
    allowed = "a function of options that returns a factor"
    checks.function("spec.initial_scale", spec.initial_scale, allowed)
    check_fields(spec.options)
    checks.flag("replace", replace)
    library = [known.name for known in ALGORITHMS]
    if spec.name in library or (spec.name in _REGISTERED and not replace):
        allowed = "a new name, or replace=True"
        if spec.name in library:
            allowed = f"any name but {listed(library)}"
        why = "which is taken"
        raise ValueError(message("spec.name", spec.name, allowed, why=why))
    _REGISTERED[spec.name] = spec


def algorithm_named(name: str) -> AlgorithmSpec[Any]:
    """Returns the algorithm with a name.

    Raises:
        ConfigError: No algorithm has this name.
    """
    for spec in algorithms():
        if spec.name == name:
            return spec
    names = listed([spec.name for spec in algorithms()])
    names += "; and those that register_algorithm adds (--module NAME)"
    raise ConfigError(message("algorithm", name, names, why="which does not exist"))
