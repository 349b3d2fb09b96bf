"""A field in a drawn region: `Region`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.analysis.frame import FieldFrame
from napari_shadowinv.analysis.outlines import Outlined
from napari_shadowinv.analysis.product import Measurand, Values, mask_cautions
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.error_bars import Quantity


class Region(Outlined):
    """Mean, peak, r.m.s. and centroid of a field in a circle, a rectangle or a polygon.

    Of a vector field the magnitude counts. The centroid is weighted by the magnitude. Noise raises
    the mean, the peak and the r.m.s. of a magnitude; the bands are corrected for it.
    """

    title = "region"
    place = 20
    recorded = ("intensity",)
    maxima = ("peak",)
    lengths = ("centroid_y", "centroid_x")
    product: Literal["region"] = "region"

    def check(self, frame: FieldFrame) -> None:
        super().check(frame)
        if not self.pixels_inside(frame).any():
            raise InputError(
                "the region has no pixel's centre inside, expected a region of at least one pixel"
            )

    def variables(self, frame: FieldFrame) -> dict[str, Measurand]:
        unit, length, name = frame.si_unit, frame.length_unit, frame.long_name
        of_what = f"{name}, magnitude" if frame.is_vector else name
        variables = {
            "mean": Measurand((), unit, f"{of_what}, mean"),
            "peak": Measurand((), unit, f"{of_what}, peak"),
            "rms": Measurand((), unit, f"{of_what}, r.m.s."),
        }
        if frame.is_vector:
            variables |= {
                f"mean_{axis}": Measurand((), unit, f"{name}, mean of its {axis} component")
                for axis in "yx"
            }
        variables |= {
            f"centroid_{axis}": Measurand((), length, f"Centroid of the magnitude, {axis}")
            for axis in "yx"
        }
        if frame.image is not None:
            variables["intensity"] = Measurand((), "1", "Intensity of the image, mean")
        return variables

    def measure(self, potential: FloatArray, displacement: FloatArray, frame: FieldFrame) -> Values:
        inside = self.pixels_inside(frame)
        field = frame.field(potential, displacement)[..., inside]
        values = np.hypot(*field) if frame.is_vector else field
        magnitude = np.abs(values)
        total = max(float(magnitude.sum()), 1e-300)
        places = frame.length(1.0) * np.argwhere(inside)
        centroid = (magnitude[:, None] * places).sum(axis=0) / total
        numbers = {
            "mean": values.mean(),
            "peak": values[magnitude.argmax()],
            "rms": np.sqrt((values**2).mean()),
            "centroid_y": centroid[0],
            "centroid_x": centroid[1],
        }
        if frame.is_vector:
            numbers |= {"mean_y": field[0].mean(), "mean_x": field[1].mean()}
        return {name: np.asarray(number) for name, number in numbers.items()}

    def constants(self, frame: FieldFrame) -> Values:
        if frame.image is None:
            return {}
        return {"intensity": np.asarray(np.nanmean(frame.image[self.pixels_inside(frame)]))}

    def cautions(self, quantities: Mapping[str, Quantity], frame: FieldFrame) -> list[Caution]:
        return mask_cautions(np.argwhere(self.pixels_inside(frame)), frame, "the region")

    def remarks(self, frame: FieldFrame) -> tuple[str, ...]:
        if not frame.is_vector:
            return (
                "A potential is known up to a constant: it is zero in the mean over the border of "
                "the image, and so is this field.",
            )
        return ()
