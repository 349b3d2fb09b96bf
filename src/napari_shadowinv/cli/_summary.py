"""Tables that the commands print: `summary` of an inversion, and rows of other tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_shadowinv.cli._terminal import plain

if TYPE_CHECKING:
    from rich.table import Table

    from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
    from napari_shadowinv.cli._rerun import InversionRerun
    from napari_shadowinv.inversion import Inversion, Report
    from napari_shadowinv.inversion.budget import Errors
    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.preprocessing import Provenance, Radiograph

Rows = list[tuple[str, str]]

_STYLES = {"warning": "yellow", "sound": "green", "doubtful": "bold yellow", "failed": "bold red"}


def two_columns(title: str, rows: Rows) -> Table:
    """Build a table with names on the left and values on the right.

    Warnings are yellow; a headline has the colour of its level.
    """
    from rich import box
    from rich.table import Table

    table = Table(title=plain(title), title_justify="left", box=box.SIMPLE, show_header=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(plain(name), plain(value, _STYLES.get(name, "")))
    return table


def headline_row(inversion: Inversion, setup: Setup | None) -> tuple[str, str]:
    """Return the headline of a result; the name of the row is the level of trust."""
    headline = inversion.headline_in(setup)
    return (headline.level.value, headline.text)


def summary(inversion: Inversion, shot: Radiograph, written: list[Path]) -> Table:
    """Build the table of an inversion: its headline, its input, its quality and its files."""
    rows = [
        headline_row(inversion, inversion.setup),
        ("image", f"{shot.path}, {size_text(inversion.image)}"),
        *provenance_rows(inversion.provenance),
        ("setup", setup_text(inversion.setup, shot, inversion.image.shape)),
        *inversion_rows(inversion, inversion.setup),
        *closing_rows(inversion.report, written),
    ]
    return two_columns("Inversion", rows)


def rerun_table(again: InversionRerun, written: list[Path]) -> Table:
    """Build the table of a repeated inversion: its headline and the changes."""
    rows = [
        headline_row(again.inversion, again.inversion.setup),
        ("image", f"{again.shot.path}, {size_text(again.inversion.image)}"),
        *[("changed", text) for text in again.changes or ("nothing",)],
        ("difference", again.difference),
        *closing_rows(again.inversion.report, written),
    ]
    return two_columns("Rerun", rows)


def provenance_rows(provenance: Provenance | None) -> Rows:
    """Return the steps before the inversion, and the origin of the source."""
    if provenance is None:
        return []
    source, estimate = provenance.source, provenance.recipe.estimate
    if source is not None:
        origin = source.file or "an array"
    else:
        origin = "uniform" if estimate is None else estimate.described
    rows = [*[("prepared", note) for note in provenance.notes], ("source", origin)]
    for name, mask in (("mask", provenance.mask), ("source mask", provenance.source_mask)):
        if mask is not None:
            rows.append((name, mask.file or "drawn"))
    if provenance.gain is not None:
        rows.append(("gain", f"{provenance.gain:g} (the image was divided by it)"))
    return rows


def inversion_rows(inversion: Inversion, setup: Setup | None) -> Rows:
    """Return the quality of an inversion, and the strongest point of its field."""
    report = inversion.report
    verdict = "converged" if report.converged else "NOT converged"
    free = {"flux left": report.flux_left, "flux entered": report.flux_entered}
    return [
        ("sites", f"{report.n_sites:,}; {report.sites_reason}".removesuffix("; ")),
        (
            "flux residual",
            f"{report.residual:.2g} of a cell, tolerance {report.tolerance:.2g}: {verdict}",
        ),
        ("image residual", f"{100 * report.image_residual:.3g} % of the mean (root mean square)"),
        ("iterations", f"{report.iterations} on {len(report.levels)} levels"),
        (
            "floor",
            f"{report.floor:g} of the mean: {report.floored_pixels} pixels raised, "
            f"{report.clipped_pixels} clipped",
        ),
        ("caustics", f"{inversion.caustic.mean():.2%} of the pixels"),
        *[
            (name, ", ".join(f"{side} {share:.2%}" for side, share in shares.items()))
            for name, shares in free.items()
            if shares
        ],
        *peak_rows(inversion.displacement, setup, mask=inversion.mask, errors=inversion.errors),
        *inversion.error_rows,
    ]


def peak_rows(
    displacement: FloatArray,
    setup: Setup | None,
    *,
    mask: BoolArray | None = None,
    errors: Errors | None = None,
) -> Rows:
    """Return the strongest point inside the mask, in px and with a setup in SI units."""
    from napari_shadowinv.physics.units import shown_fields

    error = None if errors is None else errors.of_peak
    (pixels,) = shown_fields([displacement], None, mask=mask)
    row, column = pixels.peak
    rows = [("displacement", f"{pixels.peak_text(error)}, at y = {row}, x = {column} px")]
    if setup is not None:
        (field,) = shown_fields([displacement], setup, mask=mask)
        rows.append(("field", field.peak_text(error)))
    return rows


def closing_rows(report: Report, written: Iterable[Path] = ()) -> Rows:
    """Return the time, the warnings, and the files."""
    stages = ", ".join(f"{stage} {value:.2f}" for stage, value in report.seconds.items())
    return [
        ("time", f"{sum(report.seconds.values()):.2f} s ({stages})"),
        *[("warning", caution.text) for caution in report.warnings],
        *[("written", str(path)) for path in written],
    ]


def setup_text(
    setup: Setup | None,
    shot: Radiograph | None = None,
    shape: tuple[int, ...] | None = None,
) -> str:
    """Describe the setup in a line, or name the values that are missing for SI units."""
    if setup is not None:
        from napari_shadowinv.physics.setup import field_of_view_text

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
    """Format options as a line that wraps between words."""
    return ", ".join(f"{name} = {value}" for name, value in options.items())


def size_text(array: AnyArray) -> str:
    """Format the size of an image, width first."""
    return f"{array.shape[1]} × {array.shape[0]} px (width × height)"
