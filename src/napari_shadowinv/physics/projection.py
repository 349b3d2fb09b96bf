"""One object in two experiments: invert a shot of one, predict the image of the other.

- the displacement in another experiment: `transferred_displacement`; by how much it is larger:
  `displacement_ratio`
- the image there: `predict_image`
- the cause of the deflection, which both experiments have in common: `deflector_titles`

A deflection angle, and with it the potential in m, belongs to a beam. The object is described by a
line integral, which is the same for all beams:

=================  ===========================  ==========================================
deflector          of the object                angle of a beam
=================  ===========================  ==========================================
magnetic field     ∫B dl (T m)                  ∝ q / p
electric field     ∫E dl (V)                    ∝ q / (p v)
plasma             ∫n dz (m⁻²)                  ∝ 1 / n_c, so ∝ λ²
refractive index   ∫ln η dz (m)                 the same, apart from dispersion
=================  ===========================  ==========================================

Momentum p and velocity v are relativistic. Distances, magnification and pixels of both
experiments may differ too: both look at the same point of the object with the middle of
their images. The object is thin: rays of every direction pass straight through it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import make_interp_spline

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.arrays import plain_array
from napari_shadowinv.physics.forward import (
    MIN_SIDE_PX,
    checked_displacement,
    checked_shape,
    synthetic_image,
)
from napari_shadowinv.physics.setup import Setup, deflector_titles


def predict_image(
    displacement: ArrayLike,
    recorded_with: Setup,
    setup: Setup,
    *,
    deflector: str | None = None,
    dispersion: float = 1.0,
    source: ArrayLike | None = None,
    rays_per_pixel: int = 16,
    threads: int | None = None,
) -> FloatArray:
    """Image that an object makes in another experiment.

    Parameters
    ----------
    displacement : array_like, shape (2, H, W)
        Displacement in px of `recorded_with`, axis order (y, x), such as `Inversion.displacement`.
    recorded_with, setup : Setup
        The experiment that the displacement belongs to, and the one to predict.
    deflector, dispersion
        As for `transferred_displacement`.
    source : array_like, shape (H', W'), optional
        Flux of each pixel of `setup` without the object. Default: 1, in the shape that covers the
        object.
    rays_per_pixel, threads
        As for `synthetic_image`.

    Returns
    -------
    ndarray of float64, shape (H', W')
        Flux of each pixel of the predicted image, in the unit of the source.

    Raises
    ------
    InputError
        As `transferred_displacement` and `synthetic_image`.
    """
    shape = None
    if source is not None:
        source = plain_array(source, "source")
        height, width = np.shape(source)[:2] if np.ndim(source) == 2 else (0, 0)
        shape = (height, width)
    moved = transferred_displacement(
        displacement, recorded_with, setup, deflector=deflector, dispersion=dispersion, shape=shape
    )
    return synthetic_image(moved, source, rays_per_pixel=rays_per_pixel, threads=threads)


def transferred_displacement(
    displacement: ArrayLike,
    recorded_with: Setup,
    setup: Setup,
    *,
    deflector: str | None = None,
    dispersion: float = 1.0,
    shape: tuple[int, int] | None = None,
) -> FloatArray:
    """Displacement that the same object makes in another experiment.

    Parameters
    ----------
    displacement : array_like, shape (2, H, W)
        Displacement in px of `recorded_with`, axis order (y, x).
    recorded_with, setup : Setup
        The experiment that the displacement belongs to, and the other one.
    deflector : {"magnetic field", "electric field", "plasma", "refractive index"}, optional
        Cause of the deflection. Default: see `default_deflector`.
    dispersion : float, default 1
        For a refractive index: ln η at the wavelength of `setup`, divided by ln η at the
        wavelength of `recorded_with`.
    shape : tuple of int, optional
        Height and width of the other image in its own pixels. Default: the area of the known
        field.

    Returns
    -------
    ndarray, shape (2, H', W')
        Displacement in px of `setup`, interpolated by cubic splines unless both images have
        the same pixels.

    Raises
    ------
    InputError
        If one experiment uses particles and the other light, the deflector does not bend the
        beam or has to be specified, the displacement has another shape, or the other image is
        larger than the known field.

    Examples
    --------
    Slower protons are deflected more, by the ratio of the momenta in a magnetic field:

    >>> from napari_shadowinv import ProtonSetup
    >>> setup = ProtonSetup.example()
    >>> slow = setup.model_copy(update={"energy": 3.0})
    >>> float(transferred_displacement(np.ones((2, 4, 4)), setup, slow)[0, 0, 0])
    2.22
    """
    field = checked_displacement(displacement)
    # One factor, so that nothing changes, not even by rounding, where nothing differs.
    factor = displacement_ratio(recorded_with, setup, deflector=deflector, dispersion=dispersion)
    ratio = setup.object_pixel_size / recorded_with.object_pixel_size
    old = (field.shape[1], field.shape[2])
    if shape is None:
        size = _covered_shape(old, ratio)
    else:
        size, most = checked_shape(shape, "the other image"), _covered_shape(old, ratio)
        if shape[0] > most[0] or shape[1] > most[1]:
            raise InputError(
                f"the other image has shape {tuple(shape)} with pixels of "
                f"{setup.object_pixel_size * 1e6:.4g} µm at the object, but the field is known "
                f"only on {most} of them: crop the source or reduce the shape to that"
            )
    # The same pixels may have been divided and multiplied by a magnification.
    if size == old and math.isclose(ratio, 1, rel_tol=1e-9):
        return factor * field
    return factor * _resample(field, size, ratio)


def displacement_ratio(
    recorded_with: Setup, setup: Setup, *, deflector: str | None = None, dispersion: float = 1.0
) -> float:
    """Return the displacement in px of one experiment over the one in px of another.

    Takes the arguments of `transferred_displacement`, and raises its errors.
    """
    if not (math.isfinite(dispersion) and dispersion != 0):
        raise InputError(f"dispersion is {dispersion:g}: it must be a finite number, not 0")
    if deflector is not None and deflector not in deflector_titles().values():
        titles = ", ".join(deflector_titles().values())
        raise InputError(f"deflector is {deflector!r}: it must be one of {titles}")
    usual = deflector or default_deflector(recorded_with, setup)
    if dispersion != 1 and usual != "refractive index":
        raise InputError(
            f"dispersion is {dispersion:g}, but it does not apply to a {usual}: leave it out"
        )
    _require_same_kind(recorded_with, setup)
    if usual not in setup.deflector_titles():
        raise InputError(
            f"deflector is {usual!r}, but the beam is {setup.beam}: expected "
            f"{' or '.join(map(repr, setup.deflector_titles()))}"
        )
    factor = setup.angle_ratio(recorded_with, usual) * dispersion
    return factor * float(recorded_with.deflection_angle(1.0) / setup.deflection_angle(1.0))


def default_deflector(recorded_with: Setup, setup: Setup) -> str:
    """Return the default cause of the deflection.

    A magnetic field for particles, and a refractive index for light of the same wavelength, for
    which a plasma gives the same result. An `InputError` if the wavelengths differ, or one
    experiment uses particles and the other light.
    """
    _require_same_kind(recorded_with, setup)
    return setup.default_deflector(recorded_with)


def _require_same_kind(recorded_with: Setup, setup: Setup) -> None:
    if recorded_with.kind != setup.kind:
        raise InputError(
            f"the field was measured with a setup of kind {recorded_with.kind!r}, but the image is "
            f"requested for kind {setup.kind!r}: expected the same kind; the deflection of light "
            "does not determine that of particles"
        )


def _covered_shape(old: tuple[int, int], ratio: float) -> tuple[int, int]:
    # Rounding may put an image's edge beyond the other's.
    height, width = (math.floor(n / ratio + 1e-6) for n in old)
    if min(height, width) < MIN_SIDE_PX:
        raise InputError(
            f"the known field covers {height} × {width} pixels of the other setup: expected at "
            f"least {MIN_SIDE_PX} × {MIN_SIDE_PX}; check the pixel sizes"
        )
    return height, width


def _resample(field: FloatArray, shape: tuple[int, int], ratio: float) -> FloatArray:
    """A field at the centres of other pixels, `ratio` times as wide, about the same middle."""
    for axis, count in enumerate(shape, start=1):
        old = np.arange(field.shape[axis]) - (field.shape[axis] - 1) / 2
        new = (np.arange(count) - (count - 1) / 2) * ratio
        field = make_interp_spline(old, field, k=3, axis=axis)(new)
    return field
