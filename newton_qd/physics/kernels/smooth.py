"""Compact, twice differentiable one-sided functions."""

import warp as wp

from . import real


@wp.func
def penetration(gap: real, width: real):
    """Smooth ``max(-gap, 0)``: exact outside ``|gap| < width``."""
    x = real(0.0)
    if gap <= -width:
        x = -gap
    elif gap < width:
        u = width - gap
        x = u * u * u * (real(3.0) * width + gap) / (real(16.0) * width * width * width)
    return x


@wp.func
def gate(gap: real, width: real):
    """Slope ``-d penetration / d gap``, between 0 and 1."""
    g = real(0.0)
    if gap <= -width:
        g = real(1.0)
    elif gap < width:
        u = width - gap
        g = u * u * (real(2.0) * width + gap) / (real(4.0) * width * width * width)
    return g
