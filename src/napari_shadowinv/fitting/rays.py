"""Rays through potentials of cubic B-splines, and the images where they land: `RayModel`.

A ray that starts at x lands at x - ∇ψ(x), also where rays have crossed. Pixels are boxes, as those
of a camera: a ray counts in the pixel where it lands; near an edge it is shared with the
neighbour, smoothly, so that images neither ripple nor jump. The derivative of any function of the
image follows exactly, ray by ray.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_array

from napari_shadowinv._system.machine import available_threads, in_ranges, run_together
from napari_shadowinv._typing import AnyArray, FloatArray, IntArray
from napari_shadowinv.fitting import _ray_kernels as kernels
from napari_shadowinv.fitting._ray_kernels import KNOT, MOST_RAYS
from napari_shadowinv.physics.arrays import block_sums

_BANDS = 8  # of cells; each has an image of its own, so that threads do not change a sum
_GUARD = 2  # px around the detector, for rays that miss it


class Pulls(NamedTuple):
    """Derivatives with respect to a potential's coefficients, the beam and the frame."""

    potential: FloatArray
    beam: FloatArray
    frame: FloatArray


class TracedBeam(NamedTuple):
    """A beam behind a potential, as a detector sees it."""

    potential: FloatArray  # the coefficients
    counts: IntArray  # as `RayModel.ray_counts` returns them
    beam: FloatArray  # as `RayModel.around` returns it
    frame: FloatArray | None = None  # 6 numbers; by default the detector sees rays where they land


@dataclass(frozen=True)
class RayModel:
    """Image of a beam behind a potential, by ray tracing.

    A potential is an array of coefficients with `shape`, in px², of cubic B-splines with a knot
    every 2 px, or every one: the kernels then work in half pixels. A beam is the flux of each
    pixel, including the strip: `around` continues one from the image. A frame maps the landing
    point (y, x) to the detector: (f0 + f1 y + f2 x, f3 + f4 y + f5 x), in px from the image's
    middle. The result does not depend on the number of threads.
    """

    size: tuple[int, int]  # height and width of the image
    pad: int = 12  # width, even, of the strip around the image from which rays may enter, px
    beyond: int = 0  # width of a strip around the image that is evaluated, too, px
    spacing: float = 0.25  # largest distance between landing points of neighbouring rays, px
    knot: int = KNOT  # px between knots, or half as many
    threads: int | None = None  # all cores

    @property
    def _at_rest(self) -> int:
        """Rays along a cell's side where nothing stretches it."""
        count = math.ceil(self.knot / self.spacing - 1e-9)
        # They shall not land on the kinks of their shares.
        return count + (count % 4 == 2)

    @property
    def cells(self) -> tuple[int, int]:
        """Cells between knots along y and x, including the strip."""
        height, width = self.size
        rows, columns = math.ceil(height / KNOT) + self.pad, math.ceil(width / KNOT) + self.pad
        return self._parts * rows, self._parts * columns

    @property
    def _parts(self) -> int:
        """Pixels of the kernels along a pixel."""
        return KNOT // self.knot

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of a potential's coefficients."""
        rows, columns = self.cells
        return rows + 3, columns + 3

    @property
    def seen(self) -> tuple[int, int]:
        """Shape of an image with the strip."""
        return self.size[0] + 2 * self.beyond, self.size[1] + 2 * self.beyond

    def around(self, image: FloatArray) -> FloatArray:
        """Return a beam that goes on beyond an image's edge as at its edge."""
        rows, columns = (self.knot * n - self.pad - side for n, side in zip(self.cells, self.size))  # noqa: B905
        return np.pad(image, ((self.pad, rows), (self.pad, columns)), mode="edge")

    def ray_counts(self, potential: FloatArray) -> IntArray:
        """Return the rays along y and x that each cell needs to land so densely, (2, *cells)."""
        middle = potential[1:-1, 1:-1]
        yy = (potential[2:, 1:-1] - 2 * middle + potential[:-2, 1:-1]) / self.knot**2
        xx = (potential[1:-1, 2:] - 2 * middle + potential[1:-1, :-2]) / self.knot**2
        yx = potential[2:, 2:] - potential[2:, :-2] - potential[:-2, 2:] + potential[:-2, :-2]
        yx = yx / (2 * self.knot) ** 2
        stretch = np.stack([np.hypot(1 - yy, yx), np.hypot(1 - xx, yx)])
        # The curvature within a cell is a mean of that at its four corners.
        most = np.maximum(stretch[:, 1:], stretch[:, :-1])
        most = np.maximum(most[:, :, 1:], most[:, :, :-1])
        ray_counts = np.rint(np.maximum(most, 0.5) * self._at_rest).astype(np.int64)
        return np.asarray(np.minimum(ray_counts, MOST_RAYS))

    def image(self, traced: TracedBeam, fewest_rows: int = 200) -> FloatArray:
        """Return the flux that lands in each pixel, with the shape `seen`.

        Fewer rows are not worth a thread.
        """
        corners = np.zeros((_BANDS, 4 * math.prod(self._guarded)))
        reached = np.zeros((_BANDS, 2), np.int64)
        self._in_ranges(kernels.deposit, _BANDS, traced, corners, reached)
        image, width = np.zeros(self.seen), self._guarded[1]
        threads, sums = available_threads(self.threads), (corners, reached, width, _GUARD, image)
        in_ranges(kernels.add_corners, len(image), threads, *sums, smallest=fewest_rows)
        return image

    def gradient(
        self, traced: TracedBeam, pull: FloatArray, *, of_beam: bool = True, of_frame: bool = True
    ) -> Pulls:
        """Return the derivatives of ``(pull * image(traced)).sum()`` at fixed `counts`.

        The pull is a weight of each pixel, with the shape `seen`. Derivatives by beam and frame are
        zero unless they are wanted.
        """
        parts, (rows, columns) = self._parts, traced.beam.shape
        beam = np.zeros((parts * rows, parts * columns))
        pulls = Pulls(np.zeros((_BANDS, *self.shape)), beam, np.zeros((_BANDS, 6)))
        slopes = _slopes_between_pixels(np.pad(pull, _GUARD))
        sums = pulls.potential, pulls.beam, of_beam, pulls.frame, of_frame
        self._in_ranges(kernels.gather, _BANDS, traced, slopes, *sums)
        about_middle = self._about_middle(pulls.frame.sum(axis=0) / _lengths(parts))
        if parts > 1:
            beam = block_sums(beam, parts) / parts**2
        return Pulls(parts**2 * pulls.potential.sum(axis=0), beam, about_middle)

    def jacobian(
        self, traced: TracedBeam, *, of_beam: bool = True, of_frame: bool = True
    ) -> csr_array:
        """Return the derivatives of each pixel of the image at fixed `counts`, in single precision.

        A row for each pixel; columns, in no order, for the coefficients, the beam's pixels and the
        frame, of which the last two may be left out as in `gradient`.
        """
        reached = np.empty((*self.cells, 4), np.int64)
        self._in_ranges(kernels.boxes, len(reached), traced, reached)
        # The guard belongs to no pixel.
        first = np.maximum(reached[..., :2], _GUARD)
        behind = np.minimum(reached[..., 2:], np.array(self.seen) + _GUARD)
        reached = np.concatenate([first, behind], axis=2)
        areas = np.maximum(behind - first, 0).prod(axis=2)
        ends = np.cumsum(areas).reshape(areas.shape)
        instrument_columns, most = 4 * of_beam + 6 * of_frame, ends[-1, -1]
        used, pixels = np.zeros_like(ends), np.empty(most, np.int32)
        of_splines, of_instrument = np.empty((most, 16)), np.empty((most, instrument_columns))
        begins, lines = ends - areas, (used, pixels, of_splines, of_instrument)
        middle = self._parts * self._middle[0], self._parts * self._middle[1]
        places = begins, _GUARD, middle, (of_beam, of_frame)
        self._in_ranges(kernels.collect, len(reached), traced, reached, *places, *lines)
        rows = np.empty(math.prod(self.seen) + 1, np.int32)
        most = (16 + instrument_columns) * int(used.sum())
        columns, values = np.empty(most, np.int32), np.empty(most, np.float32)
        kernels.merge(begins, *lines, of_beam, rows, columns, values)
        entries: tuple[AnyArray, AnyArray] = values[: rows[-1]], columns[: rows[-1]]
        if self._parts > 1:
            entries = self._in_whole_pixels(traced, *entries)
        shape = (len(rows) - 1, traced.potential.size + traced.beam.size + 6)
        return csr_array((*entries, rows), shape=shape)

    def _in_whole_pixels(
        self, traced: TracedBeam, values: AnyArray, columns: AnyArray
    ) -> tuple[AnyArray, AnyArray]:
        """Values and columns of a Jacobian whose columns are in pixels of the kernels."""
        parts, whole = self._parts, np.arange(traced.beam.size).reshape(traced.beam.shape)
        pixels = whole.repeat(parts, axis=0).repeat(parts, axis=1).ravel()
        first, after = traced.potential.size, traced.potential.size + traced.beam.size
        scales = [np.full(first, parts**2), np.full(pixels.size, parts**-2), 1 / _lengths(parts)]
        numbers = [np.arange(first), first + pixels, after + np.arange(6)]
        scale, number = np.concatenate(scales), np.concatenate(numbers).astype(np.int32)
        return values * scale[columns].astype(np.float32), number[columns]

    def push(self, jacobian: csr_array, change: FloatArray) -> FloatArray:
        """Return a Jacobian times a change of its columns, (n,), with the shape `seen`."""
        out = np.empty(jacobian.shape[0])
        threads = available_threads(self.threads)
        in_ranges(kernels.rows_times, len(out), threads, _entries(jacobian), change, out)
        return out.reshape(self.seen)

    def pull(self, jacobian: csr_array, image: FloatArray) -> FloatArray:
        """Return the transpose of `push` times an image, (n,)."""
        out = np.zeros(jacobian.shape[1])
        kernels.transpose_times(_entries(jacobian), image.ravel(), out)
        return out

    def normal_times(
        self,
        jacobians: Sequence[csr_array],
        changes: Sequence[FloatArray],
        weights: Sequence[FloatArray],
        slopes: Sequence[FloatArray],
        lights: Sequence[FloatArray],
        parts: int = 2,
        fewest: int = 100_000,
    ) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return Jᵀ s w (s J v + l) and w (s J v + l) of each image, in one pass over J.

        The jacobians are J, the changes of their columns v; weights, slopes and lights are w, s and
        l, images with the shape `seen`. Each of the `parts` of a Jacobian's rows has sums of its
        own; a thread is worth its while from the `fewest` entries on.
        """
        pulls = [np.empty(self.seen) for _ in jacobians]
        totals = [np.zeros((parts, each.shape[1])) for each in jacobians]
        works = []
        for k, (jacobian, change) in enumerate(zip(jacobians, changes, strict=True)):
            images = [each[k].reshape(-1) for each in (weights, slopes, lights, pulls)]
            rows = jacobian.shape[0]
            for part in range(parts):
                bounds = rows * part // parts, rows * (part + 1) // parts
                arguments = *bounds, _entries(jacobian), change, *images, totals[k][part]
                works.append(partial(kernels.normal_times, *arguments))
        threads = available_threads(self.threads)
        run_together(works, threads if jacobians[0].nnz > fewest else 1)
        return [total.sum(axis=0) for total in totals], pulls

    def displacement(self, potential: FloatArray) -> FloatArray:
        """Return -∇ψ in px at the pixels' centres, shape (2, H, W), in axis order (y, x)."""
        height, width = self.size
        values, slopes = kernels.spline_tables((np.arange(self.knot) + 0.5) / self.knot, self.knot)
        along_y = _at_pixels(potential, slopes, self.pad, height)
        along_x = _at_pixels(potential.T, slopes, self.pad, width).T
        down = _at_pixels(along_y.T, values, self.pad, width).T
        return -np.stack([down, _at_pixels(along_x, values, self.pad, height)])

    def values(self, potential: FloatArray) -> FloatArray:
        """Return ψ in px² at the pixels' centres, shape (H, W)."""
        height, width = self.size
        values, _ = kernels.spline_tables((np.arange(self.knot) + 0.5) / self.knot)
        along_y = _at_pixels(potential, values, self.pad, height)
        return _at_pixels(along_y.T, values, self.pad, width).T

    @property
    def _guarded(self) -> tuple[int, int]:
        """Shape of an image with the strip and the guard."""
        return self.seen[0] + 2 * _GUARD, self.seen[1] + 2 * _GUARD

    def _in_ranges(
        self,
        kernel: Callable[..., Any],
        ranges: int,
        traced: TracedBeam,
        *rest: Any,
        fewest: int = 20_000,
        shared: float = 2.0,
    ) -> None:
        """Call a kernel for ranges, in threads.

        Fewer rays are not worth one. Near an edge, `shared` spacings at rest wide, rays count in
        both pixels, evenly then.
        """
        (potential, counts, beam, frame), parts = traced, self._parts
        frame_px = self._to_pixels(at_rest() if frame is None else frame) / _lengths(parts)
        if parts > 1:
            potential = parts**2 * potential
            beam = beam.repeat(parts, axis=0).repeat(parts, axis=1) / parts**2
        threads = available_threads(self.threads)
        if (counts[0] * counts[1]).sum() < fewest:
            threads = 1
        steepness = self._at_rest / self.knot / shared
        splines, size = _tables(), self._guarded
        pad = parts * self.pad
        rays = kernels.Rays(potential, counts, beam, splines, frame_px, pad, steepness, size)
        in_ranges(kernel, ranges, threads, rays, *rest, smallest=1, uneven=True)

    @property
    def _middle(self) -> tuple[float, float]:
        return self.size[0] / 2, self.size[1] / 2

    def _to_pixels(self, frame: FloatArray) -> FloatArray:
        """A frame about the image's corner, that gives pixels of a guarded detector."""
        y, x = self._middle
        # From a pixel's edge to its middle: a ray there is shared with none.
        offset = self.beyond + _GUARD - 0.5
        turned = np.array(frame, dtype=np.float64)
        turned[[0, 3]] -= frame[1] * y + frame[2] * x, frame[4] * y + frame[5] * x
        turned[[0, 3]] += y + offset, x + offset
        return turned

    def _about_middle(self, pulls: FloatArray) -> FloatArray:
        y, x = self._middle
        about_middle = pulls.copy()
        for k in (0, 3):
            about_middle[k + 1] -= y * pulls[k]
            about_middle[k + 2] -= x * pulls[k]
        return about_middle


def _slopes_between_pixels(pull: FloatArray) -> FloatArray:
    """Values at pixels, how much more they are to the right, and below, and in turn there; flat."""
    slopes = np.zeros((*pull.shape, 4))
    slopes[..., 0] = pull
    slopes[:, :-1, 1] = pull[:, 1:] - pull[:, :-1]
    slopes[:-1, :, 2] = pull[1:] - pull[:-1]
    slopes[:-1, :, 3] = slopes[1:, :, 1] - slopes[:-1, :, 1]
    return slopes.reshape(-1)


def _entries(matrix: csr_array) -> kernels.Entries:
    """Begins of rows, columns and values; unsigned, for which no index counts from the end."""
    unsigned = _UNSIGNED[matrix.indices.itemsize]
    return matrix.indptr.view(unsigned), matrix.indices.view(unsigned), matrix.data


_UNSIGNED = {4: np.uint32, 8: np.uint64}


def _lengths(parts: int) -> FloatArray:
    """Which of a frame's numbers are divided by how many parts a pixel has."""
    return np.array([1.0, parts, parts, 1.0, parts, parts])


def at_rest() -> FloatArray:
    """Return the frame of a detector that sees rays where they land."""
    return np.array([0.0, 1.0, 0.0, 0.0, 0.0, 1.0])


@cache
def _tables() -> FloatArray:
    """B-splines and slopes at the rays of cells with n of them: [n, which, spline, ray], flat."""
    tables = np.zeros((MOST_RAYS + 1, 2, 4, MOST_RAYS))
    for n in range(1, MOST_RAYS + 1):
        tables[n, :, :, :n] = kernels.spline_tables((np.arange(n) + 0.5) / n)
    return tables.reshape(-1)


def _at_pixels(coefficients: FloatArray, table: FloatArray, pad: int, count: int) -> FloatArray:
    """Splines along the first axis at the pixels' centres; `table` has the values in a cell."""
    cells = len(coefficients) - 3
    knot = table.shape[1]
    values = np.empty((knot * cells, coefficients.shape[1]))
    for k in range(knot):
        values[k::knot] = sum(table[i, k] * coefficients[i : i + cells] for i in range(4))
    return values[pad : pad + count]
