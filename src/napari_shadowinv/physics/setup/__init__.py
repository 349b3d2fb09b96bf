"""The experiment's geometry and probe, and the fields that follow from a displacement.

- describe an experiment: `ProtonSetup`, `OpticalSetup`; any of them: `Setup`, by kind `SETUPS`
- how a kind of setup is described: `BeamSetup`, `SIField`, `MainField`, `Deflector`
- get it back from a file's content: `setup_from_dict`; with larger pixels: `binned_setup`
- convert pixels to SI and back: methods of `BeamSetup`; path-integrated fields: of `ProtonSetup`;
  line integrals of the refractive index or the density: of `OpticalSetup`
- whether its numbers are plausible: `setup_warnings`, `deflection_warnings`; for people to
  check: `geometry_text`, `field_of_view_text`
- the gradient of a potential in pixels: `displacement_from_potential`
- the same object in another experiment: `napari_shadowinv.physics.projection`

Conversions take an array_like of any shape and return an ndarray of float64 of the same
shape; vectors, in axis order (y, x), lie along the first axis. With x to the right, y down and
the beam into the screen the frame is right-handed.

Displacements d and potentials φ are in pixels of the object plane, px and px². With the
pixel's side p, the distance L from object to detector and the magnification M, the
deflection angle is a = d p M / L and the potential Φ = φ p² M / L, so that a = -∇Φ where
d = -∇φ (Eq. 1 of the paper, Kasim et al., arXiv:1607.04179).

A potential is determined up to a constant: only its gradient deflects. Quantities that are
proportional to it (∫ln η dz, ∫n dz) are relative to the place where the potential is zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args

from pydantic import Field

from napari_shadowinv._system.validation import nearest, validated
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup._beam import (
    BeamSetup,
    MainField,
    SIField,
    displacement_from_potential,
)
from napari_shadowinv.physics.setup._optical import LightDeflector, OpticalSetup
from napari_shadowinv.physics.setup._plausibility import (
    deflection_warnings,
    field_of_view_text,
    geometry_text,
    setup_warnings,
)
from napari_shadowinv.physics.setup._proton import (
    SPECIES,
    FieldUnit,
    Particle,
    ParticleDeflector,
    ProtonSetup,
    Species,
)

__all__ = [
    "SETUPS",
    "SPECIES",
    "BeamSetup",
    "Deflector",
    "FieldUnit",
    "MainField",
    "OpticalSetup",
    "Particle",
    "ProtonSetup",
    "SIField",
    "Setup",
    "Species",
    "binned_setup",
    "deflection_warnings",
    "displacement_from_potential",
    "field_of_view_text",
    "geometry_text",
    "setup_from_dict",
    "setup_warnings",
]

# A further kind of setup is added here, and nowhere else.
Setup = Annotated[ProtonSetup | OpticalSetup, Field(discriminator="kind")]
Deflector = Literal[ParticleDeflector, LightDeflector]

SETUPS: dict[str, type[Setup]] = {
    model.model_fields["kind"].default: model for model in get_args(get_args(Setup)[0])
}
"""The kinds of setup by name."""

_EXPECTED = (
    "it must be 'proton' (any charged particles, named by 'species': "
    f"{', '.join(SPECIES)}) or 'optical'"
)


def setup_from_dict(mapping: Mapping[str, Any], where: str = "setup") -> Setup:
    """Create a setup of the right kind from the content of a file.

    Parameters
    ----------
    mapping : mapping of str to object
        The fields, with ``kind`` "proton" (and a ``species``, for electrons or other ions) or
        "optical".
    where : str, optional
        Where the mapping comes from; an error's message begins with it.

    Raises
    ------
    InputError
        If a key is unknown or missing or a value cannot be used; the message names it.

    Examples
    --------
    >>> light = {"wavelength": 810e-9, "object_image_distance": 0.01, "pixel_size": 1e-6}
    >>> setup_from_dict({"kind": "optical", **light}).collimated
    True
    """
    if not isinstance(mapping, Mapping):
        raise InputError(
            f"{where}: received a {type(mapping).__name__}, expected a table of keys and values"
        )
    kind = mapping.get("kind")
    if kind is None:
        raise InputError(f"{where}: 'kind' is missing, {_EXPECTED}")
    if not isinstance(kind, str) or kind not in SETUPS:
        raise InputError(f"{where}: 'kind' is {kind!r}, {_EXPECTED}{_suggest_kind(str(kind))}")
    return validated(SETUPS[kind], mapping, where)


def binned_setup(setup: Setup, factor: int) -> Setup:
    """Return the setup of an image whose pixels were summed in blocks of side `factor`."""
    values = setup.model_dump()
    for name in ("pixel_size", "detector_pixel_size"):
        if values.get(name) is not None:
            values[name] *= factor
    return type(setup)(**values)


def _suggest_kind(kind: str) -> str:
    """Suggest a kind or species for an unknown kind."""
    match = nearest(kind.lower(), list(dict.fromkeys([*SETUPS, *SPECIES])))
    if match is None or match in SETUPS:
        return f"; did you mean '{match}'?" if match else ""
    return f'; for this beam give kind = "proton" and species = "{match}"'
