"""Tables that the commands print, and their rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from napari_shadowinv.cli._terminal import plain

if TYPE_CHECKING:
    from rich.table import Table

    from napari_shadowinv.facts import Fact, Headline
    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.provenance import Provenance
    from napari_shadowinv.shot import Shot

Rows = list[tuple[str, ...]]
"""Name, value, and the level of trust of a headline."""

_STYLES = {
    "warning": "yellow",
    "sound": "green",
    "depends on the beam": "cyan",
    "doubtful": "bold yellow",
    "failed": "bold red",
}


def two_columns(title: str, rows: Rows) -> Table:
    """Build a table with names on the left and values on the right.

    Warnings are yellow; a headline has the colour of its level.
    """
    from rich import box
    from rich.table import Table

    table = Table(title=plain(title), title_justify="left", box=box.SIMPLE, show_header=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value, *level in rows:
        table.add_row(plain(name), plain(value, _STYLES.get(level[0] if level else name, "")))
    return table


def headline_row(headline: Headline) -> tuple[str, str, str]:
    """Return the headline of a result; the name of the row is its title."""
    return (headline.title, headline.text, headline.level.value)


def provenance_rows(provenance: Provenance | None) -> Rows:
    """Return the files that a result was made from, and what was done to them."""
    if provenance is None:
        return []
    rows: Rows = []
    for number, image in enumerate(provenance.images, 1):
        of_image = f" {number}" if len(provenance.images) > 1 else ""
        files = {"image": image, "source": image.source, "dark frame": image.dark}
        files["mask"] = provenance.mask_of(image.mask)
        files["source mask"] = provenance.mask_of(image.source_mask)
        for name, origin in files.items():
            if origin is not None and (origin.file or origin is not image):
                checksum = f", sha256 {origin.sha256}" if origin.sha256 else ""
                rows.append((name + of_image, f"{origin.file or 'an array'}{checksum}"))
        rows += [(f"prepared{of_image}", note) for note in image.notes]
    recipe, table = provenance.recipe, provenance.fiducials
    if recipe.steps and not any(image.notes for image in provenance.images):  # of many shots
        rows.append(("steps", "; ".join(step.summary for step in recipe.steps)))
    if recipe.estimate is not None:
        rows.append(("source", recipe.estimate.summary))
    if recipe.fit is not None:
        choices = recipe.fit.model_dump(exclude_none=True, exclude={"options"})
        rows.append(("fit", options_text(choices)))
    if table is not None and table.sha256:
        rows.append(("fiducials", f"{table.file}, sha256 {table.sha256}"))
    return rows


def fact_rows(facts: Iterable[Fact], *, details: bool = False) -> Rows:
    """Return facts as rows of a table, without the verdict."""
    return [
        (fact.title[:1].lower() + fact.title[1:], fact.text)
        for fact in facts
        if fact.key != "verdict" and (details or not fact.is_detail)
    ]


def result_rows(result: Any, *, names: Sequence[str] = (), shot: Shot | None = None) -> Rows:
    """Return headline, facts and setup of a result.

    `names` are the images of a fit; `shot` has what the file of an image says about the setup.
    """
    facts = result.facts_with_names(names) if names else result.facts
    image = result.images[0] if hasattr(result, "images") else result.image
    return [
        headline_row(result.headline),
        *fact_rows(facts),
        ("setup", setup_text(result.setup, shot, image.shape)),
    ]


def setup_text(
    setup: Setup | None, shot: Shot | None = None, shape: tuple[int, ...] | None = None
) -> str:
    """Describe the setup in a line, or name the values that are missing for SI units."""
    if setup is not None:
        from napari_shadowinv.physics.beam import field_of_view_text

        text = (
            f"{setup.probe}, magnification {setup.magnification:.4g}, "
            f"pixel {setup.object_pixel_size * 1e6:.4g} µm at the object"
        )
        if shape is None:
            return text
        return f"{text}, field of view {field_of_view_text(setup, (shape[0], shape[1]))}"
    geometry = {} if shot is None else shot.metadata.get("geometry", {})
    if geometry:
        stated = {name.removeprefix("detector_") for name in geometry}
        needed = ("energy", "source_object_distance", "object_image_distance", "pixel_size")
        missing = [name.replace("_", " ") for name in needed if name not in stated]
        return (
            f"none: the file gives the geometry but not the {', nor the '.join(missing)}; give it "
            "with --setup"
        )
    return "none: results in pixels; give --setup for SI units"


def options_text(options: Mapping[str, Any]) -> str:
    """Format the options that have a value as a line that wraps between words."""
    return ", ".join(f"{name} = {value}" for name, value in options.items() if value is not None)


def size_text(shape: Sequence[int]) -> str:
    """Format the size of an image of shape (H, W), width first."""
    return f"{shape[1]} × {shape[0]} px (width × height)"
