"""Deprecated functions; use :class:`~newton_qd.gradients.Episode` instead.

They keep their names, arguments and results. Each calls a method of an ``Episode``.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

from newton_qd.gradients.episode import Episode, itself
from newton_qd.gradients.exact import DirectionalGradient, EpisodeGradient
from newton_qd.gradients.flow import EXACT, GradientOptions
from newton_qd.gradients.mixed import MixedGradients, check_mixture
from newton_qd.types import (
    DescriptorExtractor,
    Environment,
    Genotype,
    PolicyFunction,
    PyTree,
    RNGKey,
)


def make_episode(
    env: Environment,
    policy: PolicyFunction | None,
    descriptor_extractor: DescriptorExtractor | None,
    *,
    episode_length: int,
    unravel: Callable[[Genotype], PyTree] = itself,
    options: GradientOptions | None = None,
    transitions: bool = False,
) -> Episode:
    """Makes an episode. Deprecated: use :class:`~newton_qd.gradients.Episode`.

    Args:
        env: As for ``Episode``, like all other arguments.
        policy: Maps parameters and an observation to an action, or ``None``.
        descriptor_extractor: Computes the descriptor of an episode, or ``None``.
        episode_length: Control steps.
        unravel: Maps a genotype to the parameters.
        options: Windows, clipping, discounting and memory of the gradient; ``None``:
            exact, and all intermediate values are stored.
        transitions: Whether to return the steps.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: ``episode_length`` is not an integer from 1.
    """
    if options is None:
        options = GradientOptions(checkpoint_every=None)
    return Episode(
        env,
        policy,
        descriptor_extractor,
        episode_length=episode_length,
        options=options,
        unravel=unravel,
        transitions=transitions,
    )


def make_episode_gradient(
    env: Environment,
    policy: PolicyFunction | None,
    descriptor_extractor: DescriptorExtractor | None,
    *,
    episode_length: int,
    unravel: Callable[[Genotype], PyTree] = itself,
    options: GradientOptions | None = None,
) -> EpisodeGradient:
    """Returns ``Episode.gradient``. Deprecated: use ``Episode(...).gradient``.

    Args:
        env: As for :class:`~newton_qd.gradients.Episode`, like all other arguments.
        policy: Maps parameters and an observation to an action, or ``None``.
        descriptor_extractor: Computes the descriptor of an episode, or ``None``.
        episode_length: Control steps.
        unravel: Maps a genotype to the parameters.
        options: Windows, clipping, discounting and memory; ``None``: exact, with one
            stored state per control step.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: ``episode_length`` is not an integer from 1.
    """
    return Episode(
        env,
        policy,
        descriptor_extractor,
        episode_length=episode_length,
        options=EXACT if options is None else options,
        unravel=unravel,
    ).gradient


def make_directional_gradient(
    env: Environment,
    policy: PolicyFunction | None,
    descriptor_extractor: DescriptorExtractor,
    *,
    episode_length: int,
    unravel: Callable[[Genotype], PyTree] = itself,
    options: GradientOptions | None = None,
) -> DirectionalGradient:
    """Returns ``Episode.directional``. Deprecated: use ``Episode(...).directional``.

    Args:
        env: As for :class:`~newton_qd.gradients.Episode`, like all other arguments.
        policy: Maps parameters and an observation to an action, or ``None``.
        descriptor_extractor: Computes the descriptor of an episode.
        episode_length: Control steps.
        unravel: Maps a genotype to the parameters.
        options: Windows, clipping, discounting and memory; ``None``: exact.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: ``episode_length`` is not an integer from 1.
    """
    return Episode(
        env,
        policy,
        descriptor_extractor,
        episode_length=episode_length,
        options=EXACT if options is None else options,
        unravel=unravel,
    ).directional


def make_mixed_gradient(
    env: Environment,
    policy: PolicyFunction | None,
    descriptor_extractor: DescriptorExtractor | None,
    *,
    episode_length: int,
    unravel: Callable[[Genotype], PyTree] = itself,
    options: GradientOptions | None = None,
    samples: int = 16,
    sigma: float = 0.02,
    tolerance: float = math.inf,
) -> Callable[[Genotype, RNGKey], MixedGradients]:
    """Returns ``Episode.mixed`` with settings. Deprecated: use ``Episode(...).mixed``.

    Args:
        env: As for :class:`~newton_qd.gradients.Episode`, like all other arguments.
        policy: Maps parameters and an observation to an action, or ``None``.
        descriptor_extractor: Computes the descriptor of an episode, or ``None``.
        episode_length: Control steps.
        unravel: Maps a genotype to the parameters.
        options: Windows, clipping, discounting and memory of the first order.
        samples: Pairs of samples for each genotype, at least 2.
        sigma: Standard deviation of the noise, in the units of the genotype.
        tolerance: Allowed error if the two orders disagree.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: A number is out of its range.
    """
    check_mixture(samples, sigma, tolerance)
    episode = Episode(
        env,
        policy,
        descriptor_extractor,
        episode_length=episode_length,
        options=EXACT if options is None else options,
        unravel=unravel,
    )
    return functools.partial(
        episode.mixed, samples=samples, sigma=sigma, tolerance=tolerance
    )
