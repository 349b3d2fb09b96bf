"""Figures of results for a logbook or a talk.

- the figure of any result: `result_figure`; of each kind: `report_figure`, `fit_figure`,
  `pack_figure`
- products with their bands: `products_figure`; curves of one: `draw_curves`; axes of spectra:
  `make_logarithmic`
- planned experiments: `plan_figure`; their errors: `draw_errors`
- fields side by side: `comparison_figure`; a figure's file: `save_figure`
- a style of their own, whatever a user's matplotlibrc says: `own_style`
- a stack as a movie: `write_film`

All figures have an Agg canvas, axes in metres and fields in SI units if there is a setup, pixels
without, and take the name of a shot, of images or of a pack as their title.

The figures use matplotlib's objects and no pyplot, so they neither need a window nor
disturb the figures of a notebook.
"""

from napari_shadowinv.plotting._film_figure import pack_figure
from napari_shadowinv.plotting._fit_figure import fit_figure
from napari_shadowinv.plotting._movie import stack_frames, write_film
from napari_shadowinv.plotting._panels import own_style
from napari_shadowinv.plotting._plan_figure import draw_errors, plan_figure
from napari_shadowinv.plotting._product_figure import (
    draw_curves,
    make_logarithmic,
    products_figure,
)
from napari_shadowinv.plotting.figures import (
    comparison_figure,
    report_figure,
    result_figure,
    save_figure,
)

__all__ = [
    "comparison_figure",
    "draw_curves",
    "draw_errors",
    "fit_figure",
    "make_logarithmic",
    "own_style",
    "pack_figure",
    "plan_figure",
    "products_figure",
    "report_figure",
    "result_figure",
    "save_figure",
    "stack_frames",
    "write_film",
]
