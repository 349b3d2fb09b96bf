"""Images of a table's rows or of flags: `read_rows`; their setup: `row_setup`."""

from __future__ import annotations

from collections.abc import Sequence

from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup import Setup, beam_quantities, setup_from_dict
from napari_shadowinv.pipeline.files import read_part, setup_from
from napari_shadowinv.pipeline.fit_run import FitShot
from napari_shadowinv.pipeline.shot_table import ShotRow
from napari_shadowinv.preprocessing import Radiograph, Recipe

__all__ = ["read_rows", "row_setup"]


def read_rows(
    rows: Sequence[ShotRow],
    recipe: Recipe,
    *,
    channel: str | None = None,
    variable: str | None = None,
) -> tuple[FitShot, ...]:
    """Read the images of rows, whose energies or wavelengths complete the setups.

    Parameters
    ----------
    rows : sequence of ShotRow
        Description of each image.
    recipe : Recipe
        Its setup applies to images without one.
    channel, variable : str, optional
        Part of each file to read; the channel also applies to sources.
    """
    return tuple(_read(row, recipe, channel, variable) for row in rows)


def _read(row: ShotRow, recipe: Recipe, channel: str | None, variable: str | None) -> FitShot:
    shot = read_part(row.file, channel, variable)
    beam = None if row.source_file is None else read_part(row.source_file, channel)
    return FitShot(
        image=shot,
        setup=row_setup(row, shot, recipe),
        source="unknown" if row.source == "unknown" else beam,
        mask=row.mask,
        strength=row.strength,
        brightness=row.brightness,
        psf=row.psf,
        noise=row.noise,
    )


def row_setup(row: ShotRow, shot: Radiograph, recipe: Recipe) -> Setup | None:
    """Return the setup of an image from its row, the recipe, or its file, in this order.

    An `InputError` is raised if the row has an energy or a wavelength, no strength, and there is no
    setup to complete it. With a strength, an energy without a setup is a name of the image.
    """
    changes = row.beam
    if row.setup is not None:
        return setup_from(row.setup, shot.metadata.get("geometry"), changes)
    setup = recipe.setup or shot.setup
    if setup is not None:
        return setup_from_dict({**setup.model_dump(), **changes}, str(row.file))
    if not changes or row.strength is not None:
        return None
    nouns = " and ".join(beam_quantities()[name].noun for name in changes)
    article = "an" if nouns[0] in "aeiou" else "a"
    raise InputError(
        f"{row.file} has {article} {nouns} of {row.beam_text} and no setup: give the rest of the "
        "geometry with --setup"
    )
