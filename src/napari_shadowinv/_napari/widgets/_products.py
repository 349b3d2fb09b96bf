"""The form that measures products of a result or of all shots of a store: `ProductForm`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from napari.utils.notifications import show_info
from qtpy import QtWidgets

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.layers import add_layers
from napari_shadowinv._napari.placement import mapped, matrix_between
from napari_shadowinv._napari.preferences import colour_map
from napari_shadowinv._napari.run import Outcome, Run
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._layers import LayerPicker, new_shapes
from napari_shadowinv._napari.widgets._panels import ReportView
from napari_shadowinv._system.arrays import PLANE
from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.analysis import (
    FIELD_UNITS,
    PRODUCTS,
    Product,
    ProductResult,
    add_products,
    analyse,
    analyse_shots,
    product_from_dict,
    products_table,
)
from napari_shadowinv.analysis.axisymmetric import AxisymmetricProfile
from napari_shadowinv.analysis.outlines import Outlined
from napari_shadowinv.analysis.product import BANDS
from napari_shadowinv.analysis.series import shot_times
from napari_shadowinv.errors import InputError
from napari_shadowinv.io import write
from napari_shadowinv.io.formats import FIGURE_SUFFIXES, PNG, RESULT, SITES
from napari_shadowinv.io.store_shots import open_shots
from napari_shadowinv.physics.beam import number_in_unit
from napari_shadowinv.physics.units import prefix_for
from napari_shadowinv.plotting import make_logarithmic, products_figure, save_figure

_ELLIPSE_CORNERS = 90
_ROUND = 0.02  # largest difference of the axes of a circle
_OPACITIES = (0.35, 0.18)  # of the bands
_BY_SETUP = "unit of the setup"
_TIMES, _SHOTS = "Times", "Shots"  # labels of the rows of a store
OPEN_SHAPES = ("line", "path")
_PANEL_HEIGHT_PX = 180
_MAX_COLUMN = 3  # entries of a legend inside the axes; longer ones are above


@dataclass(frozen=True, eq=False)
class _Request:
    """A product to be measured, of a result or of the shots of a store, and a layer of it."""

    origin: about.Result[Any] | Path
    layer: Any
    work: Callable[[OnProgress, ShouldStop], list[ProductResult]]


class ProductPlot(qt.Plot):
    """The curves of a product with their bands of 68 and 95 %, or its series over shots."""

    def __init__(self) -> None:
        super().__init__(height=_PANEL_HEIGHT_PX)

    def show_curves(self, result: ProductResult) -> bool:
        """Draw all curves but the image's intensity; return whether there is any."""
        groups = result.curve_groups
        if not groups:
            return False
        self.setMinimumHeight(_PANEL_HEIGHT_PX * len(groups))
        axes = self.fresh_axes(len(groups))
        for axis, names in zip(axes, groups, strict=True):
            self._draw_group(axis, result, names)
        _, words = result.shown_places(groups[0][0])
        axes[-1].set_xlabel(f"{words[:1].lower()}{words[1:]}", color=self.ink)
        if "shot" in result.coordinates:
            axes[-1].xaxis.get_major_locator().set_params(integer=True)
        if result.is_logarithmic:
            make_logarithmic(axes[-1])
        self.draw()
        return True

    def _draw_group(self, axis: Any, result: ProductResult, names: Sequence[str]) -> None:
        places, _ = result.shown_places(names[0])
        scale, unit = result.shown_scale(names)
        marker = "." if result.is_series else ""
        for number, name in enumerate(names):
            colour = qt.COLOURS[number % len(qt.COLOURS)]
            axis.plot(places, scale * result[name].value, color=colour, marker=marker, label=name)
            for share, opacity in zip(BANDS, _OPACITIES, strict=True):
                if (band := result.band(name, share)) is not None:
                    low, high = (scale * end for end in band)
                    axis.fill_between(places, low, high, color=colour, alpha=opacity, linewidth=0)
        axis.set_ylabel("" if unit == "1" else unit, color=self.ink)
        if len(names) > _MAX_COLUMN:
            above = {"loc": "lower left", "bbox_to_anchor": (0, 1), "borderaxespad": 0.2}
            compact = {"ncols": len(names), "handlelength": 1.0, "columnspacing": 0.8}
            self.add_legend(axis, size=7, frameon=False, **above, **compact)
        else:
            self.add_legend(axis)


class ProductForm(QtWidgets.QWidget):
    """Choose a result, a product and a shape, and measure it with its bands.

    Of a store, the product is followed through its shots.
    """

    def __init__(self, viewer: Any) -> None:
        super().__init__()
        self.viewer = viewer
        self.results: list[ProductResult] = []
        self._origin: about.Result[Any] | Path | None = None
        tip = "<qt>Layer of the result of an inversion or a fit, or of a store of shots.</qt>"
        self.result = LayerPicker(
            viewer, tip, suits=lambda layer: bool(about.result_of(layer) or _store_of(layer))
        )
        self.product = forms.SteadyComboBox(
            {name: f"{kind.title[:1].upper()}{kind.title[1:]}" for name, kind in PRODUCTS.items()}
        )
        tip = "<qt>Shapes layer with the line or outline. Of several, the selected is used.</qt>"
        self.shapes = LayerPicker(viewer, tip, "none yet", kinds=("shapes",))
        self.unit = forms.SteadyComboBox(tip="Unit of the field, which chooses the field, too.")
        tip = "<qt>Width of the strip across a profile's line, in px.</qt>"
        self.width_edit = QtWidgets.QDoubleSpinBox(maximum=1e4, toolTip=tip)
        component = AxisymmetricProfile.model_fields["component"]
        titles = {name: name for name in get_args(component.annotation)}
        self.component = forms.SteadyComboBox(titles, str(component.description))
        self._component_row = forms.labelled(str(component.title), self.component)
        tip = "<qt>Number of samples of the field for the bands.</qt>"
        self.samples = QtWidgets.QSpinBox(minimum=20, maximum=2000, value=100, toolTip=tip)
        self.times = forms.SavedLine(
            "shots are numbered",
            "Time between two shots of the store, such as 1 ns, or the times of all shots "
            "used, such as 0, 1 ns, 3 ns; a number without a unit is in s. Empty: shots are "
            "numbered, and rates are per shot.",
        )
        self.shots = forms.SavedLine(
            "all finished ones",
            "Shots of the store, such as 3:20 or 0,2,5. Empty: all finished ones.",
        )
        self._store_rows = (forms.labelled(_SHOTS, self.shots), forms.labelled(_TIMES, self.times))
        self.panel = Run("analysis", "Measure", "Measure the product with its bands.")
        self.panel.button.clicked.connect(lambda: self._run_or_cancel())
        self.panel.ended.connect(self._on_end)
        self.plot, self.report = ProductPlot(), ReportView()
        self.export = qt.push_button("Export CSV…", "Save all measured products.", self._export)
        self.save = qt.push_button(
            "Save with result…", "Save the result with all measured products.", self._save
        )
        self.picture = qt.push_button(
            "Save figure…", "Save a figure of all measured products.", self._save_figure
        )
        self.clear = qt.push_button("Clear", "Forget all measured products.", self._clear)
        shapes = qt.with_button(self.shapes, "✎", "Draw a new shape for the product.", self._draw)
        numbers = qt.side_by_side((self.width_edit, 1), (self.samples, 1))
        _, layout = qt.scrolling_column(
            self,
            forms.labelled("Result", self.result),
            *self._store_rows,
            forms.labelled("Product", self.product),
            forms.labelled("Shape", shapes),
            forms.labelled("Unit", self.unit),
            self._component_row,
            forms.labelled("Width, samples", numbers),
            self.panel,
            self.plot,
            self.report,
            qt.side_by_side((self.export, 1), (self.picture, 1)),
            qt.side_by_side((self.save, 1), (self.clear, 0)),
        )
        layout.addStretch(1)
        self.result.picked.connect(self._on_result)
        self.product.currentIndexChanged.connect(lambda _: self._enable())
        self._on_result()
        self._enable()
        self._clear()

    @property
    def kind(self) -> type[Product]:
        return PRODUCTS[self.product.currentData()]

    def _enable(self) -> None:
        is_drawn = "path" in self.kind.model_fields
        self.shapes.parent().setEnabled(is_drawn)
        self.width_edit.setEnabled("width" in self.kind.model_fields)
        self._component_row.setVisible("component" in self.kind.model_fields)

    def _on_result(self) -> None:
        """Show the rows of a store or of a single result, and offer the units of its fields."""
        layer = self.result.layer
        is_store = layer is not None and _store_of(layer) is not None
        for row in self._store_rows:
            row.setVisible(is_store)
        self.samples.setEnabled(not is_store)
        tip = "Save the result with all measured products."
        if is_store:
            tip = "Only for a single result; of a store, export a table or save a figure."
        self.save.setToolTip(f"<qt>{tip}</qt>")
        result = None if layer is None else about.result_of(layer)
        setup = about.setup_of(layer) if is_store else None if result is None else result.setup
        fields = {"displacement"} if setup is None else {each.name for each in setup.si_fields}
        symbols = [s for s, unit in FIELD_UNITS.items() if unit.field in fields | {"displacement"}]
        before = self.unit.currentText()
        self.unit.clear()
        self.unit.addItems([_BY_SETUP, *symbols])
        self.unit.setCurrentText(before if before in symbols else _BY_SETUP)

    def request(self) -> _Request:
        """Return what is to be measured, or raise an `InputError`."""
        layer = self.result.layer
        if layer is None:
            raise InputError(
                "there is no result to measure: run 'Invert shot', 'Fit several images' or "
                "'Invert stack', or open a .shadowinv file or a store of shots"
            )
        values: dict[str, Any] = {"product": self.kind.name()}
        if "width" in self.kind.model_fields:
            values["width"] = self.width_edit.value()
        if "component" in self.kind.model_fields:
            values["component"] = self.component.currentData()
        if "path" in self.kind.model_fields:
            values |= self._outline(layer)
        symbol = self.unit.currentText()
        product, unit = product_from_dict(values), None if symbol == _BY_SETUP else symbol
        origin: Any = _store_of(layer) or about.result_of(layer)
        shots, times = self.shots.text().strip() or None, self.times.text().strip()
        samples = self.samples.value()

        def work(on_progress: OnProgress, should_stop: ShouldStop) -> list[ProductResult]:
            common: Any = {"unit": unit, "on_progress": on_progress, "should_stop": should_stop}
            if isinstance(origin, Path):
                stack = open_shots(origin, shots)
                seconds = _seconds(times, stack["index"].values.tolist())
                return analyse_shots(stack, product, seconds, **common)
            return analyse(origin.content, product, samples=samples, setup=origin.setup, **common)

        return _Request(origin, layer, work)

    def _outline(self, layer: Any) -> dict[str, Any]:
        """Return the fields of a product that the selected shape stands for, in px."""
        shapes = self.shapes.layer
        if shapes is None or not len(shapes.data):
            raise InputError(
                f"there is no shape for the {self.kind.title}: press ✎ and draw one on the image"
            )
        is_closed = issubclass(self.kind, Outlined)
        index = selected_shape(
            shapes,
            lambda kind: is_closed != (kind in OPEN_SHAPES) or (is_closed and kind == "path"),
        )
        if index is None:
            expected = "a closed shape, such as an ellipse" if is_closed else "a line or a path"
            raise InputError(
                f"'{shapes.name}' has no shape for the {self.kind.title}, expected {expected}: "
                "press ✎ and draw one"
            )
        corners = mapped(matrix_between(shapes, layer), shapes.data[index])
        return shape_fields(shapes.shape_type[index], corners)

    def choose(self, layer: Any) -> None:
        """Select the result that a layer belongs to, or raise an `InputError`."""
        result = None if layer is None else about.result_of(layer) or _store_of(layer)
        of_result = [
            each
            for each in self.result.offered
            if result is not None and result in (about.result_of(each), _store_of(each))
        ]
        if not of_result:
            raise InputError(
                "no result is selected: select a layer of an inversion, a fit or a store of shots"
            )
        self.result.layer = layer if layer in of_result else of_result[-1]

    @qt.notify_errors
    def _run_or_cancel(self) -> None:
        if self.panel.running:
            self.panel.cancel()
            return
        request = self.request()
        self.panel.start(request.work, request)

    def _on_end(self, outcome: Outcome) -> None:
        if outcome.value is None:
            return
        request: _Request = outcome.tag
        if self._origin != request.origin:
            self.results = []
        self._origin = request.origin
        for measured in outcome.value:
            taken = {each.name for each in self.results}
            numbers = (f"{measured.name}_{number}" for number in range(2, 10_000))
            name = next(n for n in (measured.name, *numbers) if n not in taken)
            self.results.append(replace(measured, name=name))
            self._show(self.results[-1], request)

    def _show(self, measured: ProductResult, request: _Request) -> None:
        rows = [(fact.title, fact.text) for fact in measured.facts]
        rows += [("Note", sentence) for sentence in measured.limits]
        self.report.show_rows(rows)
        self.plot.setVisible(self.plot.show_curves(measured))
        for widget in (self.export, self.picture, self.clear):
            widget.setEnabled(True)
        self.save.setEnabled(isinstance(request.origin, about.Result))
        for name, variable in measured.variables.items():
            if variable.dims == PLANE:
                add_layers(self.viewer, [map_layer(measured, name, request.layer)])

    def _clear(self) -> None:
        self.results, self._origin = [], None
        self.report.setVisible(False)
        self.plot.setVisible(False)
        for widget in (self.export, self.picture, self.save, self.clear):
            widget.setEnabled(False)

    def show_problem(self, text: str) -> None:
        """Show a problem until the next measurement."""
        self.panel.say(text, problem=True)

    @qt.notify_errors
    def _draw(self) -> None:
        layer = self.result.layer
        if layer is None:
            raise InputError("there is no result to draw on: run 'Invert shot' first")
        mode = "add_ellipse" if issubclass(self.kind, Outlined) else "add_line"
        self.shapes.layer = new_shapes(self.viewer, layer, self.kind.name(), mode)

    @qt.notify_errors
    def _export(self) -> None:
        export_csv(self, "products.csv", products_table(self.results))

    @qt.notify_errors
    def _save_figure(self) -> None:
        filters = ";;".join(f"{suffix[1:].upper()} (*{suffix})" for suffix in FIGURE_SUFFIXES)
        name, selected = QtWidgets.QFileDialog.getSaveFileName(
            self, "Save figure", f"products{PNG.suffix}", filters
        )
        if not name:
            return
        path = Path(name)
        if path.suffix.lower() not in FIGURE_SUFFIXES:
            suffixes = [suffix for suffix in FIGURE_SUFFIXES if f"*{suffix}" in selected]
            path = path.with_name(path.name + (suffixes or [PNG.suffix])[0])
        figure = products_figure(self.results)
        show_info(f"Wrote {save_figure(path, figure, overwrite=path == Path(name))}")

    @qt.notify_errors
    def _save(self) -> None:
        result: Any = self._origin
        name, _ = QtWidgets.QFileDialog.getSaveFileName(
            self, "Save with result", f"products{RESULT.suffix}", f"Result (*{RESULT.suffix})"
        )
        if not name:
            return
        content = result.content
        if result.setup is not None and content.setup is None:
            content = content.in_units(result.setup)
        dataset = content.to_dataset()
        show_info(f"Wrote {write(name, add_products(dataset, self.results), overwrite=True)}")


def _store_of(layer: Any) -> Path | None:
    store = about.metadata_of(layer).get("store")
    return None if store is None else Path(store)


def _seconds(times: str, shots: list[int]) -> list[float] | None:
    """Return the time of each shot in s; None if shots are numbered."""
    if not times:
        return None
    received = f"{_TIMES} is '{times}'"
    try:
        numbers = [number_in_unit(part, "s") for part in times.split(",")]
    except ValueError:
        raise InputError(
            f"{received}, expected times separated by commas, such as 1 ns or 0, 1 ns, 3 ns"
        ) from None
    return shot_times(numbers, shots, received)


def export_csv(parent: QtWidgets.QWidget, name: str, text: str) -> None:
    """Ask for a file, offering a name, and write a table."""
    path, _ = QtWidgets.QFileDialog.getSaveFileName(parent, "Export CSV", name, "CSV (*.csv)")
    if path:
        show_info(f"Wrote {forms.save_text(text, path, SITES.suffix)}")


def selected_shape(shapes: Any, suits: Callable[[str], bool]) -> int | None:
    """Return the index of the selected shape of a suitable type, or else of the last one."""
    suitable = [index for index, kind in enumerate(shapes.shape_type) if suits(kind)]
    selected = [index for index in suitable if index in shapes.selected_data]
    return next(reversed(selected or suitable), None)


def shape_fields(shape_type: str, corners: FloatArray) -> dict[str, Any]:
    """Return the fields of a product for a shape of napari with corners (n, 2) in px.

    An ellipse has the corners of the rectangle around it. One that is round becomes a circle.
    """
    if shape_type != "ellipse":
        return {"path": [tuple(map(float, corner)) for corner in corners]}
    center = corners.mean(axis=0)
    axes = (corners[1] - corners[0]) / 2, (corners[3] - corners[0]) / 2
    radii = np.hypot(*np.transpose(axes))
    if abs(radii[0] - radii[1]) <= _ROUND * max(radii):
        return {"center": tuple(map(float, center)), "radius": float(radii.mean())}
    angles = np.linspace(0, 2 * np.pi, _ELLIPSE_CORNERS, endpoint=False)[:, None]
    points = center + np.cos(angles) * axes[0] + np.sin(angles) * axes[1]
    return {"path": [tuple(map(float, point)) for point in points]}


def map_layer(measured: ProductResult, name: str, layer: Any) -> Any:
    """Describe the layer of a map, on top of a layer of its result."""
    values = measured[name].value
    largest = float(np.nanpercentile(np.abs(values), 99.8)) or 1.0
    factor, prefix = prefix_for(largest)
    unit = f"{prefix}{measured.variables[name].unit}"
    keywords = {
        "name": about.layer_name(f"{measured.title} ({unit})", layer.name.partition(" – ")[2]),
        "colormap": colour_map("signed"),
        "contrast_limits": (-factor * largest, factor * largest),
        "metadata": about.metadata_for("product", unit),
        **about.frame_of(layer).keywords(),
    }
    return factor * values, keywords, "image"
