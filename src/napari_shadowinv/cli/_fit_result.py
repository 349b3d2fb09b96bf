"""Fits, and their checks, as the commands run, write and print them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from napari_shadowinv.cli import _summary
from napari_shadowinv.cli._terminal import say, work_callbacks
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.formats import RESULT

if TYPE_CHECKING:
    import xarray
    from rich.table import Table

    from napari_shadowinv.fitting import Fit
    from napari_shadowinv.preprocessing import Recipe
    from napari_shadowinv.provenance import Provenance
    from napari_shadowinv.shot import Shot


def compare_fields(
    recipe: Recipe, shots: Sequence[Shot], quiet: bool, *, written: str | None
) -> Fit:
    """Fit several choices of fields and print how likely each is; return the one to write."""
    from napari_shadowinv.pipeline import run_comparison
    from napari_shadowinv.pipeline.fit_run import compared_fields

    names = set(recipe.fit.fields or ()) if recipe.fit else set()
    first = shots[0].setup
    compared = compared_fields(None if first is None else [first])
    if written is not None and names not in map(set, compared):
        choices = "; ".join(",".join(choice) for choice in compared)
        raise InputError(
            f"received fit.fields={written} and --compare, which compares {choices}: write one of "
            "these, or leave out fit.fields to write the likeliest"
        )
    with work_callbacks(quiet) as callbacks:
        fits = run_comparison(recipe, shots, **callbacks)
    if not quiet:
        say(comparison_table(fits))
    if written is None:
        return fits[0]
    return next(fit for fit in fits if {field.name for field in fit.fields} == names)


def comparison_table(fits: Sequence[Fit]) -> Table:
    """Build a table of the choices of fields, the likeliest first."""
    from rich import box
    from rich.table import Table

    headings = "fields", "χ²", "log evidence", "verdict"
    table = Table(*headings, title="Comparison", title_justify="left", box=box.SIMPLE)
    table.caption = "A difference of 10 is decisive."
    best = fits[0].report.log_evidence
    for fit in fits:
        names = ", ".join(field.name for field in fit.fields)
        chi2 = ", ".join(f"{value:.3g}" for value in fit.chi2)
        evidence = "likeliest" if fit is fits[0] else f"{fit.report.log_evidence - best:+.1f}"
        table.add_row(names, chi2, evidence, fit.verdict)
    return table


def fit_file_rows(dataset: xarray.Dataset) -> _summary.Rows:
    """Describe the file of a fit."""
    from napari_shadowinv.fitting import Fit, LeaveOneOut

    fit = Fit.from_dataset(dataset)
    left_out = LeaveOneOut.from_dataset(dataset).facts if "left_out_chi2" in dataset else ()
    provenance = fit.provenance
    return [
        ("kind", f"fit of shadowinv {dataset.attrs['package_version']}"),
        ("created", str(dataset.attrs["created"])),
        *fit_rows(fit, details=True),
        *_summary.fact_rows(left_out),
        *([] if provenance is None else _provenance_rows(provenance)),
        ("options", _summary.options_text(fit.options.model_dump())),
    ]


def _provenance_rows(provenance: Provenance) -> _summary.Rows:
    """Return the steps before a fit, its choices, and the checksums of its files."""
    steps = [("step", step.summary) for step in provenance.recipe.steps]
    fit = provenance.recipe.fit
    choices = {} if fit is None else fit.model_dump(exclude_none=True, exclude={"options"})
    rows: _summary.Rows = [*steps, ("fit", _summary.options_text(choices))]
    for number, image in enumerate(provenance.images, 1):
        masks = map(provenance.mask_of, (image.mask, image.source_mask))
        origins = [("image", image), ("source", image.source)]
        for name, origin in [*origins, *(("mask", mask) for mask in masks)]:
            if origin is not None and origin.sha256:
                rows.append((f"{name} {number} sha256", f"{origin.sha256} ({origin.file})"))
    table = provenance.fiducials
    if table is not None and table.sha256:
        rows.append(("fiducials sha256", f"{table.sha256} ({table.file})"))
    return rows


def fit_rows(
    fit: Fit,
    names: Sequence[str] = (),
    printed: tuple[str, ...] = (),
    *,
    details: bool = False,
) -> _summary.Rows:
    """Return the headline, facts and setup of a fit of images with these names."""
    facts = fit.facts_with_names(names) if names else fit.facts
    return [
        _summary.headline_row(fit.headline),
        *_summary.fact_rows(facts, printed, details=details),
        ("setup", _summary.setup_text(fit.setup, shape=fit.images[0].shape)),
    ]


def check_leave_one_out(count: int, fiducials: Path | None, result: Path) -> None:
    """Refuse, before any work, to leave images out where inputs or outputs do not allow it."""
    from napari_shadowinv.fitting.left_out import check_count

    check_count(count)
    if fiducials is not None:
        raise InputError(
            "received --leave-one-out and --fiducials, which apply to the first image only: use "
            "one of them"
        )
    if result.suffix.lower() not in RESULT.suffixes:
        raise InputError(
            f"received --leave-one-out and {result}, a format without it: write a {RESULT.suffix} "
            "file"
        )


def short_names(names: Sequence[str], beams: Sequence[str]) -> list[str]:
    """Return file names without folders and endings, unless two of them become equal.

    The energy or wavelength of an image without a setup follows its name.

    >>> short_names(["layers/layer_03.tif", "layers/layer_04.tif"], ["", "8 MeV"])
    ['layer_03', 'layer_04 (8 MeV)']
    """
    stems = [Path(name).stem for name in names]
    pairs = zip(stems if len(set(stems)) == len(stems) else names, beams, strict=True)
    return [f"{name} ({beam})" if beam else name for name, beam in pairs]
