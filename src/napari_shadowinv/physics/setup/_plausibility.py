"""Doubts about a setup whose numbers are possible, but unlike any experiment.

Most come from a unit: mm, µm or cm typed where m is expected, eV where MeV is. The limits leave
room for every common experiment: laser-driven and fusion protons, electrons, laser light.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.physics.setup._beam import BeamSetup, length_text, length_unit

__all__ = ["deflection_warnings", "field_of_view_text", "geometry_text", "setup_warnings"]

_MIN_PIXEL_M, _MAX_PIXEL_M = 10e-9, 1e-3  # at the object
_MIN_PARTICLE_DETECTOR_PIXEL_M = 3e-6  # no film scanner or plate reader resolves less
_MAX_DETECTOR_PIXEL_M = 10e-3
_MAX_DETECTOR_DISTANCE_M = 10.0
_MIN_PARTICLE_DISTANCE_M = 1e-4
_MIN_PARTICLE_MAGNIFICATION = 2.0
_MAX_MAGNIFICATION = 1000.0
_MAX_DEFLECTION_RAD = 0.3
_MAX_FIELD_T_M = 10.0


def geometry_text(setup: BeamSetup, shape: tuple[int, int] | None = None) -> str:
    """Return field of view, magnification and distance in a line, to be checked by eye.

    Parameters
    ----------
    setup : BeamSetup
    shape : tuple of int, optional
        Height and width of the image in px. Default: the size of a pixel takes the place of the
        field of view.

    Examples
    --------
    >>> from napari_shadowinv.physics.setup import ProtonSetup
    >>> lengths = {"source_object_distance": 1.3e-3, "object_image_distance": 2e-2}
    >>> geometry_text(ProtonSetup(energy=14.7, pixel_size=1.5e-6, **lengths), (200, 200))
    '300 × 300 µm at the object, M = 16.4, source to detector 2.13 cm'
    """
    pixel = f"pixel {length_text(setup.object_pixel_size)}"
    extent = pixel if shape is None else field_of_view_text(setup, shape)
    text = f"{extent} at the object, M = {setup.magnification:.3g}"
    if setup.is_collimated:
        return f"{text}, collimated, object to detector {length_text(setup.object_image_distance)}"
    total = setup.source_object_distance + setup.object_image_distance
    return f"{text}, source to detector {length_text(total)}"


def field_of_view_text(setup: BeamSetup, shape: tuple[int, int]) -> str:
    """Return width and height of an image of shape (H, W) at the object, such as "4 × 2 mm"."""
    pixel = setup.object_pixel_size
    unit_m, unit = length_unit(max(shape) * pixel)
    sides = " × ".join(f"{side * pixel / unit_m:.3g}" for side in reversed(shape))
    return f"{sides} {unit}"


def setup_warnings(setup: BeamSetup, shape: tuple[int, int] | None = None) -> tuple[Caution, ...]:
    """Return a sentence for everything about a setup that no common experiment has.

    Parameters
    ----------
    setup : BeamSetup
    shape : tuple of int, optional
        Height and width of the image in px; without it the field of view is not checked.

    Returns
    -------
    tuple of Caution
        Empty if nothing is doubtful.

    Examples
    --------
    >>> from napari_shadowinv.physics.setup import ProtonSetup
    >>> lengths = {"source_object_distance": 0.28, "object_image_distance": 0.01}
    >>> (caution,) = setup_warnings(ProtonSetup(energy=14.7, pixel_size=1e-6, **lengths))
    >>> caution.text[:34]
    'setup: the magnification is 1.04: '
    """
    doubts = [*_pixel_doubts(setup), *_distance_doubts(setup, shape), *setup.probe_doubts()]
    return tuple(Caution("setup", f"setup: {doubt}") for doubt in doubts)


def deflection_warnings(setup: BeamSetup, displacement: FloatArray) -> tuple[Caution, ...]:
    """Return a sentence if a displacement is larger than such an experiment can make.

    Parameters
    ----------
    setup : BeamSetup
    displacement : ndarray, shape (2, H, W)
        In px of the object plane.
    """
    largest = float(np.nanmax(np.hypot(*displacement), initial=0.0))
    angle = float(setup.deflection_angle(largest))
    if angle > _MAX_DEFLECTION_RAD:
        text = (
            f"setup: the largest deflection is {angle:.3g} rad, and small angles (below "
            f"{_MAX_DEFLECTION_RAD:g}) are assumed: the field in SI units is not reliable; check "
            "the distances, the pixel size and their units"
        )
        return (Caution("setup", text),)
    main = setup.main_field.name
    if main == "path_integrated_b":
        field = float(np.abs(setup.field_in_si(main, np.array([largest, 0.0]))).max())
        if field > _MAX_FIELD_T_M:
            text = (
                f"setup: the path-integrated field reaches {field:.3g} T m, far more than any "
                "laboratory plasma has: check the energy (MeV), the distances and the pixel size"
            )
            return (Caution("setup", text),)
    return ()


def _pixel_doubts(setup: BeamSetup) -> Iterator[str]:
    pixel = setup.object_pixel_size
    if not _MIN_PIXEL_M <= pixel <= _MAX_PIXEL_M:
        yield (
            f"a pixel is {length_text(pixel)} at the object, expected {length_text(_MIN_PIXEL_M)} "
            f"to {length_text(_MAX_PIXEL_M)}: all lengths and fields scale with it; it is given "
            "in m"
        )
    at_detector = setup.detector_pixel_size
    if at_detector is None:
        return
    if at_detector > _MAX_DETECTOR_PIXEL_M and pixel <= _MAX_PIXEL_M:
        yield (
            f"a pixel is {length_text(at_detector)} at the detector, larger than any detector's: "
            "it is given in m"
        )
    elif setup.projects and at_detector < _MIN_PARTICLE_DETECTOR_PIXEL_M:
        yield (
            f"a pixel is {length_text(at_detector)} at the detector, finer than films and plates "
            "are scanned: give a pixel size at the object as 'pixel_size'"
        )


def _distance_doubts(setup: BeamSetup, shape: tuple[int, int] | None) -> Iterator[str]:
    to_object, to_detector = setup.source_object_distance, setup.object_image_distance
    if (
        setup.projects
        and setup.magnification < _MIN_PARTICLE_MAGNIFICATION
        and not setup.is_collimated
    ):
        yield (
            f"the magnification is {setup.magnification:.3g}: the source is "
            f"{length_text(to_object)} from the object and the detector only "
            f"{length_text(to_detector)} behind it; check that the distances are not swapped, and "
            "that the first is from source to object, not to the detector"
        )
    elif setup.max_source_distance < to_object < math.inf:
        yield (
            f"the source is {length_text(to_object)} from the object, where small sources are "
            f"within {length_text(setup.max_source_distance)}: deflections scale with the "
            "distances; they are given in m"
        )
    if setup.magnification > _MAX_MAGNIFICATION:
        yield (
            f"the magnification is {setup.magnification:.3g}: the source is "
            f"{length_text(to_object)} from the object and the detector "
            f"{length_text(to_detector)} behind it; both distances are given in m"
        )
    elif to_detector > _MAX_DETECTOR_DISTANCE_M:
        yield (
            f"the detector is {length_text(to_detector)} behind the object: fields are too small "
            "by the factor by which that is too long; it is given in m"
        )
    nearest = min(to_object, to_detector)
    if setup.projects and nearest < _MIN_PARTICLE_DISTANCE_M:
        yield (
            f"source or detector is {length_text(nearest)} from the object: distances are given "
            "in m"
        )
    if shape is None or not (setup.projects or math.isfinite(to_object)):
        return  # light is often imaged from a plane close behind the object
    extent = max(shape) * setup.object_pixel_size
    if extent > nearest:
        yield (
            f"the field of view of {length_text(extent)} is wider than the {length_text(nearest)} "
            "between the object and source or detector, but rays near the axis are assumed: check "
            "the distances, and whether the pixel size is that at the object or at the detector"
        )
