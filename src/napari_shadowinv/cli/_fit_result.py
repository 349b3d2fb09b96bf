"""What `shadowinv fit` makes of images, and how it tells the answer."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from napari_shadowinv.cli._tables import Rows, options_text, size_text, two_columns
from napari_shadowinv.cli._terminal import (
    EXIT_NOT_CONVERGED,
    interrupted,
    progress_bars,
    say_on_stderr,
)

if TYPE_CHECKING:
    import xarray
    from rich.table import Table

    from napari_shadowinv.cli._fit_shots import FitShots
    from napari_shadowinv.fitting import Fit, FitOptions, FittedField


def fitted(
    shots: FitShots,
    *,
    fields: Sequence[str],
    gains: str,
    fiducials: Any,
    options: FitOptions,
    quiet: bool,
) -> Fit:
    """Fit fields to images, with a bar for each stage."""
    from napari_shadowinv.fitting import fit

    given = shots.given(gains)
    with nullcontext() if quiet else progress_bars() as show:
        found = fit(
            **given,
            fields=fields,
            fiducials=fiducials,
            options=options,
            on_progress=show,
            should_stop=interrupted,
        )
    return replace(found, setups=shots.setups or ())


def write_fit(
    fit: Fit, shots: FitShots, out: Path, report: Path, overwrite: bool, fiducials: Path | None
) -> None:
    """Write a fit and its figure, both or none of them; tell which files it was made from."""
    from napari_shadowinv.cli._outputs import write_both
    from napari_shadowinv.io.files import sha256, text_of
    from napari_shadowinv.plotting import fit_figure
    from napari_shadowinv.preprocessing import Origin

    title = ", ".join(text_of(row.file.name) for row in shots.rows)
    told = {"origins": shots.origins()}
    if fiducials is not None:
        table = Origin(file=text_of(fiducials.name), sha256=sha256(fiducials))
        told["fiducials"] = table.model_dump_json(exclude_none=True)
    dataset = fit.to_dataset(attributes=told)
    write_both(dataset, fit_figure(fit, title=title), out, report, overwrite)


def fit_table(fit: Fit, shots: FitShots, written: Sequence[Path]) -> Table:
    """Tell whether the answer may be believed, what it is, and where."""
    names = [str(row.file) for row in shots.rows]
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
    from napari_shadowinv.fitting import Fit

    fit = Fit.from_dataset(dataset)
    origins = _origins(dataset.attrs)
    names = [one["image"].get("file", "") for one in origins]
    files = [
        (f"{name} sha256", one[name]["sha256"])
        for one in origins
        for name in ("image", "source", "mask")
        if isinstance(one.get(name), dict) and one[name].get("sha256")
    ]
    return [
        ("kind", f"fit of shadowinv {dataset.attrs['package_version']}"),
        ("created", str(dataset.attrs["created"])),
        *fit_rows(fit, names if len(names) == len(fit.images) else ()),
        *files,
        ("options", options_text(fit.options.model_dump())),
    ]


def _origins(attributes: Mapping[str, Any]) -> list[dict[str, Any]]:
    found = json.loads(attributes.get("origins", "[]"))
    return [one for one in found if isinstance(one, dict) and isinstance(one.get("image"), dict)]


def fit_rows(fit: Fit, names: Sequence[str] = ()) -> Rows:
    """The verdict, how well each image is explained, and the fields; `names` are of the images."""
    from napari_shadowinv.cli._tables import setup_text
    from napari_shadowinv.fitting import Verdict

    determined = fit.verdict is Verdict.DETERMINED
    rows = [
        ("verdict", str(fit.verdict)),
        ("because" if determined else "warning", fit.explanation),
        *[(f"image {k + 1}", _image_text(fit, k, names)) for k in range(len(fit.images))],
        ("size", size_text(fit.images[0])),
        ("setup", setup_text(fit.setups[0] if fit.setups else None)),
        *[(f"field {field.name}", _field_text(fit, field)) for field in fit.fields],
    ]
    if not math.isnan(fit.report.uncertainty):
        rows.append(("error bars", f"{fit.report.uncertainty:.2%} of the displacement (r.m.s.)"))
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
    told = f"{pixels.peak_text}, at y = {row}, x = {column} px"
    if not fit.setups:
        return told
    (shown,) = shown_fields([field.displacement], fit.setups[0], FIELDS[field.name])
    return f"{shown.peak_text}; {told}"
