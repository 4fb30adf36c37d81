"""Functions that :class:`~newton_qd.gradients.Episode` has taken the place of.

They keep their names, arguments and results; each is a method of an ``Episode``.
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
    Policy,
    PyTree,
    RNGKey,
)


def make_episode(
    env: Environment,
    policy: Policy | None,
    descriptor_extractor: DescriptorExtractor | None,
    *,
    episode_length: int,
    unravel: Callable[[Genotype], PyTree] = itself,
    options: GradientOptions | None = None,
    transitions: bool = False,
) -> Episode:
    """Makes an episode. Deprecated: use :class:`~newton_qd.gradients.Episode`.

    Args:
        env: As of ``Episode``; so are all others.
        policy: Maps parameters and an observation to an action, or ``None``.
        descriptor_extractor: Reads the descriptor of an episode, or ``None``.
        episode_length: Control steps.
        unravel: Maps a genotype to the parameters.
        options: What becomes of the gradient on its way back; ``None``: exact, and
            every intermediate is kept.
        transitions: Whether to return the steps.

    Raises:
        TypeError: ``env`` is no environment, or another argument of another type.
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
    policy: Policy | None,
    descriptor_extractor: DescriptorExtractor | None,
    *,
    episode_length: int,
    unravel: Callable[[Genotype], PyTree] = itself,
    options: GradientOptions | None = None,
) -> EpisodeGradient:
    """Returns ``Episode.gradient``. Deprecated: use ``Episode(...).gradient``.

    Args:
        env: As of :class:`~newton_qd.gradients.Episode`; so are all others.
        policy: Maps parameters and an observation to an action, or ``None``.
        descriptor_extractor: Reads the descriptor of an episode, or ``None``.
        episode_length: Control steps.
        unravel: Maps a genotype to the parameters.
        options: Windows, clipping, discounting and memory; ``None``: exact, one state
            kept per control step.

    Raises:
        TypeError: ``env`` is no environment, or another argument of another type.
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
    policy: Policy | None,
    descriptor_extractor: DescriptorExtractor,
    *,
    episode_length: int,
    unravel: Callable[[Genotype], PyTree] = itself,
    options: GradientOptions | None = None,
) -> DirectionalGradient:
    """Returns ``Episode.directional``. Deprecated: use ``Episode(...).directional``.

    Args:
        env: As of :class:`~newton_qd.gradients.Episode`; so are all others.
        policy: Maps parameters and an observation to an action, or ``None``.
        descriptor_extractor: Reads the descriptor of an episode.
        episode_length: Control steps.
        unravel: Maps a genotype to the parameters.
        options: Windows, clipping, discounting and memory; ``None``: exact.

    Raises:
        TypeError: ``env`` is no environment, or another argument of another type.
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
    policy: Policy | None,
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
        env: As of :class:`~newton_qd.gradients.Episode`; so are all others.
        policy: Maps parameters and an observation to an action, or ``None``.
        descriptor_extractor: Reads the descriptor of an episode, or ``None``.
        episode_length: Control steps.
        unravel: Maps a genotype to the parameters.
        options: Windows, clipping, discounting and memory of the first order.
        samples: Pairs of samples of a genotype, from 2.
        sigma: Standard deviation of the noise, in the units of the genotype.
        tolerance: Error that is allowed where the two orders disagree.

    Raises:
        TypeError: ``env`` is no environment, or another argument of another type.
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
