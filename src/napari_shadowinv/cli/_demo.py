"""The shot that `shadowinv demo` simulates, and the comparison of its inversion with the truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from napari_shadowinv.cli._summary import (
    fact_rows,
    headline_row,
    setup_text,
    two_columns,
    written_rows,
)

if TYPE_CHECKING:
    from rich.table import Table

    from napari_shadowinv._typing import FloatArray
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.physics.setup import ProtonSetup

    Fields = Mapping[str, FloatArray]


def simulate_shot(setup: ProtonSetup, dm: float, noise: float) -> tuple[FloatArray, FloatArray]:
    """Return an image with noise, and its true displacement."""
    import numpy as np

    from napari_shadowinv.physics.forward import synthetic_image
    from napari_shadowinv.physics.phantoms import toroid

    truth = toroid((200, 200), setup, peak=dm, sigma=30e-6).displacement
    image = synthetic_image(truth)
    grain = np.random.default_rng(0).normal(size=image.shape)
    return image + noise * image.mean() * grain, truth


def fields_to_compare(image: FloatArray, truth: FloatArray, inversion: Inversion) -> Fields:
    """Return three displacements: the truth, the inversion, and a linear inversion."""
    from napari_shadowinv.physics.poisson import poisson_invert
    from napari_shadowinv.physics.setup import displacement_from_potential

    poisson = displacement_from_potential(poisson_invert(image))
    return {"True": truth, "Retrieved": inversion.displacement, "Poisson": poisson}


def write_demo(
    folder: Path, name: str, inversion: Inversion, setup: ProtonSetup, fields: Fields
) -> list[Path]:
    """Write the result, its figure, and the fields side by side."""
    from napari_shadowinv.io import write
    from napari_shadowinv.io.formats import PNG, RESULT
    from napari_shadowinv.plotting import comparison_figure, report_figure, save_figure

    caption = "Errors: " + "; ".join(
        f"{name} {_errors_text(fields, name)}" for name in ("Retrieved", "Poisson")
    )
    comparison = comparison_figure(fields, setup, title="True and retrieved", caption=caption)
    report = report_figure(inversion, setup, title=f"Demo {name}")
    return [
        write(folder / f"{name}{RESULT.suffix}", inversion, setup=setup, overwrite=True),
        save_figure(folder / f"{name}{PNG.suffix}", report, overwrite=True),
        save_figure(folder / f"{name}_comparison{PNG.suffix}", comparison, overwrite=True),
    ]


def demo_table(
    inversion: Inversion, setup: ProtonSetup, fields: Fields, written: list[Path]
) -> Table:
    """Build the table of a demo: the quality of the inversion and its true error."""
    rows = [
        headline_row(inversion.headline_in(setup)),
        ("setup", setup_text(setup, shape=inversion.image.shape)),
        *fact_rows(inversion.facts_in(setup)),
        ("error", _errors_text(fields, "Retrieved")),
        ("error of Poisson", _errors_text(fields, "Poisson")),
        *written_rows(written),
    ]
    return two_columns("Demo", rows)


def _errors_text(fields: Fields, name: str) -> str:
    import numpy as np

    truth, estimate = fields["True"], fields[name]
    true_peak, peak = (float(np.hypot(*field).max()) for field in (truth, estimate))
    if not true_peak:
        return f"peak {peak:.3g} px where the truth is zero"
    distance = float(np.linalg.norm(estimate - truth) / np.linalg.norm(truth))
    return f"peak {peak / true_peak - 1:+.1%}, L2 {distance:.1%}"
