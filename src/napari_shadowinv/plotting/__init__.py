"""Figures of an inversion or a fit for a logbook or a talk.

The figures use matplotlib's objects and no pyplot, so they neither need a window nor
disturb the figures of a notebook.
"""

from napari_shadowinv.plotting._figures import comparison_figure, report_figure, save_figure
from napari_shadowinv.plotting._fit_figure import fit_figure
from napari_shadowinv.plotting._movie import in_few_colours, stack_frames, write_film

__all__ = [
    "comparison_figure",
    "fit_figure",
    "in_few_colours",
    "report_figure",
    "save_figure",
    "stack_frames",
    "write_film",
]
