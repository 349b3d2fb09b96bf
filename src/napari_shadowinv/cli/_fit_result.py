"""What `shadowinv fit` makes of images, and how it tells the answer."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from napari_shadowinv.cli._summary import Rows, options_text, size_text, two_columns
from napari_shadowinv.cli._terminal import (
    EXIT_NOT_CONVERGED,
    interrupted,
    progress_bars,
    say,
    say_on_stderr,
)
from napari_shadowinv.errors import InputError

if TYPE_CHECKING:
    import xarray
    from rich.table import Table

    from napari_shadowinv._typing import FloatArray
    from napari_shadowinv.cli._static_result import Checked
    from napari_shadowinv.fitting import Fit, FittedField
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.pipeline import FitShot
    from napari_shadowinv.preprocessing import FitProvenance, Recipe


def fitted(
    recipe: Recipe, shots: Sequence[FitShot], fiducials: FloatArray | Path | None, quiet: bool
) -> Fit:
    """Fit fields to images, with a bar for each stage."""
    from napari_shadowinv.pipeline import run_fit

    with nullcontext() if quiet else progress_bars() as show:
        return run_fit(
            recipe, shots, fiducials=fiducials, on_progress=show, should_stop=interrupted
        )


def refined(inversion: Inversion, made: FitProvenance, quiet: bool) -> Fit:
    """Refine an inversion as a fit was made from it, with a bar for each stage."""
    from napari_shadowinv.pipeline import run_refinement

    assert made.recipe.fit is not None
    with nullcontext() if quiet else progress_bars() as show:
        return run_refinement(
            inversion,
            made.images[0].setup,
            made.recipe.fit,
            on_progress=show,
            should_stop=interrupted,
        )


def compared(
    recipe: Recipe,
    shots: Sequence[FitShot],
    fiducials: Path | None,
    quiet: bool,
    *,
    written: str | None,
) -> Fit:
    """Fit several choices of fields and tell how likely each is; return the one to be written."""
    from napari_shadowinv.pipeline import run_comparison
    from napari_shadowinv.pipeline._fit import COMPARED

    wanted = set(recipe.fit.fields or ()) if recipe.fit else set()
    if written is not None and wanted not in map(set, COMPARED):
        choices = "; ".join(",".join(one) for one in COMPARED)
        raise InputError(
            f"received --fields {written} and --compare, which compares {choices}: write one of "
            "these, or leave out --fields to write the likeliest"
        )
    with nullcontext() if quiet else progress_bars() as show:
        fits = run_comparison(
            recipe, shots, fiducials=fiducials, on_progress=show, should_stop=interrupted
        )
    if not quiet:
        say(comparison_table(fits))
    if written is None:
        return fits[0]
    return next(one for one in fits if {field.name for field in one.fields} == wanted)


def comparison_table(fits: Sequence[Fit]) -> Table:
    """Tell how well each choice of fields explains the images, the likeliest first."""
    from rich import box
    from rich.table import Table

    headings = "fields", "χ²", "log evidence", "verdict"
    table = Table(*headings, title="Comparison", title_justify="left", box=box.SIMPLE)
    table.caption = "A difference of 10 decides."
    best = fits[0].report.log_evidence
    for one in fits:
        names = ", ".join(field.name for field in one.fields)
        chi2 = ", ".join(f"{value:.3g}" for value in one.chi2)
        worse = one.report.log_evidence - best
        table.add_row(names, chi2, "likeliest" if one is fits[0] else f"{worse:+.1f}", one.verdict)
    return table


def write_fit(
    fit: Fit,
    names: Sequence[str],
    out: Path,
    report: Path,
    overwrite: bool,
    checked: Checked | None = None,
) -> None:
    """Write a fit and its figures, all or none of them; `names` are of the images."""
    from napari_shadowinv.cli._outputs import write_with_figures
    from napari_shadowinv.io.files import text_of
    from napari_shadowinv.plotting import fit_figure

    title = ", ".join(text_of(Path(name).name) for name in names)
    dataset, figures = fit.to_dataset(), {report: fit_figure(fit, title=title)}
    if checked is not None:
        dataset = checked.added_to(dataset)
        figures |= checked.figures(fit, report, title)
    write_with_figures(dataset, figures, out, overwrite)


def fit_table(fit: Fit, names: Sequence[str], written: Sequence[Path]) -> Table:
    """Tell whether the answer may be believed, what it is, and where."""
    rows = [*fit_rows(fit, names), *[("written", str(path)) for path in written]]
    return two_columns("Fit", rows)


def alarm_unless_determined(fit: Fit, out: Path) -> None:
    """End with an exit code of its own if what was written may be another field."""
    from napari_shadowinv.fitting import Verdict

    if fit.verdict is not Verdict.DETERMINED:
        say_on_stderr(f"{fit.verdict.upper()}: {out} was written, but {fit.explanation}")
        raise typer.Exit(EXIT_NOT_CONVERGED)


def fit_file_rows(dataset: xarray.Dataset) -> Rows:
    """Tell what the file of a fit holds."""
    from napari_shadowinv.cli._static_result import static_file_rows
    from napari_shadowinv.fitting import Fit

    fit = Fit.from_dataset(dataset)
    made = fit.provenance
    return [
        ("kind", f"fit of shadowinv {dataset.attrs['package_version']}"),
        ("created", str(dataset.attrs["created"])),
        *fit_rows(fit, [] if made is None else [one.image.file for one in made.images]),
        *static_file_rows(dataset),
        *([] if made is None else _made_from(made)),
        ("options", options_text(fit.options.model_dump())),
    ]


def _made_from(made: FitProvenance) -> Rows:
    """What was done to the images and known about them, and the files."""
    steps = [("step", step.described) for step in made.recipe.steps]
    choices = made.recipe.fit
    known = {} if choices is None else choices.model_dump(exclude_none=True, exclude={"options"})
    rows = [*steps, ("fit", options_text(known))]
    for number, one in enumerate(made.images, 1):
        masks = [made.masks[place] for place in (one.mask, one.source_mask) if place is not None]
        origins = [("image", one.image), ("source", one.source)]
        for name, origin in [*origins, *(("mask", mask) for mask in masks)]:
            if origin is not None and origin.sha256:
                rows.append((f"{name} {number} sha256", f"{origin.sha256} ({origin.file})"))
    if made.fiducials is not None and made.fiducials.sha256:
        rows.append(("fiducials sha256", f"{made.fiducials.sha256} ({made.fiducials.file})"))
    return rows


def fit_rows(fit: Fit, names: Sequence[str] = ()) -> Rows:
    """The verdict, how well each image is explained, and the fields; `names` are of the images."""
    from napari_shadowinv.cli._summary import setup_text
    from napari_shadowinv.fitting import Verdict

    determined = fit.verdict is Verdict.DETERMINED
    rows = [
        ("verdict", str(fit.verdict)),
        ("because" if determined else "warning", fit.explanation),
        *[("warning", caution.text) for caution in fit.warnings],
        *[(f"image {k + 1}", _image_text(fit, k, names)) for k in range(len(fit.images))],
        ("size", size_text(fit.images[0])),
        ("setup", setup_text(fit.setups[0] if fit.setups else None)),
        *[(f"field {field.name}", _field_text(fit, field)) for field in fit.fields],
    ]
    rows += fit.error_rows
    best, *others = fit.basins
    rows += [
        (
            "other start",
            f"{one.start}: objective {one.objective / best.objective - 1:+.2%}, displacement "
            f"{one.distance:.2%} away",
        )
        for one in others
    ]
    if fit.folded:
        rows.append(("crossed rays", f"{fit.folded:.1%} of the pixels"))
    if not fit.report.converged:
        rows.append(
            ("warning", f"not converged in {fit.report.iterations} steps: allow more (--steps)")
        )
    stages = ", ".join(f"{stage} {value:.2f}" for stage, value in fit.report.seconds.items())
    return [*rows, ("time", f"{sum(fit.report.seconds.values()):.2f} s ({stages})")]


def _image_text(fit: Fit, k: int, names: Sequence[str]) -> str:
    parts = [names[k]] if names and names[k] else []
    parts += [fit.setups[k].probe] if fit.setups else []
    strengths = ", ".join(f"{one:.3g}" for one in fit.strengths[k])
    parts += [f"χ² {fit.chi2[k]:.3g}", f"strength {strengths}", f"gain {fit.gains[k]:.4g}"]
    if k and fit.options.align != "none":
        dy, dx = fit.frames[k][[0, 3]]
        parts.append(f"shifted by y {dy:+.3g}, x {dx:+.3g} px")
    return ", ".join(parts)


def _field_text(fit: Fit, field: FittedField) -> str:
    from napari_shadowinv.fitting import FIELDS
    from napari_shadowinv.physics.units import shown_fields

    (pixels,) = shown_fields([field.displacement], None)
    row, column = pixels.peak
    peak = f"{fit.peak_text(field, pixels)}, at y = {row}, x = {column} px"
    if not fit.setups:
        return peak
    (shown,) = shown_fields([field.displacement], fit.setups[0], FIELDS[field.name])
    return f"{fit.peak_text(field, shown)}; {peak}"
