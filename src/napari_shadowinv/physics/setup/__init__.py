"""The experiment's geometry and probe, and what they make of a displacement.

- describe an experiment: `ProtonSetup`, `OpticalSetup`; either of them: `Setup`
- get it back from a file's content: `setup_from_dict`; with larger pixels: `binned_setup`
- convert pixels to SI and back: `BeamSetup.deflection_angle`, `BeamSetup.displacement`,
  `BeamSetup.potential`, `BeamSetup.normalized_potential`
- from a potential in SI to a displacement in pixels: `BeamSetup.displacement_from_potential`
- path-integrated fields of particles: `ProtonSetup.path_integrated_b`,
  `ProtonSetup.path_integrated_e`; back: `ProtonSetup.displacement_from_path_integrated_b`,
  `ProtonSetup.displacement_from_path_integrated_e`
- line integrals of light: `OpticalSetup.line_integrated_log_index`,
  `OpticalSetup.line_integrated_density`, `OpticalSetup.relative_density_modulation`; back:
  `OpticalSetup.normalized_potential_from_log_index`,
  `OpticalSetup.normalized_potential_from_density`,
  `OpticalSetup.normalized_potential_from_modulation`
- the same object in another experiment: `napari_shadowinv.physics.projection`

Displacements d and potentials φ are in pixels of the object plane, px and px². With the
pixel's side p, the distance L from object to detector and the magnification M, the
deflection angle is a = d p M / L and the potential Φ = φ p² M / L, so that a = -∇Φ where
d = -∇φ (Eq. 1 of the paper). Vectors are in axis order (y, x), with x to the right, y down
and the beam into the screen: a right-handed frame.

A potential is known up to a constant: only its gradient deflects. Whatever is
proportional to it (∫ln η dz, ∫n dz) has the same freedom, and is relative to the
place where the potential is zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field

from napari_shadowinv._system.validation import nearest, validated
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup._beam import BeamSetup
from napari_shadowinv.physics.setup._optical import OpticalSetup
from napari_shadowinv.physics.setup._proton import (
    SPECIES,
    FieldUnit,
    Particle,
    ProtonSetup,
    Species,
)

__all__ = [
    "SPECIES",
    "BeamSetup",
    "FieldUnit",
    "OpticalSetup",
    "Particle",
    "ProtonSetup",
    "Setup",
    "Species",
    "binned_setup",
    "setup_from_dict",
]

Setup = Annotated[ProtonSetup | OpticalSetup, Field(discriminator="kind")]

_KINDS: dict[str, type[ProtonSetup | OpticalSetup]] = {
    "proton": ProtonSetup,
    "optical": OpticalSetup,
}

_EXPECTED = (
    "it must be 'proton' (any charged particles, named by 'species': "
    f"{', '.join(SPECIES)}) or 'optical'"
)


def setup_from_dict(mapping: Mapping[str, Any], where: str = "setup") -> ProtonSetup | OpticalSetup:
    """Make the right setup from what a file holds.

    Parameters
    ----------
    mapping : mapping of str to object
        The fields, with ``kind`` "proton" (and a ``species``, for electrons or other ions) or
        "optical".
    where : str, optional
        Where the mapping comes from; an error's message begins with it.

    Returns
    -------
    ProtonSetup or OpticalSetup
        As `kind` says.

    Raises
    ------
    InputError
        If a key is unknown or missing or a value cannot be used; the message names it.

    Examples
    --------
    >>> setup_from_dict(
    ...     {
    ...         "kind": "optical",
    ...         "wavelength": 810e-9,
    ...         "object_image_distance": 0.01,
    ...         "pixel_size": 1e-6,
    ...     }
    ... ).collimated
    True
    """
    if not isinstance(mapping, Mapping):
        raise InputError(
            f"{where}: received a {type(mapping).__name__}, expected a table of keys and values"
        )
    kind = mapping.get("kind")
    if kind is None:
        raise InputError(f"{where}: 'kind' is missing, {_EXPECTED}")
    if not isinstance(kind, str) or kind not in _KINDS:
        raise InputError(f"{where}: 'kind' is {kind!r}, {_EXPECTED}{_meant(str(kind))}")
    return validated(_KINDS[kind], mapping, where)


def binned_setup(setup: ProtonSetup | OpticalSetup, factor: int) -> ProtonSetup | OpticalSetup:
    """Return the setup of an image whose pixels were summed in blocks.

    Parameters
    ----------
    setup : ProtonSetup or OpticalSetup
        Setup of the image as measured.
    factor : int
        Side of a block in pixels.

    Returns
    -------
    ProtonSetup or OpticalSetup
        The same with a pixel that is `factor` times as wide.
    """
    values = setup.model_dump()
    for name in ("pixel_size", "detector_pixel_size"):
        if values.get(name) is not None:
            values[name] *= factor
    return type(setup)(**values)


def _meant(kind: str) -> str:
    """What somebody may have meant who named another kind."""
    match = nearest(kind.lower(), list(dict.fromkeys([*_KINDS, *SPECIES])))
    if match is None or match in _KINDS:
        return f"; did you mean '{match}'?" if match else ""
    return f'; for this beam give kind = "proton" and species = "{match}"'
