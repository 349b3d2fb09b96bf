"""Errors of a field by the unseen: objects beyond the edge of its image.

- changes of a field by objects there: `edge_changes`
- the sides of the image that they come from: `edge_sides`, in words `edge_doubt`

An image fixes the divergence of the displacement inside it, but not the flux that crosses its edge.
To first order, the potential of sources beyond the edge, which is harmonic inside, may be added to
any answer.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.fft import dct, idct

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.facts import percent
from napari_shadowinv.physics.poisson import border_mean, potential_of_slopes

SIDES = ("top", "bottom", "left", "right")


def edge_changes(
    potential: FloatArray, displacement: FloatArray, spacing: float = 1.0
) -> FloatArray:
    """Independent changes of a field, of one standard deviation each, by objects beyond its edge.

    Of potential, (H, W) in px², of at least 4 by 4 points with a spacing in px, and displacement,
    its negative gradient, (2, H, W) in px. Returns changes of the potential and of the
    displacement's components, (8, 3, H, W).

    Opposite assumptions are made of it. The first lets no flux cross the edge, as if the object
    went on as its mirror image; the others make the potential constant along one edge, or the mean
    of it alike along opposite edges, as if it went on there as its mirror image of opposite sign. A
    field that ends inside the image satisfies them all, so none changes it. Objects beyond the edge
    that are like those inside add a field as strong as the mirror image's, of either sign: so the
    variance of any answer, whatever its own boundary, is the sum of the squares, weighted by how
    likely each assumption is.

    The last change is by flux that leaves on all sides, which looks like another exposure: along
    the edge the image is then brighter or darker than its source. It is at most as large as the
    field.
    """
    outflow, opposite = np.zeros(potential.shape), np.zeros((6, *potential.shape))
    shares = []
    contrast = sum(np.gradient(part, axis=axis) for axis, part in enumerate(displacement))
    for side, plane in enumerate(opposite[:4]):
        axis, is_last = divmod(side, 2)
        inwards, edges, flipped, values, source = (
            np.moveaxis(each, axis, 0)[:: -1 if is_last else 1]
            for each in (displacement[axis], outflow, plane, potential, contrast)
        )
        share = _changed_share(source, values[0])
        at_edge = (source[1:4] ** 2).mean() / max((source**2).mean(), 1e-300)
        shares.append(share * min(1.0, float(at_edge)))
        # Half a pixel outside the outermost points.
        normal = (1.5 * inwards[0] - 0.5 * inwards[1]) * np.sqrt(1 - share)
        edges[0] += normal if is_last else -normal
        flipped[:] = np.sqrt(share) * _held_at_edge(values[0], len(values))
    for axis, plane in enumerate(opposite[4:]):
        values, across = np.moveaxis(potential, axis, 0), np.moveaxis(plane, axis, 0)
        step = (values[0].mean() - values[-1].mean()) * np.sqrt(
            min(shares[2 * axis : 2 * axis + 2])
        )
        across[:] = step * np.linspace(-0.5, 0.5, len(across))[:, None]
    turned_back = potential_of_slopes(spacing * outflow)
    leaving = _divergence_at_edge(displacement, spacing) * _even_source(potential.shape, spacing)
    planes = turned_back, *opposite, leaving
    changes = np.empty((len(planes), 3, *potential.shape))
    for change, plane in zip(changes, planes, strict=True):
        change[0] = plane
        change[1], change[2] = np.gradient(plane, -spacing)
    largest = np.sqrt((displacement**2).sum() / max((changes[-1, 1:] ** 2).sum(), 1e-300))
    changes[-1] *= min(1.0, float(largest))
    return changes


def _held_at_edge(values: FloatArray, depth: int) -> FloatArray:
    """Return the harmonic potential, (depth, n), that takes values away along the first row.

    No flux crosses the other edges.
    """
    waves = dct(values - values.mean(), norm="ortho")
    rates = 2 * np.arcsinh(np.sin(np.pi / 2 * np.arange(len(values)) / len(values)))
    z = np.arange(depth)[:, None]
    decay = np.exp(-rates * z) + np.exp(-rates * (2 * depth - 1 - z))
    return np.asarray(-idct(waves * decay / decay[0], norm="ortho", axis=1))


def _changed_share(contrast: FloatArray, potential: FloatArray) -> float:
    """Return the weight, up to half, of an object of opposite sign beyond an edge.

    Its effect falls off as exp(-z / w) with the distance z from the edge to where it begins, w
    being the length over which the potential varies along the edge. It begins anywhere within the
    depth over which the contrast, (H, W) from the edge inwards, resembles that at the edge.
    """
    strip = contrast[1:4].mean(axis=0)
    unlike = contrast[1:] @ strip < (strip @ strip) / 2
    depth = 1 + (int(unlike.argmax()) if unlike.any() else len(unlike))
    values = potential - potential.mean()
    width = np.sqrt((values**2).sum() / max((np.diff(values) ** 2).sum(), 1e-300))
    ratio = min(2 * depth / max(width, 1e-300), 1e3)
    return float(-np.expm1(-ratio) / (2 * max(ratio, 1e-9)))


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

    The sums, (H, W), of the squares of `edge_changes` are averaged in a strip along each side,
    whose width is a share of the shorter one; a side counts from a share of the largest mean on.
    """
    width = max(1, round(strip * min(squares.shape)))
    strips = squares[:width], squares[-width:], squares[:, :width], squares[:, -width:]
    means = [float(each.mean()) for each in strips]
    return tuple(
        side for side, mean in zip(SIDES, means, strict=True) if mean >= share * max(means)
    )


LARGER_FIELD = "record a larger field of view"
"""The advice about an object that goes on beyond the image."""


def edge_doubt(error: float, others: float, largest: float, sides: Sequence[str]) -> str:
    """Return in words how much of a field rests on objects beyond its sides; "" if it is little.

    The errors are shares of the field, by the edge and by all `others`: those that are half as
    large move a field at the edge by chance. Errors up to `largest` need no words; the sides are of
    `SIDES`.

    >>> edge_doubt(0.4, 0.1, 0.05, ["left", "right"])[:80]
    '40 % of the displacement (r.m.s.) rests on what lies beyond the left and right e'
    >>> edge_doubt(0.4, 0.3, 0.05, ["left"])
    ''
    """
    if error <= max(largest, 2 * others):
        return ""
    return (
        f"{percent(error)} of the displacement (r.m.s.) rests on what lies {beyond_sides(sides)}: "
        f"{LARGER_FIELD}, or compare closed and free boundaries"
    )


def beyond_sides(sides: Sequence[str]) -> str:
    """Return in words where an object goes on.

    >>> beyond_sides(["top", "left"]), beyond_sides(SIDES)
    ('beyond the top and left edges', 'beyond the image, on all sides')
    """
    if len(sides) == len(SIDES):
        return "beyond the image, on all sides"
    *first, last = sides
    return f"beyond the {', '.join(first)} and {last} edges" if first else f"beyond the {last} edge"
