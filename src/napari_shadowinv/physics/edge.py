"""Errors of a field by the unseen: objects beyond the edge of its image.

- changes of a field by what may lie there: `edge_changes`
- the sides of the image that they come from: `edge_sides`, in words `edge_doubt`

An image fixes the divergence of the displacement inside it, but not the flux that crosses its edge.
To first order, the potential of sources beyond the edge, which is harmonic inside, may be added to
any answer.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.fft import dstn, idstn

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.facts import percent
from napari_shadowinv.physics.poisson import border_mean, potential_of_slopes

SIDES = ("top", "bottom", "left", "right")


def edge_changes(
    potential: FloatArray, displacement: FloatArray, spacing: float = 1.0
) -> FloatArray:
    """Independent changes of a field, of one standard deviation each, by what lies beyond its edge.

    Two opposite assumptions are made of it. The first lets no flux cross the edge, as if the object
    went on as its mirror image; the second makes the potential constant along the edge, as if it
    went on as its mirror image of opposite sign. A field that ends inside the image satisfies both,
    so neither changes it. Objects beyond the edge that are like those inside add a field as strong
    as the mirror image's. With half the sum of both changes nothing lies beyond, and half their
    difference is the field of the mirror image: so the variance of any answer, whatever its own
    boundary, is the mean of their squares.

    The third change is by flux that leaves on all sides, which looks like another exposure: along
    the edge the image is then brighter or darker than its source. It is at most as large as the
    field.

    Parameters
    ----------
    potential : ndarray, shape (H, W)
        In px², of at least 4 by 4 points.
    displacement : ndarray, shape (2, H, W)
        Its negative gradient, px.
    spacing : float, default 1
        Distance between the points, px.

    Returns
    -------
    ndarray of float64, shape (3, 3, H, W)
        The changes of the potential, px², and of the displacement's components, px.
    """
    outflow = np.zeros(potential.shape)
    for axis, part in enumerate(displacement):
        inwards, edges = np.moveaxis(part, axis, 0), np.moveaxis(outflow, axis, 0)
        # Half a pixel outside the outermost points.
        edges[0] -= 1.5 * inwards[0] - 0.5 * inwards[1]
        edges[-1] += 1.5 * inwards[-1] - 0.5 * inwards[-2]
    turned_back = potential_of_slopes(spacing * outflow)
    # Sines vanish at the border, whose values act on the points next to it.
    held = border_mean(potential) - potential
    by_border = np.zeros([side - 2 for side in held.shape])
    by_border[0] += held[0, 1:-1]
    by_border[-1] += held[-1, 1:-1]
    by_border[:, 0] += held[1:-1, 0]
    by_border[:, -1] += held[1:-1, -1]
    rows, columns = (2 - 2 * np.cos(np.pi * np.arange(1, n - 1) / (n - 1)) for n in held.shape)
    held[1:-1, 1:-1] = idstn(dstn(by_border, type=1) / (rows[:, None] + columns), type=1)
    leaving = _divergence_at_edge(displacement, spacing) * _even_source(held.shape, spacing)
    planes = turned_back / np.sqrt(2), held / np.sqrt(2), leaving
    changes = np.array([[each, *-np.array(np.gradient(each, spacing))] for each in planes])
    largest = np.sqrt((displacement**2).sum() / max((changes[2, 1:] ** 2).sum(), 1e-300))
    changes[2] *= min(1.0, float(largest))
    return changes


def _divergence_at_edge(
    displacement: FloatArray, spacing: float, depth: float = 1 / 32, count: int = 32
) -> float:
    """Divergence that three quarters of `count` stretches of the edge reach, or else 0.

    They are as deep as a share of the shorter side.
    """
    along_y, along_x = (np.gradient(part, spacing, axis=k) for k, part in enumerate(displacement))
    rows, width = along_y + along_x, max(1, round(depth * min(along_y.shape)))
    ends = slice(width), slice(-width, None)
    lines = [plane[end].mean(axis=0) for plane in (rows, rows.T) for end in ends]
    along = np.concatenate(lines)
    means = [part.mean() for part in np.array_split(along, min(count, along.size))]
    low, high = np.quantile(means, [0.25, 0.75])
    return float(max(low, 0.0) + min(high, 0.0))


def _even_source(shape: tuple[int, ...], spacing: float) -> FloatArray:
    """Potential, px², with a divergence of -1 and the same inflow all along the edge."""
    y, x = (spacing * (np.arange(n) - (n - 1) / 2) for n in shape)
    height, width = shape
    square = (width * y[:, None] ** 2 + height * x**2) / (2 * (height + width))
    return np.asarray(square - border_mean(square))


def edge_sides(squares: FloatArray, strip: float = 0.1, share: float = 0.25) -> tuple[str, ...]:
    """Return the sides near which squared changes are largest.

    Parameters
    ----------
    squares : ndarray, shape (H, W)
        Sums of the squares of `edge_changes`.
    strip : float, default 0.1
        Width of the strip along each side, as a share of the shorter one.
    share : float, default 0.25
        Least mean in a strip, as a share of the largest.
    """
    width = max(1, round(strip * min(squares.shape)))
    strips = squares[:width], squares[-width:], squares[:, :width], squares[:, -width:]
    means = [float(each.mean()) for each in strips]
    return tuple(
        side for side, mean in zip(SIDES, means, strict=True) if mean >= share * max(means)
    )


def edge_doubt(error: float, others: float, largest: float, sides: Sequence[str]) -> str:
    """Return in words how much of a field rests on what lies beyond its sides; "" if it is little.

    Parameters
    ----------
    error, others : float
        Errors of the field by the edge, and by all else, as shares of it. Errors that are half as
        large move a field at the edge by chance.
    largest : float
        Largest error by the edge that needs no words.
    sides : sequence of str
        Where it comes from, of `SIDES`.

    Examples
    --------
    >>> edge_doubt(0.4, 0.1, 0.05, ["left", "right"])[:80]
    '40 % of the displacement (r.m.s.) rests on what lies beyond the left and right e'
    >>> edge_doubt(0.4, 0.3, 0.05, ["left"])
    ''
    """
    if error <= max(largest, 2 * others):
        return ""
    *first, last = sides
    listed = f"{', '.join(first)} and {last} edges" if first else f"{last} edge"
    where = f"beyond the {listed}" if len(sides) < len(SIDES) else "beyond the image, on all sides"
    return (
        f"{percent(error)} of the displacement (r.m.s.) rests on what lies {where}: record a "
        "larger field of view, or compare closed and free boundaries"
    )
