"""Tables that the commands print, and their rows."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_shadowinv.cli._terminal import plain

if TYPE_CHECKING:
    from rich.table import Table

    from napari_shadowinv._typing import AnyArray
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
    """Return the steps before the inversion, and the origin of the source."""
    if provenance is None:
        return []
    image, estimate = provenance.image, provenance.recipe.estimate
    source = image.source
    if source is not None:
        origin = source.file or "an array"
    else:
        origin = "uniform" if estimate is None else estimate.summary
    rows: Rows = [*[("prepared", note) for note in image.notes], ("source", origin)]
    for name, index in (("mask", image.mask), ("source mask", image.source_mask)):
        if (mask := provenance.mask_of(index)) is not None:
            rows.append((name, mask.file or "drawn"))
    if image.brightness is not None:
        rows.append(("brightness", f"{image.brightness:g} (the image was divided by it)"))
    return rows


def fact_rows(
    facts: Iterable[Fact], printed: tuple[str, ...] = (), *, details: bool = False
) -> Rows:
    """Return facts as rows of a table, without the verdict and cautions that are printed."""
    return [
        (fact.title[:1].lower() + fact.title[1:], fact.text)
        for fact in facts
        # A fit puts the name of the image first.
        if fact.key != "verdict" and not fact.text.endswith(printed)
        if details or not fact.is_detail
    ]


def written_rows(paths: Iterable[Path], failed: Collection[Path] = ()) -> Rows:
    """Return a row for each file that was written, unless writing it has failed."""
    return [("written", str(path)) for path in paths if path not in failed]


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
    if not geometry:
        return "none: results in pixels; give --setup for SI units"
    needed = {
        "energy": "energy",
        "source_object_distance": "distance from source to object",
        "object_image_distance": "distance from object to image",
    }
    missing = [words for name, words in needed.items() if name not in geometry]
    if not {"pixel_size", "detector_pixel_size"} & geometry.keys():
        missing.append("pixel size")
    return (
        f"none: the file gives the geometry but not the {', nor the '.join(missing)}; give it "
        "with --setup"
    )


def options_text(options: Mapping[str, Any]) -> str:
    """Format the options that have a value as a line that wraps between words."""
    return ", ".join(f"{name} = {value}" for name, value in options.items() if value is not None)


def size_text(array: AnyArray) -> str:
    """Format the size of an image, width first."""
    return f"{array.shape[1]} × {array.shape[0]} px (width × height)"
