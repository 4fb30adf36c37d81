"""Descriptors of whole episodes, a row per episode; not on packs of worlds.

Inputs: the state descriptors (steps, nd), then the mask (steps,), 1 after the end of
the episode. The sums add in the order of :func:`newton_qd.extractors.folded_sum`, so
that the results are bitwise those of the extractors.
"""

import warp as wp

from . import scalar

wp.set_module_options({"enable_backward": False})


@wp.kernel
def proportion_forward(steps: int, nd: int, x: wp.array[scalar], y: wp.array[scalar]):
    """Mean over the valid steps: the first entry of each row (steps,) of ``y``.

    Reads: x, y.
    Writes: y.
    """
    k = wp.tid()
    w = k // nd
    at = w * steps * (nd + 1)
    mask = at + steps * nd
    out = k * steps
    total = scalar(0.0)
    for t in range(steps):
        valid = scalar(1.0) - x[mask + t]
        # after the end, a state descriptor may be anything, also nan
        value = scalar(0.0)
        if valid > scalar(0.0):
            value = x[at + t * nd + k - w * nd] * valid
        y[out + t] = value
        total += valid
    n = int(steps)
    while n > 1:
        half = n // 2
        for i in range(half):
            y[out + i] = y[out + i] + y[out + half + i]
        if n % 2 == 1:
            y[out + half] = y[out + 2 * half]
        n = n - half
    y[out] = y[out] / total


@wp.kernel
def proportion_backward(
    steps: int,
    nd: int,
    x: wp.array[scalar],
    y_bar: wp.array[scalar],
    x_bar: wp.array[scalar],
):
    """Adjoint of the mean with respect to the state descriptors.

    Reads: x, y_bar.
    Writes: x_bar.
    """
    k = wp.tid()
    w = k // nd
    at = w * steps * (nd + 1)
    mask = at + steps * nd
    total = scalar(0.0)
    for t in range(steps):
        total += scalar(1.0) - x[mask + t]
    for t in range(steps):
        valid = scalar(1.0) - x[mask + t]
        x_bar[at + t * nd + k - w * nd] = y_bar[k * steps] / total * valid
        x_bar[mask + t] = scalar(0.0)


@wp.func
def last_valid(steps: int, mask: int, x: wp.array[scalar]):
    """Last step before the end of the episode; without any, the last of all.

    Reads: x.
    """
    count = int(0)
    for t in range(steps):
        if x[mask + t] == scalar(0.0):
            count += 1
    if count == 0:
        count = steps
    return count - 1


@wp.kernel
def final_forward(steps: int, nd: int, x: wp.array[scalar], y: wp.array[scalar]):
    """State descriptor before the last valid step.

    Reads: x.
    Writes: y.
    """
    k = wp.tid()
    w = k // nd
    at = w * steps * (nd + 1)
    last = last_valid(steps, at + steps * nd, x)
    y[k] = x[at + last * nd + k - w * nd]


@wp.kernel
def final_backward(
    steps: int,
    nd: int,
    x: wp.array[scalar],
    y_bar: wp.array[scalar],
    x_bar: wp.array[scalar],
):
    """Adjoint of the last state descriptor.

    Reads: x, y_bar.
    Writes: x_bar.
    """
    k = wp.tid()
    w = k // nd
    at = w * steps * (nd + 1)
    mask = at + steps * nd
    last = last_valid(steps, mask, x)
    for t in range(steps):
        x_bar[at + t * nd + k - w * nd] = scalar(0.0)
        x_bar[mask + t] = scalar(0.0)
    x_bar[at + last * nd + k - w * nd] = y_bar[k]
