"""The form that measures products of a result, drawn as shapes: `ProductForm`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from napari.utils.notifications import show_info
from qtpy import QtWidgets

from napari_shadowinv._napari.layer_metadata import (
    frame_of,
    layer_name,
    metadata_for,
    metadata_of,
    result_of,
    setup_of,
)
from napari_shadowinv._napari.layers import add_layers
from napari_shadowinv._napari.widgets import _forms as forms
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._editors import SteadyComboBox
from napari_shadowinv._napari.widgets._layers import LayerPicker, new_shapes
from napari_shadowinv._napari.widgets._panels import Outcome, ReportTable, RunPanel
from napari_shadowinv._napari.widgets._qt import COLOURS, Plot
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
    shot_times,
)
from napari_shadowinv.analysis.outlines import Outlined
from napari_shadowinv.analysis.product import BANDS
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.store import DONE, read_stack
from napari_shadowinv.physics.units import display_unit, prefix_for
from napari_shadowinv.plotting import make_logarithmic

if TYPE_CHECKING:
    import napari
    from napari_shadowinv._napari.layer_metadata import Result

_SAMPLES = 100
_MIN_SAMPLES, _MAX_SAMPLES = 20, 2000
_ELLIPSE_CORNERS = 90
_ROUND = 0.02  # largest difference of the axes of a circle
_OPACITIES = (0.35, 0.18)  # of the bands
_BY_SETUP = "unit of the setup"
_FEW_PLACES = 50  # such as shots, which are marked
_OPEN_SHAPES = ("line", "path")


@dataclass(frozen=True, eq=False)
class _Request:
    """A product of a result to be measured, and the layer of the result."""

    result: Result[Any]
    layer: Any
    product: Product
    unit: str | None
    samples: int

    @property
    def subject(self) -> Any:
        """The result that is measured."""
        return self.result

    def work(self, on_progress: OnProgress, should_stop: ShouldStop) -> list[ProductResult]:
        return analyse(
            self.result.content,
            self.product,
            samples=self.samples,
            unit=self.unit,
            setup=self.result.setup,
            on_progress=on_progress,
            should_stop=should_stop,
        )


@dataclass(frozen=True, eq=False)
class _SeriesRequest:
    """A product to be measured in all finished shots of a store, and the layer of the store."""

    subject: str  # path of the store
    layer: Any
    product: Product
    unit: str | None
    times: str

    def work(self, on_progress: OnProgress, should_stop: ShouldStop) -> list[ProductResult]:
        stack = read_stack(Path(self.subject))
        finished = np.flatnonzero(stack["status"].values == DONE)
        series = analyse_shots(
            stack.isel(shot=finished),
            self.product,
            shot_times(self.times, finished, "Times"),
            unit=self.unit,
            on_progress=on_progress,
            should_stop=should_stop,
        )
        return [each.result for each in series]


class ProductPlot(Plot):
    """The curves of a product with their bands of 68 and 95 %."""

    def __init__(self) -> None:
        super().__init__(height=180)

    def show_curves(self, result: ProductResult) -> bool:
        """Draw all curves but the image's intensity; return whether there is any."""
        names = list(result.curve_names)
        if not names:
            return False
        (axes,) = self.fresh_axes()
        coordinate = result.coordinates[result.variables[names[0]].dims[0]]
        factor, prefix, unit = 1.0, "", display_unit(coordinate.unit)
        if unit in ("m", "s"):
            factor, prefix = prefix_for(float(np.abs(coordinate.values).max()))
        for number, name in enumerate(names):
            scale, field_unit = result.scale_of(name)
            colour, places = COLOURS[number % len(COLOURS)], factor * coordinate.values
            style = "o-" if len(places) <= _FEW_PLACES else "-"
            axes.plot(places, scale * result[name].value, style, ms=3, color=colour, label=name)
            for share, opacity in zip(BANDS, _OPACITIES, strict=True):
                if (band := result.band(name, share)) is not None:
                    low, high = (scale * end for end in band)
                    axes.fill_between(places, low, high, color=colour, alpha=opacity, linewidth=0)
        axes.set_xlabel(f"{coordinate.long_name.lower()} ({prefix}{unit})", color=self.ink)
        axes.set_ylabel(field_unit, color=self.ink)
        if result.is_logarithmic:
            make_logarithmic(axes)
        self.add_legend(axes)
        self.draw()
        return True


class ProductForm(QtWidgets.QWidget):
    """Choose a result, a product and a shape, and measure it with its bands."""

    def __init__(self, viewer: napari.viewer.Viewer) -> None:
        super().__init__()
        self.viewer = viewer
        self.results: list[ProductResult] = []
        self._measured: _Request | _SeriesRequest | None = None
        tip = "<qt>Layer of the result of an inversion or a fit, or of a store of shots.</qt>"
        self.result = LayerPicker(
            viewer,
            ("image",),
            tip,
            suits=lambda layer: bool(result_of(layer) or _store_of(layer)),
        )
        self.times = QtWidgets.QLineEdit()
        self.times.setPlaceholderText("shots are numbered")
        self.times.setToolTip(
            "<qt>Time between two shots of the store in s, or a list of the times of all finished "
            "shots, such as 0, 1e-9, 3e-9.</qt>"
        )
        self.product = SteadyComboBox()
        for name, kind in PRODUCTS.items():
            self.product.addItem(f"{kind.title[:1].upper()}{kind.title[1:]}", name)
        tip = "<qt>Shapes layer with the line or outline. Of several, the selected is used.</qt>"
        self.shapes = LayerPicker(viewer, ("shapes",), tip, "none yet")
        self.unit = SteadyComboBox()
        self.unit.setToolTip("<qt>Unit of the field, which chooses the field, too.</qt>")
        self.width_edit = QtWidgets.QDoubleSpinBox()
        self.width_edit.setRange(0.0, 1e4)
        self.width_edit.setToolTip("<qt>Width of the strip across a profile's line, in px.</qt>")
        self.samples = QtWidgets.QSpinBox()
        self.samples.setRange(_MIN_SAMPLES, _MAX_SAMPLES)
        self.samples.setValue(_SAMPLES)
        self.samples.setToolTip("<qt>Number of samples of the field for the bands.</qt>")
        self.panel = RunPanel("analysis", "Measure", "Measure the product with its bands.")
        self.panel.button.clicked.connect(lambda: self._run_or_cancel())
        self.panel.runner.ended.connect(self._on_end)
        self.plot, self.report = ProductPlot(), ReportTable()
        self.export = qt.push_button("Export CSV…", "Save all measured products.", self._export)
        self.save = qt.push_button(
            "Save with result…", "Save the result with all measured products.", self._save
        )
        self.clear = qt.push_button("Clear", "Forget all measured products.", self._clear)
        shapes = qt.with_button(self.shapes, "✎", "Draw a new shape for the product.", self._draw)
        numbers = qt.side_by_side((self.width_edit, 1), (self.samples, 1))
        self._times_row = forms.labelled("Times (s)", self.times)
        rows = (
            forms.labelled("Result", self.result),
            forms.labelled("Product", self.product),
            forms.labelled("Shape", shapes),
            forms.labelled("Unit", self.unit),
            forms.labelled("Width, samples", numbers),
            self._times_row,
            self.panel,
        )
        content = QtWidgets.QWidget()
        buttons = qt.side_by_side((self.export, 1), (self.save, 1), (self.clear, 0))
        qt.column(content, *rows, self.plot, self.report, buttons, margin=6).addStretch(1)
        area = QtWidgets.QScrollArea()
        area.setWidgetResizable(True)
        area.setFrameShape(QtWidgets.QFrame.Shape.NoFrame)
        area.setWidget(content)
        qt.column(self, area)
        self.result.picked.connect(self._offer_units)
        self.product.currentIndexChanged.connect(lambda _: self._enable())
        self._offer_units()
        self._enable()
        self._empty()

    @property
    def kind(self) -> type[Product]:
        """Chosen kind of product."""
        return PRODUCTS[self.product.currentData()]

    def _enable(self) -> None:
        is_drawn = "path" in self.kind.model_fields
        self.shapes.parent().setEnabled(is_drawn)
        self.width_edit.setEnabled("width" in self.kind.model_fields)

    def _offer_units(self) -> None:
        """Offer the units of the fields of the result's setup."""
        layer = self.result.layer
        self._times_row.setVisible(_store_of(layer) is not None)
        setup = None if layer is None else setup_of(layer)
        fields = {"displacement"} if setup is None else {each.name for each in setup.si_fields}
        symbols = [s for s, unit in FIELD_UNITS.items() if unit.field in fields | {"displacement"}]
        before = self.unit.currentText()
        self.unit.clear()
        self.unit.addItems([_BY_SETUP, *symbols])
        self.unit.setCurrentText(before if before in symbols else _BY_SETUP)

    def request(self) -> _Request | _SeriesRequest:
        """Return what is to be measured, or raise an `InputError`."""
        layer = self.result.layer
        result, store = None if layer is None else result_of(layer), _store_of(layer)
        if result is None and store is None:
            raise InputError(
                "there is no result to measure: run 'Invert shot' or 'Fit several images', or "
                "open a .shadowinv file or a store"
            )
        values: dict[str, Any] = {"product": self.kind.name()}
        if "width" in self.kind.model_fields:
            values["width"] = self.width_edit.value()
        if "path" in self.kind.model_fields:
            values |= self._outline(layer)
        symbol = self.unit.currentText()
        unit, product = None if symbol == _BY_SETUP else symbol, product_from_dict(values)
        if result is None:
            return _SeriesRequest(str(store), layer, product, unit, self.times.text().strip())
        return _Request(result, layer, product, unit, self.samples.value())

    def _outline(self, layer: Any) -> dict[str, Any]:
        """Return the fields of a product that the selected shape stands for, in px."""
        shapes = self.shapes.layer
        if shapes is None or not len(shapes.data):
            raise InputError(
                f"there is no shape for the {self.kind.title}: press ✎ and draw one on the image"
            )
        is_closed = issubclass(self.kind, Outlined)
        suitable = [
            index
            for index, kind in enumerate(shapes.shape_type)
            if is_closed != (kind in _OPEN_SHAPES) or (is_closed and kind == "path")
        ]
        if not suitable:
            expected = "a closed shape, such as an ellipse" if is_closed else "a line or a path"
            raise InputError(
                f"'{shapes.name}' has no shape for the {self.kind.title}, expected {expected}: "
                "press ✎ and draw one"
            )
        selected = [index for index in suitable if index in shapes.selected_data] or suitable
        index, to_pixels = selected[-1], pixel_mapper(layer)
        world = np.array([shapes.data_to_world(c)[-2:] for c in shapes.data[index]])
        return shape_fields(shapes.shape_type[index], to_pixels(world))

    @qt.notify_errors
    def _run_or_cancel(self) -> None:
        if self.panel.runner.running:
            self.panel.cancel()
            return
        request = self.request()
        self.panel.run(request.work, request)

    def _on_end(self, outcome: Outcome) -> None:
        if outcome.value is None:
            return
        request: _Request | _SeriesRequest = outcome.tag
        if self._measured is not None and self._measured.subject != request.subject:
            self.results = []
        self._measured = request
        for measured in outcome.value:
            taken = {each.name for each in self.results}
            numbers = (f"{measured.name}_{number}" for number in range(2, 10_000))
            name = next(n for n in (measured.name, *numbers) if n not in taken)
            self.results.append(replace(measured, name=name))
            self._show(self.results[-1], request)

    def _show(self, measured: ProductResult, request: _Request | _SeriesRequest) -> None:
        rows = [(fact.title, fact.text) for fact in measured.facts]
        rows += [("Note", sentence) for sentence in measured.limits]
        self.report.show_rows(rows)
        self.report.setVisible(True)
        self.plot.setVisible(self.plot.show_curves(measured))
        for widget in (self.export, self.save, self.clear):
            widget.setEnabled(True)
        # A store has many results, and none that a product could be saved with.
        self.save.setEnabled(isinstance(request, _Request))
        for name, variable in measured.variables.items():
            if variable.dims == PLANE:
                add_layers(self.viewer, [map_layer(measured, name, request.layer)])

    def _empty(self) -> None:
        self.report.setVisible(False)
        self.plot.setVisible(False)
        for widget in (self.export, self.save, self.clear):
            widget.setEnabled(False)

    def _clear(self) -> None:
        self.results, self._measured = [], None
        self._empty()

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
        from napari_shadowinv.io.formats import SITES

        name, _ = QtWidgets.QFileDialog.getSaveFileName(
            self, "Export CSV", "products.csv", "CSV (*.csv)"
        )
        if name:
            text = products_table(self.results)
            show_info(f"Wrote {forms.save_text(text, name, SITES.suffix)}")

    @qt.notify_errors
    def _save(self) -> None:
        from napari_shadowinv.io import write
        from napari_shadowinv.io.formats import RESULT

        assert isinstance(self._measured, _Request)
        name, _ = QtWidgets.QFileDialog.getSaveFileName(
            self, "Save with result", f"products{RESULT.suffix}", f"Result (*{RESULT.suffix})"
        )
        if not name:
            return
        result = self._measured.result
        content: Any = result.content
        has_setup = result.setup is not None and content.setup is None
        dataset = content.to_dataset(result.setup) if has_setup else content.to_dataset()
        show_info(f"Wrote {write(name, add_products(dataset, self.results), overwrite=True)}")


def _store_of(layer: Any) -> str | None:
    """Return the path of the store that a layer shows; None if it shows none."""
    return None if layer is None else metadata_of(layer).get("store")


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


def pixel_mapper(layer: Any) -> Callable[[Any], Any]:
    """Return the function from world points to a layer's pixels, which may be rotated."""
    leading = np.zeros(layer.ndim - 2)
    origin, next_row, next_column = (
        np.asarray(layer.data_to_world((*leading, *pixel))[-2:])
        for pixel in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
    )
    to_pixels = np.linalg.inv(np.stack([next_row - origin, next_column - origin], axis=1))
    return lambda points: (points - origin) @ to_pixels.T


def map_layer(measured: ProductResult, name: str, layer: Any) -> Any:
    """Describe the layer of a map, on top of a layer of its result."""
    values = measured[name].value
    largest = float(np.nanpercentile(np.abs(values), 99.8)) or 1.0
    factor, prefix = prefix_for(largest)
    unit = f"{prefix}{measured.variables[name].unit}"
    keywords = {
        "name": layer_name(f"{measured.title} ({unit})", layer.name.partition(" – ")[2]),
        "colormap": "RdBu_r",
        "contrast_limits": (-factor * largest, factor * largest),
        "metadata": metadata_for("product", unit),
        **frame_of(layer).keywords(),
    }
    return factor * values, keywords, "image"
