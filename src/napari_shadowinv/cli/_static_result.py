"""Checks of `shadowinv fit`: images left out, and windows of images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from napari_shadowinv.cli._summary import Rows
from napari_shadowinv.cli._terminal import (
    EXIT_NOT_CONVERGED,
    plain,
    say_on_stderr,
)
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.formats import RESULT

if TYPE_CHECKING:
    import xarray
    from matplotlib.figure import Figure
    from rich.table import Table

    from napari_shadowinv.fitting import Fit, FitWindows, LeaveOneOut
    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.pipeline.static_checks import StaticChecks


def check_requests(
    count: int, *, left_out: bool, window: int | None, fiducials: Path | None, result: Path
) -> None:
    """Refuse, before any work, checks that the images or the result file do not allow."""
    from napari_shadowinv.pipeline.static_checks import check_count, check_window

    if left_out:
        check_count(count)
    if window is not None:
        check_window(window, count)
    flag = "--leave-one-out" if left_out else "--energy-window" if window is not None else None
    if flag is None:
        return
    if fiducials is not None:
        raise InputError(
            f"received {flag} and --fiducials, which apply to the first image only: use one of them"
        )
    if result.suffix.lower() not in RESULT.suffixes:
        raise InputError(
            f"received {flag} and {result}, a format without it: write a {RESULT.suffix} file"
        )


def static_figures(report: Path, *, left_out: bool, window: int | None) -> list[Path]:
    """Return the files of the checks' figures."""
    requests = {"left_out": left_out, "windows": window is not None}
    return [
        report.with_name(f"{report.stem}_{name}{report.suffix}")
        for name, is_requested in requests.items()
        if is_requested
    ]


def check_figures(
    checks: StaticChecks, setups: Sequence[Setup], report: Path, title: str
) -> dict[Path, Figure]:
    """Return the figures of the checks by file."""
    from napari_shadowinv.plotting import left_out_figure, windows_figure

    left_out, windows = static_figures(report, left_out=True, window=1)
    figures = {}
    if checks.left_out is not None:
        figures[left_out] = left_out_figure(checks.left_out, setups, title=title)
    if checks.windows is not None:
        figures[windows] = windows_figure(checks.windows, title=title)
    return figures


def check_tables(
    checks: StaticChecks, fit: Fit, names: Sequence[str], beams: Sequence[str]
) -> list[Table]:
    """Return a table for each check; `beams` are the energies or wavelengths of the rows."""
    tables = []
    if checks.left_out is not None:
        tables.append(left_out_table(checks.left_out, fit, names, beams))
    if checks.windows is not None:
        tables.append(windows_table(checks.windows))
    return tables


def exit_unless_static(checks: StaticChecks, out: Path) -> None:
    """Exit with an error code if a static field does not explain an image."""
    if checks.left_out is not None and not checks.left_out.explained.all():
        say_on_stderr(f"NOT STATIC: {out} was written, but {checks.left_out.explanation}")
        raise typer.Exit(EXIT_NOT_CONVERGED)


def left_out_table(
    left_out: LeaveOneOut, fit: Fit, names: Sequence[str], beams: Sequence[str]
) -> Table:
    """Build a table of how well the other images predict each image.

    Without setups, the texts of the beams come from the rows.
    """
    from napari_shadowinv.physics.setup import beam_values

    noun, quantity_and_values = "energy", beam_values(fit.setups)
    if quantity_and_values is not None:
        quantity, values = quantity_and_values
        noun, beams = quantity.noun, [quantity.text(value) for value in values]
    headings = ["image", noun, "χ² left out", "χ² alone", "up to", "r.m.s.", "verdict"]
    table = _table("Left out", headings, left_out.explanation)
    for k, (name, beam) in enumerate(zip(names, beams, strict=True)):
        explained = bool(left_out.explained[k])
        table.add_row(
            plain(name),
            beam,
            f"{left_out.chi2[k]:.3g}",
            f"{left_out.alone[k]:.3g}",
            f"{left_out.limit[k]:.3g}",
            f"{left_out.rms[k]:.2%}",
            plain(_verdict(explained), "" if explained else "yellow"),
        )
    return table


def short_names(names: Sequence[str]) -> list[str]:
    """Return file names without folders and endings, unless two of them become equal.

    >>> short_names(["layers/layer_03.tif", "layers/layer_04.tif"])
    ['layer_03', 'layer_04']
    """
    stems = [Path(name).stem for name in names]
    return stems if len(set(stems)) == len(stems) else list(names)


def windows_table(windows: FitWindows) -> Table:
    """Build a table of the fit of each window, and the peaks of its fields."""
    import numpy as np

    from napari_shadowinv.physics.setup import deflector_titles
    from napari_shadowinv.physics.units import shown_fields

    fields, quantity = windows.fits[0].fields, windows.beam_quantity
    headings = [
        "images",
        f"mean {quantity.noun if quantity else 'energy'}",
        "time of flight",
        "χ²",
        *[f.name for f in fields],
        "verdict",
    ]
    caption = "" if windows.setup else "Fields at the strength of the image displaced most."
    table = _table("Windows", headings, caption)
    used = np.stack([fit.used for fit in windows.fits])[:, None, None]
    unmasked = np.where(used, windows.displacement, np.nan)
    peaks = [
        shown_fields(list(unmasked[:, m]), windows.setup, deflector_titles()[field.name])
        for m, field in enumerate(fields)
    ]
    means, times = windows.beam_means, windows.times_of_flight
    for w, fit in enumerate(windows.fits):
        table.add_row(
            ", ".join(str(k + 1) for k in windows.numbers[w]),
            "" if quantity is None or means is None else quantity.text(means[w]),
            "" if times is None else f"{times[w] * 1e12:.4g} ps",
            ", ".join(f"{value:.3g}" for value in fit.chi2),
            *[values[w].peak_text() for values in peaks],
            str(fit.verdict),
        )
    return table


def static_file_rows(dataset: xarray.Dataset) -> Rows:
    """Describe the checks in the file of a fit."""
    from napari_shadowinv.fitting import LeaveOneOut
    from napari_shadowinv.fitting.windows import PREFIX

    rows: Rows = []
    if "left_out_chi2" in dataset:
        left_out = LeaveOneOut.from_dataset(dataset)
        is_static = bool(left_out.explained.all())
        rows.append(("left out" if is_static else "warning", left_out.explanation))
        rows += [
            (
                f"left out {k + 1}",
                f"χ² {left_out.chi2[k]:.3g}, alone {left_out.alone[k]:.3g}, "
                f"r.m.s. {left_out.rms[k]:.2%}: {_verdict(bool(left_out.explained[k]))}",
            )
            for k in range(len(left_out.chi2))
        ]
    if f"{PREFIX}chi2" in dataset:
        numbers, chi2 = dataset[f"{PREFIX}image_number"].values, dataset[f"{PREFIX}chi2"].values
        for w, verdict in enumerate(dataset[f"{PREFIX}verdict"].values):
            images = ", ".join(str(k) for k in numbers[w])
            values = ", ".join(f"{value:.3g}" for value in chi2[w])
            rows.append((f"window {w + 1}", f"images {images}, χ² {values}: {verdict}"))
    return rows


def _verdict(explained: bool) -> str:
    return "explained" if explained else "not explained"


def _table(title: str, headings: Sequence[str], caption: str) -> Table:
    from rich import box
    from rich.table import Table

    return Table(
        *headings,
        title=title,
        title_justify="left",
        box=box.SIMPLE,
        caption=plain(caption),
        caption_justify="left",
    )
