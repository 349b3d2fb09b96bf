"""A point that shines evenly in all directions: `isotropic_source`, `IsotropicEstimate`.

- whether a beam can be taken as uniform: `uniform_warnings`
- how far away the point is: `point_distance`
"""

from __future__ import annotations

import math
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, PrivateAttr

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup import Setup, binned_setup
from napari_shadowinv.preprocessing.estimates import Estimate
from napari_shadowinv.preprocessing.pixels import beam_pixels

_NOTABLE_FALL = 0.01  # of the fluence, from the brightest pixel to the dimmest


def _centre_field(axis: str, line: str) -> Any:
    return Field(
        default=None,
        allow_inf_nan=False,
        title=f"Centre {axis} (px)",
        description=(
            f"{line} of the recorded image at which the detector faces the source. Default: its "
            "centre."
        ),
    )


class IsotropicEstimate(Estimate):
    """A point that shines evenly in all directions, on a flat detector."""

    title = "isotropic point source"
    uses_mask = False
    place = 20
    method: Literal["isotropic"] = "isotropic"
    centre_y: float | None = _centre_field("y", "Row")
    centre_x: float | None = _centre_field("x", "Column")
    # Not a parameter: the user gives the setup elsewhere.
    _setup: Any = PrivateAttr(default=None)

    def placed(
        self, setup: Setup | None, shape: tuple[int, int], matrix: FloatArray | None = None
    ) -> Estimate:
        if setup is None:
            raise _without_setup()
        point_distance(setup)  # refuses a collimated beam before any work
        return self._at(*centre_within(shape, matrix, self.centre_y, self.centre_x), setup)

    def coarser(self, factor: int) -> Estimate:
        if self._setup is None or self.centre_y is None or self.centre_x is None:
            return self
        y, x = ((c + 0.5) / factor - 0.5 for c in (self.centre_y, self.centre_x))
        return self._at(y, x, binned_setup(self._setup, factor))

    def _source(self, image: FloatArray, mask: BoolArray | None, *_: Any) -> FloatArray:
        if self._setup is None:
            raise _without_setup()
        return isotropic_source(image, self._setup, mask=mask, **self.values())

    def _at(self, y: float, x: float, setup: Setup) -> Self:
        estimate = self.model_copy(update={"centre_y": y, "centre_x": x})
        estimate._setup = setup
        return estimate


def centre_within(
    shape: tuple[int, int],
    matrix: FloatArray | None = None,
    y: float | None = None,
    x: float | None = None,
) -> tuple[float, float]:
    """Return the coordinates of a pixel of the recorded image, by default its centre, in a part."""
    middle = [(side - 1) / 2 for side in shape]
    recorded = [m if c is None else c for m, c in zip(middle, (y, x), strict=True)]
    if matrix is not None:
        recorded = [float(v) for v in np.linalg.solve(matrix, [*recorded, 1.0])[:2]]
    return recorded[0], recorded[1]


def _without_setup() -> InputError:
    return InputError(
        "got the source 'isotropic' without a setup, which is needed for the distance of the "
        "point source and the pixel size: give a setup, or choose the source 'uniform'"
    )


def uniform_warnings(
    shape: tuple[int, int], setup: Setup | None, *, centre: tuple[float, float] | None = None
) -> tuple[Caution, ...]:
    """Warn if a point source would light an image too unevenly to count as uniform.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the image.
    setup : Setup or None
        The experiment; no warning if it is unknown.
    centre : tuple of float, optional
        Pixel (y, x) in which the detector faces the point. Default: the middle of the image.

    Returns
    -------
    tuple of Caution
        Empty where the fluence of an isotropic point source varies by 1 % at most.
    """
    if setup is None or setup.collimated:
        return ()
    distance = point_distance(setup)
    axis = [(side - 1) / 2 for side in shape] if centre is None else centre
    near = [max(0.0, place - (side - 1), -place) for place, side in zip(axis, shape, strict=True)]
    far = [max(place, side - 1 - place) for place, side in zip(axis, shape, strict=True)]
    highest, lowest = ((1 + (math.hypot(*r) / distance) ** 2) ** -1.5 for r in (near, far))
    fall = 1 - lowest / highest
    if fall <= _NOTABLE_FALL:
        return ()
    text = (
        f"the source is assumed uniform, but a point source {setup.source_object_distance:.3g} m "
        f"from the object lights this image unevenly, by {fall:.1%} between brightest and "
        "dimmest pixel: if yours emits isotropically, choose the source 'isotropic'"
    )
    return (Caution("source", text),)


def isotropic_source(
    image: ArrayLike,
    setup: Setup,
    *,
    centre_y: float | None = None,
    centre_x: float | None = None,
    mask: ArrayLike | None = None,
) -> FloatArray:
    """Beam of a point that shines evenly in all directions, on a flat detector.

    It is an estimate as in `napari_shadowinv.preprocessing.estimates`; an `InputError` also refuses
    a setup with a collimated beam.

    Parameters
    ----------
    image : array_like, shape (H, W)
        The shot; only its flux is used.
    setup : Setup
        The experiment: distance of the point, and side of a pixel.
    centre_y, centre_x : float, optional
        Pixel in which the detector faces the point. Default: the middle of the image.
    mask : array_like of bool, shape (H, W), optional

    Notes
    -----
    A pixel receives its share of the solid angle; for small pixels that is proportional to
    cos³θ, with θ the angle between its line of sight to the point and the detector's normal.

    Examples
    --------
    >>> from napari_shadowinv.physics.phantoms import paper_setup
    >>> beam = isotropic_source(np.ones((201, 201)), paper_setup())
    >>> float(round(beam[0, 0] / beam[100, 100], 3))  # the corner, 9.3 degrees from the axis
    0.961
    """
    values, usable = beam_pixels(image, mask)
    distance = point_distance(setup)
    y, x = (
        _edges(side, "centre_" + axis, centre) / distance
        for side, axis, centre in zip(values.shape, "yx", (centre_y, centre_x), strict=True)
    )
    y = y[:, None]
    # Solid angle of the rectangle between the axis and each corner of the pixels.
    angles = np.arctan2(y * x, np.sqrt(1 + y**2 + x**2))
    beam = np.diff(np.diff(angles, axis=0), axis=1)
    return np.asarray(beam * (values[usable].mean() / beam[usable].mean()))


def point_distance(setup: Setup) -> float:
    """Return the distance from the point source to the detector, in px of the detector."""
    if setup.collimated:
        raise InputError(
            "got the source 'isotropic' and a setup with a collimated beam "
            "(source_object_distance is inf): give the distance of the point source, or choose "
            "the source 'uniform'"
        )
    # The magnification enlarges distance and pixel alike.
    return setup.source_object_distance / setup.object_pixel_size


def _edges(side: int, name: str, centre: float | None) -> FloatArray:
    """Return the edges of `side` pixels, relative to the centre, by default their middle."""
    if centre is not None and not math.isfinite(centre):
        raise InputError(f"{name} is {centre!r}, expected a finite number of px")
    return np.arange(-0.5, side) - ((side - 1) / 2 if centre is None else centre)
