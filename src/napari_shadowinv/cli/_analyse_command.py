"""`shadowinv analyse`: products of a result with their bands."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

from napari_shadowinv.cli import _flags
from napari_shadowinv.cli._inputs import read_setup
from napari_shadowinv.cli._outputs import Outputs
from napari_shadowinv.cli._summary import fact_rows, two_columns
from napari_shadowinv.cli._terminal import notify_errors, say, work_callbacks
from napari_shadowinv.errors import InputError

if TYPE_CHECKING:
    from napari_shadowinv.analysis import Product, ProductResult

HELP = {
    "products": "Products in quotes: name, points y,x in px, name=value.",
    "unit": "T m, MG µm, kG cm, V, m⁻², rad, px … Default: SI.",
    "figure": "Figure of the products: .png, .pdf or .svg.",
}
EPILOG = """
shadowinv analyse a.shadowinv 'profile 99,20 99,180 width=5' --unit 'MG um'

shadowinv analyse night.shadowinv.zarr 'region center=99,99 radius=40' --times 1e-9

Without a product the command lists them.

Exit codes: 0 written; 2 invalid input; 130 cancelled.
"""


@dataclass(frozen=True)
class ProductFlags:
    """Flags of the products and of their bands."""

    unit: Annotated[str | None, Option(help=HELP["unit"])] = None
    deflector: Annotated[str | None, Option(help="Field of a fit: B, E, plasma or phase.")] = None
    samples: Annotated[int, Option(help="Samples of the field for the bands.", metavar="N")] = 100
    setup: _flags.SetupFile = None
    shots: _flags.ChosenShots = None
    times: Annotated[str | None, Option(help="Seconds between shots, or a list for each.")] = None


@notify_errors
@_flags.takes_flags
def analyse(
    result: Annotated[Path, _flags.argument(help="Result, or store of shots.")],
    flags: ProductFlags,
    outputs: Outputs,
    product: Annotated[list[str] | None, _flags.argument(help=HELP["products"])] = None,
    csv: Annotated[Path | None, Option(help="Table of all numbers with their bands.")] = None,
    figure: Annotated[Path | None, Option(help=HELP["figure"])] = None,
    out: Annotated[Path | None, Option(help="Copy of the result with the products.")] = None,
) -> None:
    """Measure profiles, regions, fluxes, currents and maps of a result, with error bands.

    Bands hold the noise of the image, the discretisation and what was stated of the instrument.
    """
    from napari_shadowinv.analysis import add_products, analyse_shots, products_table
    from napari_shadowinv.analysis import analyse as measure
    from napari_shadowinv.analysis.series import shot_times
    from napari_shadowinv.io import read_dataset, replacing, write
    from napari_shadowinv.io.formats import FIGURE_SUFFIXES, RESULT, TABLE
    from napari_shadowinv.io.store import is_stack
    from napari_shadowinv.io.store_shots import open_shots
    from napari_shadowinv.physics.beam import numbers_in_unit

    chosen = _products(product or [])
    outputs.check(
        [(csv, TABLE.suffixes), (figure, FIGURE_SUFFIXES), (out, RESULT.suffixes)],
        [result, flags.setup],
    )
    if is_stack(result):
        if out is not None:
            raise InputError(
                f"received --out {out}, which copies one result with its products, but a store has "
                "many results: use --csv"
            )
        dataset = open_shots(result, flags.shots)
    elif flags.shots is not None or flags.times is not None:
        raise InputError(f"{result} is one result: --shots and --times belong to a store of shots")
    else:
        dataset = read_dataset(result)
    with work_callbacks(outputs.quiet) as callbacks:
        common = {"unit": flags.unit, "deflector": flags.deflector, **callbacks}
        common["setup"] = read_setup(flags.setup)
        if "shot" in dataset.dims:
            seconds = None
            if flags.times is not None:
                numbers = numbers_in_unit(flags.times, "s", "--times")
                indices = dataset["index"].values
                seconds = shot_times(numbers, indices.tolist(), f"--times is {flags.times!r}")
            results = analyse_shots(dataset, chosen, seconds, **common)
        else:
            results = measure(dataset, chosen, samples=flags.samples, **common)
    with ExitStack() as stack:  # both files, or none
        if csv is not None:
            temporary = stack.enter_context(replacing(csv, outputs.overwrite))
            temporary.write_text(products_table(results), encoding="utf-8")
        if out is not None:
            write(out, add_products(dataset, results), overwrite=outputs.overwrite)
    if figure is not None:
        from napari_shadowinv.plotting import products_figure

        outputs.write_figures({figure: lambda: products_figure(results)})
    if not outputs.quiet:
        for table in _tables(results):
            say(table)
    if outputs.files:
        outputs.show("Files", [])


def _products(texts: list[str]) -> list[Product]:
    from napari_shadowinv.analysis import PRODUCTS, product_from_text
    from napari_shadowinv.analysis.kinds import product_syntax

    if not texts:
        syntax = "; ".join(map(product_syntax, PRODUCTS.values()))
        raise InputError(f"received no product, expected at least one: {syntax}")
    return [product_from_text(text) for text in texts]


def _tables(results: list[ProductResult]) -> list[Any]:
    """Return a table for each product, and what the image cannot show below the last."""
    tables = [two_columns(f"{each.title} ({each.name})", fact_rows(each.facts)) for each in results]
    limits = dict.fromkeys(sentence for each in results for sentence in each.limits)
    return [*tables, two_columns("All products", [("note", sentence) for sentence in limits])]
