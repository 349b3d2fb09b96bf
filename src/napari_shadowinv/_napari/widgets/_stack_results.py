"""Results of a run over many shots, while it goes on and afterwards.

- a run and the layers over its store: `StackRequest`
- where they lie: `place_on`
- what failed: `FailureTable`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QHeaderView

from napari_shadowinv._napari.layer_metadata import KEY, role_of
from napari_shadowinv._napari.widgets._origins import Origins
from napari_shadowinv._napari.widgets._panels import ReportTable
from napari_shadowinv._napari.widgets._picking import kind_of
from napari_shadowinv._napari.widgets._results import result_frame
from napari_shadowinv._napari.widgets._stacking import StackJob
from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv.errors import InputError

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
    origins : Origins
        What the shots are inverted with.
    described : list of (data, keywords, layer type)
        Layers over the store, once it has a finished shot.
    """

    job: StackJob
    image: Any
    companions: tuple[Any, ...]
    place: dict[str, Any]
    origins: Origins
    described: list[FullLayerData] = field(default_factory=list)
    # Written by the run's thread, so that the window only reads them.
    _limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    _earlier: dict[str, tuple[float, float]] = field(default_factory=dict)
    _given: set[tuple[float, float]] = field(default_factory=set)

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> Any:
        """Invert the shots, and describe the layers once one is done, beside the window."""
        return self.job.run(on_progress, should_stop, self._look)

    def follow(self, layers: Sequence[Any]) -> None:
        """Let the colours of layers reach to the strongest shot so far.

        Where the user has chosen other contrast limits, they stay.
        """
        for layer in filter(_is_image, layers):
            role = str(role_of(layer))
            if role not in self._limits:
                continue
            wanted = self._wanted(role)
            if wanted == tuple(layer.contrast_limits):
                continue
            if tuple(layer.contrast_limits) in self._given:
                self._given.add(wanted)
                layer.contrast_limits = wanted

    def go_on_from(self, earlier: StackRequest, layers: Sequence[Any]) -> None:
        """Take over the colours of an earlier run into the same store."""
        self._given.update(earlier._given)
        now = {role_of(one): tuple(one.contrast_limits) for one in layers if _is_image(one)}
        for _, keywords, kind in self.described:
            role = str(role_of(keywords))
            if kind == "image" and role in earlier._limits:
                self._earlier[role] = earlier._wanted(role)
                limits = self._wanted(role)
                self._given.add(limits)
                keywords["contrast_limits"] = now.get(role, limits)

    def _wanted(self, role: str) -> tuple[float, float]:
        """Limits that hold all shots of this run, and of earlier ones into the same store."""
        limits = self._limits[role]
        earlier = self._earlier.get(role)
        return limits if earlier is None else _widened(limits, np.array(earlier))

    def _look(self, index: int | None) -> None:
        """Describe the layers once a shot is done, and look how strong each one is."""
        if not self.described:
            self._describe()
        if index is None:
            return
        for data, keywords, kind in self.described:
            if kind == "image":
                role = str(role_of(keywords))
                self._limits[role] = _widened(self._limits[role], np.asarray(data[index]))

    def _describe(self) -> None:
        from napari_shadowinv._napari.stores import store_layers

        try:
            layers = store_layers(self.job.out)
        except (InputError, OSError):
            return  # the next shot may do, and the run goes on without
        # What napari remembers of a pending shot would hide that it is done.
        more = {"cache": False, **self.place}
        for _, keywords, kind in layers:
            keywords["metadata"][KEY]["made_from"] = self.origins.attributes()
            if kind == "image":
                limits = keywords["contrast_limits"]
                self._limits[str(role_of(keywords))] = limits
                self._given.add(limits)
        self.described.extend((data, keywords | more, kind) for data, keywords, kind in layers)


def _is_image(layer: Any) -> bool:
    return kind_of(layer) == "image"


def _widened(limits: tuple[float, float], plane: NDArray[Any]) -> tuple[float, float]:
    """Limits that hold a plane, too; around zero if they were."""
    finite = plane[np.isfinite(plane)]
    low = min(limits[0], float(finite.min(initial=np.inf)))
    high = max(limits[1], float(finite.max(initial=-np.inf)))
    if limits[0] == -limits[1]:
        return -max(-low, high), max(-low, high)
    return low, high


def place_on(layer: Any, setup: Any) -> dict[str, Any]:
    """Keywords that lay results on their stack, once that is placed by the setup.

    Parameters
    ----------
    layer : napari.layers.Image
        The stack.
    setup : Setup or None
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
