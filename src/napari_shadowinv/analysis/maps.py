"""Maps of the sources of a field: `CurrentDensity`, `ChargeDensity`, `PhaseCurvature`.

Each is the Laplacian of the potential, which amplifies noise. It is smoothed by a kernel
that leaves large structures as they are: with the Gaussian G of a standard deviation w, the gain
1 - (1 - G)³ falls short of 1 only by the sixth power of the wave number. Its width minimises the
expected error of the map, which follows from the map and from samples of its noise (Stein's
unbiased estimate of the risk), so nothing about the object is assumed.

References
----------
C. M. Stein, *Estimation of the mean of a multivariate normal distribution*, Ann. Stat. 9, 1135
(1981).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field
from scipy.fft import dctn, idctn

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.analysis.currents import source_by_flux
from napari_shadowinv.analysis.frame import FieldFrame
from napari_shadowinv.analysis.product import (
    Coordinate,
    FieldNoise,
    Measurand,
    Product,
    Values,
    at_peak,
    quantity_text,
)
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Fact, percent
from napari_shadowinv.inversion.error_bars import Quantity
from napari_shadowinv.physics.beam import length_text
from napari_shadowinv.physics.derivatives import laplacian

ORDER = 3
_WIDTHS_PX = (0.0, *(0.7 * 2 ** (step / 4) for step in range(23)))
# Wave number times width at which the gain is a half: 1 - (1 - exp(-x²/2))³ = ½.
_HALF_GAIN = math.sqrt(-2 * math.log(1 - 0.5 ** (1 / ORDER)))


def _gain(shape: tuple[int, ...], width: float, order: int = ORDER) -> FloatArray:
    """Gain 1 - (1 - G)^order for each cosine of a plane, with the gain G of a Gaussian."""
    rows, columns = (np.exp(-0.5 * (np.pi * width * np.arange(n) / n) ** 2) for n in shape)
    return np.asarray(1 - (1 - rows[:, None] * columns) ** order)


def smooth(plane: FloatArray, width: float, order: int = ORDER) -> FloatArray:
    """Smooth a plane by the gain 1 - (1 - G)^order, with a Gaussian G of a width in px.

    The plane is mirrored at its border.
    """
    if not width:
        return plane
    return np.asarray(idctn(_gain(plane.shape, width, order) * dctn(plane)))


def least_width(spacing: float, spacings: float = 1.5) -> float:
    """Return the least width for a spacing of sites: finer structures belong to the cells."""
    return spacings * spacing


def chosen_width(
    plane: FloatArray, noise: FloatArray, spacing: float, *, most_share: float = 0.1
) -> float:
    """Return the width in px that minimises the expected error of a smoothed plane, (H, W).

    The noise has samples, (k, H, W). Structures of single cells, by the spacing of the sites in px,
    are smoothed away in any case; the width is at most a share of the shorter side.
    """
    square = dctn(plane, norm="ortho") ** 2
    by_noise = np.mean([dctn(sample, norm="ortho") ** 2 for sample in noise], axis=0)
    most = max(most_share * min(plane.shape), 1.0)
    least = min(least_width(spacing), most)
    widths = [least, *(width for width in _WIDTHS_PX if least < width <= most)]

    def risk(width: float) -> float:
        gain = _gain(plane.shape, width)
        return float(((1 - gain) ** 2 * square + 2 * gain * by_noise).sum())

    return float(min(widths, key=risk))


class Smoothed(Product):
    """A product of the sources of a field, smoothed as the noise demands."""

    smoothing: float | None = Field(
        default=None,
        ge=0,
        le=100,
        title="Smoothing (px)",
        description="Width of the smoothing in px; 0 for none. Default: the width with the "
        "smallest expected error, which follows from the noise.",
    )

    def check(self, frame: FieldFrame) -> None:
        super().check(frame)
        if min(frame.shape) < 12:
            raise InputError(
                f"the field has {frame.shape[0]} × {frame.shape[1]} px, expected at least 12 px "
                f"each way for its {self.title}"
            )

    def adapt(
        self, potential: FloatArray, noise: FieldNoise | None, frame: FieldFrame, width: float = 3.0
    ) -> Self:
        """Choose the smoothing: a width in px where the noise is not known."""
        if self.smoothing is not None:
            return self
        if noise is not None and len(noise.potentials):
            samples = np.array([laplacian(sample) for sample in noise.potentials])
            width = self._width(laplacian(potential), samples, noise.spacing)
        return self.model_copy(update={"smoothing": round(width, 3)})

    def at_order(self, potential: FloatArray, frame: FieldFrame, order: int) -> Values:
        """Measure with a smoothing of an order."""
        raise NotImplementedError

    def measure(self, potential: FloatArray, displacement: FloatArray, frame: FieldFrame) -> Values:
        return self.at_order(potential, frame, ORDER)

    def systematic(
        self, potential: FloatArray, displacement: FloatArray, frame: FieldFrame
    ) -> Values:
        # The next order of the kernel shows what this one takes away.
        finer = self.at_order(potential, frame, ORDER + 1)
        values = self.at_order(potential, frame, ORDER)
        return {name: finer[name] - value for name, value in values.items()}

    def _width(self, plane: FloatArray, noise: FloatArray, spacing: float) -> float:
        return chosen_width(plane, noise, spacing)

    def smoothing_text(self, frame: FieldFrame) -> str:
        """Return the smoothing in words."""
        width = self.smoothing or 0.0
        if not width:
            return "none"
        wavelength = 2 * math.pi * width / _HALF_GAIN
        length = f"{wavelength:.3g} px"
        if frame.setup is not None:
            length += f" ({length_text(frame.length(wavelength))})"
        return (
            f"width {width:.3g} px: structures of a wavelength of {length} keep half of their "
            "amplitude"
        )


class _SourceMap(Smoothed):
    unit: ClassVar[str]
    long_name: ClassVar[str]
    variable: ClassVar[str] = "density"

    def variables(self, frame: FieldFrame) -> dict[str, Measurand]:
        return {self.variable: Measurand(("y", "x"), self.unit, self.long_name)}

    def coordinates(self, frame: FieldFrame) -> dict[str, Coordinate]:
        return {
            axis: Coordinate.in_plane(np.arange(count), frame, f"{axis} in the object plane")
            for axis, count in zip("yx", frame.shape, strict=True)
        }

    def _per_curvature(self, frame: FieldFrame) -> float:
        """Return the density or curvature by a Laplacian of the potential of 1."""
        # The outward flux of the displacement from a pixel is minus the Laplacian.
        return -source_by_flux(frame) / frame.pixel

    def at_order(self, potential: FloatArray, frame: FieldFrame, order: int) -> Values:
        sources = smooth(laplacian(potential), self.smoothing or 0.0, order)
        return {self.variable: self._per_curvature(frame) * sources}

    def facts(self, quantities: Mapping[str, Quantity], frame: FieldFrame) -> list[Fact]:
        name, density = self.variable, quantities[self.variable]
        used = Quantity(density.value[frame.mask], density.samples[:, frame.mask])
        text = quantity_text(at_peak(used), self.unit, frame)
        return [
            Fact(name, f"Largest {name}", text, short=text),
            Fact("smoothing", "Smoothing", self.smoothing_text(frame)),
            *self._linear_facts(density, frame),
        ]

    def _linear_facts(self, density: Quantity, frame: FieldFrame, most: float = 0.3) -> list[Fact]:
        """Compare with the image's contrast, nearly the same for Laplacians up to `most`."""
        curvature = density.value / self._per_curvature(frame)
        if frame.contrast is None or np.abs(curvature[frame.mask]).max() > most:
            return []
        image = smooth(np.where(frame.mask, frame.contrast, 0.0), self.smoothing or 0.0)
        used = frame.mask
        size = float(np.sqrt((curvature[used] ** 2).mean()))
        if not size > 0:
            return []
        gap = float(np.sqrt(((curvature - image)[used] ** 2).mean())) / size
        text = (
            f"the contrast of the image, equally smoothed, differs from this map by {percent(gap)} "
            "(r.m.s.); for deflections as weak as these they are nearly the same"
        )
        return [Fact("linear", "Linear limit", text)]


class CurrentDensity(_SourceMap):
    """Map of the current density along the beam: ∫j_z dz = (∂B_y/∂x - ∂B_x/∂y)/µ₀, integrated.

    Positive along the beam, into the image as it is shown.
    """

    title = "current density"
    place = 60
    fields = ("path_integrated_b",)
    reference = "C. Graziani et al., arXiv:1603.08617, Sec. II"
    unit = "A/m"
    long_name = "Current density along the beam, integrated along z"
    product: Literal["current-density"] = "current-density"


class ChargeDensity(_SourceMap):
    """Map of the charge density: ∫ρ dz = ε₀ (∂E_x/∂x + ∂E_y/∂y), integrated."""

    title = "charge density"
    place = 70
    fields = ("path_integrated_e",)
    unit = "C/m²"
    long_name = "Charge density, integrated along z"
    product: Literal["charge-density"] = "charge-density"


class PhaseCurvature(_SourceMap):
    """Map of the curvature of light's phase: ∇²Φ with Φ = (2π/λ) ∫ln η dz.

    Negative where the object focuses.
    """

    title = "phase curvature"
    place = 72
    fields = ("line_integrated_log_index", "line_integrated_density", "deflection_angle")
    unit = "rad/m²"
    long_name = "Curvature of the phase"
    variable = "curvature"
    product: Literal["phase-curvature"] = "phase-curvature"

    def check(self, frame: FieldFrame) -> None:
        super().check(frame)
        if frame.setup is None or frame.setup.beam_field != "wavelength":
            raise InputError("phase curvature is that of light: expected a setup with a wavelength")

    def _per_curvature(self, frame: FieldFrame) -> float:
        assert frame.setup is not None
        wave_number = 2 * math.pi / frame.setup.beam_value
        return -wave_number * float(frame.setup.deflection_angle(1.0)) / frame.pixel
