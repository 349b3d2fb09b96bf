"""Effects of an instrument that is not exact: `IMPERFECTIONS`, one `Imperfection` for each.

An imperfection changes the flux of the image, or of its source, by a pattern whose size is a
standard deviation of the `Instrument`. The field follows by the linear response of the solved
transport.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import gaussian_filter

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.inversion.normalise import Prepared
from napari_shadowinv.inversion.readout import LinearResponse
from napari_shadowinv.options.instrument import Instrument

__all__ = ["IMPERFECTIONS", "Imperfection", "SolvedShot", "random_waves"]

_WAVES = 16
_SAMPLES = 8
_STEPS = 96  # along the shorter side, where the object is looked for
_OBJECT = 0.1  # of the largest displacement
_LEAST_BRIGHTNESS = 1e-3  # of the mean, for a logarithm
_SQUARE = np.sqrt(3)  # r.m.s. square of a normal number: blur acts by the square of its width


@dataclass(frozen=True)
class SolvedShot:
    """A shot with its solved transport.

    Attributes
    ----------
    prepared : Prepared
        Image and source, in units of the source's power of two.
    displacement : ndarray, shape (2, H, W)
        Of the ray through each pixel, px.
    response : LinearResponse
        Of n cells.
    seed : int
        Of random patterns.
    """

    prepared: Prepared
    displacement: FloatArray
    response: LinearResponse
    seed: int

    @property
    def mean(self) -> float:
        """Mean of the image, and of its source."""
        return float(self.prepared.source[self.prepared.mask].mean())

    @cached_property
    def fluxes(self) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """Flux of each cell in the image and in the source, each with its flux in an even one."""
        fluxes = self.response.flux, self.response.level.mass
        areas = self.response.areas(self.prepared.mask)
        return tuple(
            (flux, area * flux.sum() / area.sum()) for flux, area in zip(fluxes, areas, strict=True)
        )

    def flux_of_source(self, changes: FloatArray) -> FloatArray:
        """Return the flux that cells gain by changes of the source, (k, H, W) to (k, n)."""
        return self.balance(self.response.flux_of_source(changes * self.prepared.mask))

    def balance(self, gains: FloatArray) -> FloatArray:
        """Return gains of cells, (k, n), less their sum in proportion to the flux of the cells.

        The image is scaled to the flux of its source.
        """
        flux = self.response.flux
        return np.asarray(gains - gains.sum(axis=1, keepdims=True) * flux / flux.sum())


Pattern = Callable[[SolvedShot, float], FloatArray]


@dataclass(frozen=True)
class Imperfection:
    """A quantity of the instrument that is known to a standard deviation only.

    Attributes
    ----------
    key : str
        Name in `Instrument`.
    title : str
        In texts.
    size_text : str
        Format of the standard deviation, such as "{:.2g} px".
    tested : float
        Standard deviation whose effect every budget states; 0 if it takes too long.
    pattern : callable
        Returns k independent changes of the cells' flux, (k, n), for a solved shot and a standard
        deviation; their mean square is that of the imperfection.
    """

    key: str
    title: str
    size_text: str
    tested: float
    pattern: Pattern

    def name(self, size: float) -> str:
        """Return the title with the size, such as "background, 5 %"."""
        factor = 100 if "%" in self.size_text else 1
        return f"{self.title}, {self.size_text.format(factor * size)}"

    def stated(self, instrument: Instrument) -> float:
        """Return the standard deviation in an instrument."""
        return float(getattr(instrument, self.key))


def random_waves(
    places: FloatArray, length: float, count: int, rng: np.random.Generator
) -> FloatArray:
    """Return random smooth fields at places (n, 2), (count, n), with a mean square near 8."""
    fields = np.empty((count, len(places)))
    for field in fields:
        waves = rng.normal(size=(2, _WAVES)) / length
        phases = rng.uniform(0, 2 * np.pi, _WAVES)
        field[:] = np.cos((places @ waves + phases).astype(np.float32)).sum(axis=1)
    return fields


def _background(shot: SolvedShot, share: float) -> FloatArray:
    """A constant under the image and its source: one detector has recorded both."""
    of_image, of_source = (even - flux for flux, even in shot.fluxes)
    return shot.balance(share * (of_image - of_source)[None])


def _response(shot: SolvedShot, gamma: float) -> FloatArray:
    """An exponent of the image and of its source: one detector has recorded both."""
    changes = []
    for flux, even in shot.fluxes:
        brightness = flux / np.maximum(even, _LEAST_BRIGHTNESS * flux.mean())
        changes.append(flux * np.log(np.maximum(brightness, _LEAST_BRIGHTNESS)))
    of_image, of_source = changes
    return shot.balance(gamma * (of_image - of_source)[None])


def _blur(shot: SolvedShot, width: float) -> FloatArray:
    """Diffusion of flux between neighbouring cells, over half the square of the width."""
    diffused = shot.response.diffusion()
    return shot.balance((_SQUARE * width**2 / 2 * diffused)[None])


def _registration(shot: SolvedShot, shift: float) -> FloatArray:
    """Shifts along y and x, a turn and a change of scale, as large at the corners."""
    source = np.where(shot.prepared.mask, shot.prepared.source, shot.mean)
    along_y, along_x = np.gradient(source)
    y, x = (
        (indices - (side - 1) / 2) / (np.hypot(*source.shape) / 2)
        for indices, side in zip(np.indices(source.shape), source.shape, strict=True)
    )
    patterns = [along_y, along_x, along_y * x - along_x * y, along_y * y + along_x * x]
    return shot.flux_of_source(2 * shift * np.stack(patterns))


def _absorption(shot: SolvedShot, rms: float) -> FloatArray:
    """Smooth variations of the transmission where the object displaces rays."""
    response, sites = shot.response, shot.response.sites
    step = max(min(shot.prepared.mask.shape) // _STEPS, 1)
    length = np.hypot(*shot.displacement[:, ::step, ::step])
    inside = (length > _OBJECT * length.max()) & shot.prepared.mask[::step, ::step]
    radius = max(step * np.sqrt(inside.sum() / np.pi), 1.0)
    envelope = gaussian_filter(inside.astype(np.float64), radius / 4 / step)
    rows, columns = (
        np.clip(np.rint(line / step).astype(np.int64), 0, side - 1)
        for line, side in zip(sites.T, envelope.shape, strict=True)
    )
    rng = np.random.default_rng(shot.seed)
    fields = random_waves(sites, radius, _SAMPLES, rng) * envelope[rows, columns]
    fields *= np.sqrt(2 / _WAVES)
    mass = response.level.mass
    fields -= (fields @ mass / mass.sum())[:, None]
    return np.asarray(rms * mass * fields)


IMPERFECTIONS: tuple[Imperfection, ...] = (
    Imperfection("background", "background", "{:.2g} %", 0.05, _background),
    Imperfection("gamma", "gamma", "{:.2g}", 0.05, _response),
    Imperfection("blur", "blur", "{:.2g} px", 1.0, _blur),
    Imperfection("absorption", "absorption", "{:.2g} %", 0.01, _absorption),
    Imperfection("registration", "registration", "{:.2g} px", 0.0, _registration),
)
"""Quantities of the instrument with their effects on an image, in the order of the budget."""
