"""How strongly a field structures the image, and the regime that follows: `Contrast`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.analysis.frame import FieldFrame
from napari_shadowinv.analysis.maps import Smoothed, least_width, smooth
from napari_shadowinv.analysis.product import Measurand, Values
from napari_shadowinv.cautions import Caution
from napari_shadowinv.facts import Fact, Level, to_figures
from napari_shadowinv.inversion.error_bars import Quantity
from napari_shadowinv.physics.beam import number_field
from napari_shadowinv.physics.derivatives import first_derivative, second_derivative

_REGIMES = {
    "linear": "linear: the contrast of the image is the current density, and any inversion will do",
    "injective": "nonlinear injective: rays do not cross, and the field follows from one image",
    "caustic": "caustic: rays cross, and one image belongs to several fields",
    "diffusive": (
        "diffusive: rays cross inside the object, and the image shows only how far they scatter"
    ),
}


class Contrast(Smoothed):
    """Contrast parameter µ = d/ℓ of an image, with its regime after Bott et al.

    d is the r.m.s. displacement and ℓ the scale over which it varies: the ratio of d to the r.m.s.
    of its divergence. So µ is the r.m.s. contrast that the image would have in the linear limit.
    """

    title = "contrast"
    place = 80
    lengths = ("scale",)
    reference = "A. F. A. Bott et al., J. Plasma Phys. 83, 905830614 (2017)"
    product: Literal["contrast"] = "contrast"
    object_length: float | None = number_field(
        "Object length (m)",
        "Length of the object along the beam, in m, for the diffusive regime. Default: unknown.",
        None,
        gt=0,
    )

    def _width(self, plane: FloatArray, noise: FloatArray, spacing: float) -> float:
        # A mean over the image bears more noise than a map, and bands are corrected for it.
        return max(super()._width(plane, noise, spacing) / 2, least_width(spacing))

    def variables(self, frame: FieldFrame) -> dict[str, Measurand]:
        return {
            "mu": Measurand((), "1", "Contrast parameter µ", "contrast µ"),
            "displacement": Measurand((), frame.length_unit, "Displacement, r.m.s."),
            "scale": Measurand((), frame.length_unit, "Scale over which the displacement varies"),
            "compression": Measurand(
                (), "1", "Largest compression of the beam, 1 where rays cross"
            ),
        }

    def at_order(self, potential: FloatArray, frame: FieldFrame, order: int) -> Values:
        plane = smooth(potential, self.smoothing or 0.0, order)
        crossed = first_derivative(first_derivative(plane, 0), 1)[2:-2, 2:-2]
        used = frame.mask[4:-4, 4:-4]  # two derivatives of fourth order shorten it by 4 px
        inside = [np.s_[2:-2, 4:-4], np.s_[4:-4, 2:-2]]
        down, right = (first_derivative(plane, axis)[inside[axis]][used] for axis in (0, 1))
        yy, xx = (second_derivative(plane, axis)[inside[axis]][used] for axis in (0, 1))
        yx, slopes = crossed[used], np.stack([down, right])
        variation = slopes - slopes.mean(axis=1, keepdims=True)
        move = float(np.sqrt((variation**2).sum(axis=0).mean()))
        mu = float(np.sqrt(((yy + xx) ** 2).mean()))
        compression = (yy + xx) / 2 + np.hypot((yy - xx) / 2, yx)
        return {
            "mu": np.asarray(mu),
            "displacement": np.asarray(frame.length(move)),
            "scale": np.asarray(frame.length(move / mu if mu else np.inf)),
            "compression": np.asarray(compression.max()),
        }

    def regime(
        self, quantities: Mapping[str, Quantity], frame: FieldFrame, *, linear: float = 0.1
    ) -> str:
        """Return the regime: "linear" up to a compression, "injective", "caustic", "diffusive"."""
        compression = float(quantities["compression"].value)
        if self.object_length is not None and frame.setup is not None:
            # Inside the object a ray moves by its angle times the length.
            pixels = float(quantities["displacement"].value) / frame.pixel
            angle = float(frame.setup.deflection_angle(pixels))
            if angle * self.object_length > float(quantities["scale"].value):
                return "diffusive"
        if compression >= 1 or frame.has_crossed_rays:
            return "caustic"
        return "linear" if compression < linear else "injective"

    def facts(self, quantities: Mapping[str, Quantity], frame: FieldFrame) -> list[Fact]:
        regime = self.regime(quantities, frame)
        level = Level.SOUND if regime in ("linear", "injective") else Level.DOUBTFUL
        return [
            *super().facts(quantities, frame),
            Fact("regime", "Regime", _REGIMES[regime], level),
            Fact("smoothing", "Smoothing", self.smoothing_text(frame)),
        ]

    def cautions(
        self, quantities: Mapping[str, Quantity], frame: FieldFrame, *, near: float = 0.8
    ) -> list[Caution]:
        compression = float(quantities["compression"].value)
        if not near < compression < 1 or frame.has_crossed_rays:
            return []
        text = (
            f"the beam is compressed by up to {to_figures(compression)}, near 1, where rays cross: "
            "an inversion never shows crossed rays, so µ may be larger; fit several images"
        )
        return [Caution("folds", text)]
