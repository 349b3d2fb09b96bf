"""Results of a run over many shots, while it goes on and afterwards.

- a run and the layers over its store: `StackRequest`
- where they lie: `place_on`
- what failed: `FailureTable`
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from qtpy.QtCore import Qt
from qtpy.QtWidgets import QHeaderView

from napari_shadowinv._napari.widgets._panels import ReportTable
from napari_shadowinv._napari.widgets._results import result_frame
from napari_shadowinv._napari.widgets._stacking import StackJob
from napari_shadowinv.errors import InputError
from napari_shadowinv.progress import OnProgress, ShouldStop

if TYPE_CHECKING:
    from napari_shadowinv._napari.layers import FullLayerData

__all__ = ["FailureTable", "StackRequest", "place_on"]

_MOST_FAILURES = 100
_NAME_WIDTH = 110


@dataclass(frozen=True, eq=False)
class StackRequest:
    """A run, and all that it takes to show its results.

    Attributes
    ----------
    job : StackJob
        The run.
    image : napari.layers.Image or None
        The stack, if it is a layer.
    companions : tuple of napari.layers.Layer
        What lies on it.
    place : dict
        Keywords that place the results.
    described : list of (data, keywords, layer type)
        Layers over the store, once it has a finished shot.
    """

    job: StackJob
    image: Any
    companions: tuple[Any, ...]
    place: dict[str, Any]
    described: list[FullLayerData] = field(default_factory=list)

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> Any:
        """Invert the shots, and describe the layers once one is done, beside the window."""
        return self.job.run(on_progress, should_stop, self._describe)

    def _describe(self) -> None:
        if self.described:
            return
        from napari_shadowinv._napari.stores import store_layers

        try:
            layers = store_layers(self.job.out)
        except (InputError, OSError):
            return  # the next shot may do, and the run goes on without
        # What napari remembers of a pending shot would hide that it is done.
        more = {"cache": False, **self.place}
        self.described.extend((data, keywords | more, kind) for data, keywords, kind in layers)


def place_on(layer: Any, setup: Any) -> dict[str, Any]:
    """Keywords that lay results on their stack, once that is placed by the setup.

    Parameters
    ----------
    layer : napari.layers.Image
        The stack.
    setup : ProtonSetup or OpticalSetup or None
        The experiment.

    Returns
    -------
    dict
        ``scale``, ``translate``, ``units``, ``axis_labels``.
    """
    keywords = result_frame(layer, setup, None).keywords(stacked=True)
    first = {"scale": layer.scale, "translate": layer.translate, "units": layer.units}
    for name, values in first.items():
        keywords[name] = (values[0], *keywords[name][1:])
    return keywords


class FailureTable(ReportTable):
    """Names of shots that failed, and why."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0
        # Names of files have no spaces to wrap at: their ends tell them apart.
        self.setTextElideMode(Qt.TextElideMode.ElideMiddle)
        self.horizontalHeader().setSectionResizeMode(0, QHeaderView.ResizeMode.Fixed)
        self.horizontalHeader().resizeSection(0, _NAME_WIDTH)

    def show_failures(self, failures: list[tuple[str, str]]) -> None:
        """Replace what is shown, by no more than can be looked through."""
        self.count = len(failures)
        more = self.count - _MOST_FAILURES
        rows = failures[:_MOST_FAILURES] + ([("…", f"and {more} more")] if more > 0 else [])
        self.show_rows(rows)
        self.setVisible(bool(rows))
