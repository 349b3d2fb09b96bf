"""The experiment's geometry and probe, and the fields that follow from a displacement.

- describe an experiment: `ProtonSetup`, `OpticalSetup`; any of them: `Setup`, by kind `SETUPS`
- how a kind of setup is described: `BeamSetup`, `SIField`, `MainField`, `Deflector`,
  `BeamQuantity`; of all kinds: `deflector_titles`, `beam_quantities`; of some setups:
  `beam_values`
- get it back from a file's content: `setup_from_dict`; with larger pixels: `bin_setup`
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

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import BeforeValidator, SerializeAsAny, ValidationError
from pydantic_core import PydanticKnownError

from napari_shadowinv._system.validation import nearest, validated
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup._beam import (
    BeamQuantity,
    BeamSetup,
    Deflector,
    MainField,
    SIField,
    displacement_from_potential,
)
from napari_shadowinv.physics.setup._optical import OpticalSetup
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
    ProtonSetup,
    Species,
)

__all__ = [
    "SETUPS",
    "SPECIES",
    "BeamQuantity",
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
    "beam_quantities",
    "beam_values",
    "bin_setup",
    "deflection_warnings",
    "deflector_titles",
    "displacement_from_potential",
    "field_of_view_text",
    "geometry_text",
    "setup_from_dict",
    "setup_warnings",
]

SETUPS: dict[str, type[BeamSetup]] = {
    model.model_fields["kind"].default: model for model in (ProtonSetup, OpticalSetup)
}
"""The kinds of setup by name. A further kind is added here, and nowhere else."""


def _as_kind(value: Any) -> Any:
    """Turn a mapping into the setup of its kind; pydantic reports its errors as of a union."""
    if not isinstance(value, Mapping):
        return value
    kind = value.get("kind")
    if kind is None:
        raise PydanticKnownError("union_tag_not_found", {"discriminator": "'kind'"})
    if not isinstance(kind, str) or kind not in SETUPS:
        tags = ", ".join(map(repr, SETUPS))
        context = {"discriminator": "'kind'", "tag": str(kind), "expected_tags": tags}
        raise PydanticKnownError("union_tag_invalid", context)
    try:
        return SETUPS[kind].model_validate(value)
    except ValidationError as error:
        details: list[Any] = [
            {**detail, "loc": (kind, *detail["loc"])} for detail in error.errors(include_url=False)
        ]
        raise ValidationError.from_exception_data(kind, details) from None


Setup = Annotated[SerializeAsAny[BeamSetup], BeforeValidator(_as_kind)]
"""Setup of any kind in `SETUPS`, as the field of a model."""


def deflector_titles() -> dict[str, str]:
    """Return the titles of all causes of a deflection, by the keys that a fit takes."""
    return {
        deflector.key: deflector.title for kind in SETUPS.values() for deflector in kind.deflectors
    }


def beam_quantities() -> dict[str, BeamQuantity]:
    """Return the quantities that differ between beams, by name, for all kinds of setup."""
    quantities = (kind.beam_quantity() for kind in SETUPS.values())
    return {quantity.name: quantity for quantity in quantities}


def beam_values(setups: Sequence[Setup]) -> tuple[BeamQuantity, tuple[float, ...]] | None:
    """Return the quantity that differs between beams, and its values; None without setups.

    Setups of several kinds have no such quantity.
    """
    if len({type(setup) for setup in setups}) != 1:
        return None
    return setups[0].beam_quantity(), tuple(setup.beam_value for setup in setups)


def setup_from_dict(mapping: Mapping[str, Any], where: str = "setup") -> Setup:
    """Create a setup of the right kind from the content of a file.

    Parameters
    ----------
    mapping : mapping of str to object
        The fields, with a ``kind`` of `SETUPS`, such as "proton" (and a ``species``, for
        electrons or other ions) or "optical".
    where : str, optional
        Where the mapping comes from; an error's message begins with it.

    Raises
    ------
    InputError
        If a key is unknown or missing or a value cannot be used; the message names it.

    Examples
    --------
    >>> light = {"wavelength": 810e-9, "object_image_distance": 0.01, "pixel_size": 1e-6}
    >>> setup_from_dict({"kind": "optical", **light}).is_collimated
    True
    """
    if not isinstance(mapping, Mapping):
        raise InputError(
            f"{where}: received a {type(mapping).__name__}, expected a table of keys and values"
        )
    kind = mapping.get("kind")
    if kind is None:
        raise InputError(f"{where}: 'kind' is missing, {_expected_kind()}")
    if not isinstance(kind, str) or kind not in SETUPS:
        raise InputError(
            f"{where}: 'kind' is {kind!r}, {_expected_kind()}{_suggest_kind(str(kind))}"
        )
    return validated(SETUPS[kind], mapping, where)


def bin_setup(setup: Setup, factor: int) -> Setup:
    """Return the setup of an image whose pixels were summed in blocks of side `factor`."""
    values = setup.model_dump()
    for name in ("pixel_size", "detector_pixel_size"):
        if values.get(name) is not None:
            values[name] *= factor
    return type(setup)(**values)


def _expected_kind() -> str:
    other_kinds = [repr(kind) for kind in SETUPS if kind != "proton"]
    return (
        "it must be 'proton' (any charged particles, named by 'species': "
        f"{', '.join(SPECIES)}) or {' or '.join(other_kinds)}"
    )


def _suggest_kind(kind: str) -> str:
    """Suggest a kind or species for an unknown kind."""
    match = nearest(kind, [*SETUPS, *SPECIES])
    if match is None or match in SETUPS:
        return f"; did you mean '{match}'?" if match else ""
    return f'; for this beam give kind = "proton" and species = "{match}"'
