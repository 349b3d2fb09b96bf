"""The widget that measures layers along a line, and products of a result: `Analyse`.

- the form of the products: `ProductForm`
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from magicgui.widgets import SpinBox
from napari.utils.notifications import show_info
from pydantic import create_model
from qtpy import QtWidgets

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.jobs import Finished, Job, name_of_result
from napari_shadowinv._napari.layer_metadata import (
    kind_of,
    mapped,
    matrix_between,
    pixel_mapper,
    unit_of,
)
from napari_shadowinv._napari.layers import LayerData, add_layers
from napari_shadowinv._napari.run import Run
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._layers import LayerPicker, new_shapes, shown_plane
from napari_shadowinv._napari.widgets._panels import ReportView, ToolPanel
from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.analysis import (
    FIELD_UNITS,
    PRODUCTS,
    Product,
    ProductResult,
    analyse,
    product_from_dict,
    products_table,
)
from napari_shadowinv.analysis.paths import (
    Profile,
    interpolate,
    measure_peak,
    sample_path,
    sample_strip,
)
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.arrays import PLANE
from napari_shadowinv.physics.units import prefix_for
from napari_shadowinv.plotting import draw_curves

_REDRAW_MS = 40  # while the line moves
_MAX_WIDTH_PX = 10_000


def draw_profiles(
    columns: Sequence[Any], distance: FloatArray, label: str, profiles: Sequence[Profile]
) -> None:
    """Draw profiles in panels for their units, with a common distance axis."""
    units = list(dict.fromkeys(profile.unit for profile in profiles))
    for axes, of_unit in zip(columns, units, strict=False):
        axes.set_ylabel(of_unit or "value")
        for number, profile in enumerate(profiles):
            if profile.unit == of_unit:
                colour = qt.COLOURS[number % len(qt.COLOURS)]
                axes.plot(distance, profile.values, color=colour, label=profile.name)
    columns[-1].set_xlabel(label)


class Analyse(qt.Docked):
    """Plot the visible images along a line in their units, and measure products of a result."""

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__()
        self.viewer = napari_viewer
        self._distance, self._unit = np.zeros(0), "px"
        self.profiles: list[Profile] = []
        tip = "Shapes layer with the line. Of several lines, the selected one is used."
        kinds = ("shapes",)
        self.lines = LayerPicker(self.viewer, tip, "none yet", kinds=kinds, label="Line")
        self.lines.add_button("✎", "Draw a new line.", self._draw)
        tip = "Width in px of the strip, perpendicular to the line, over which values are averaged."
        self.width_px = SpinBox(max=_MAX_WIDTH_PX, tooltip=f"<qt>{tip}</qt>")
        forms.steady(self.width_px.native)
        self.plot = qt.Plot(height=220)
        self.measures = forms.WrappingLabel()
        self.measures.setToolTip(
            "<qt>Peak: value of largest magnitude. Width: full width at half of the peak, relative "
            "to zero. Area: integral along the line.</qt>"
        )
        self.hint = forms.WrappingLabel(
            "Press ✎ and draw a line on the image: the images that are visible are plotted."
        )
        self.problem = forms.WrappingLabel(style=forms.PROBLEM_STYLE)
        width = forms.labelled("Width (px)", self.width_px.native)
        controls = (self.lines, width, self.hint)
        results = (self.plot, self.measures, self.problem)
        page, self.products = QtWidgets.QWidget(), ProductForm(self.viewer)
        self.products.setMinimumWidth(0)  # that of the window counts
        self.tabs = QtWidgets.QTabWidget()
        self.tabs.addTab(page, "Layers along a line")
        self.tabs.addTab(self.products, "Products of a result")
        qt.column(self, self.tabs)
        qt.column(page, *controls, *results, margin=6).setStretchFactor(self.plot, 1)
        self.plot.setVisible(True)  # it keeps its place
        self._connect()
        self._schedule_plot()

    def _connect(self) -> None:
        self._timer = qt.timer(self, _REDRAW_MS, self.update_plot, once=True)
        layers, dims, plot = self.viewer.layers, self.viewer.dims, self._schedule_plot
        qt.while_alive(self, layers, ("inserted", "removed", "reordered"), plot)
        qt.while_alive(self, dims, "current_step", plot)
        qt.layers_while_alive(self, layers, ("visible", "name"), plot)
        qt.layers_while_alive(self, layers, "set_data", self._on_data)
        self.lines.picked.connect(plot)
        self.width_px.changed.connect(plot)

    @property
    def layers(self) -> list[Any]:
        """The visible grey images, the topmost first."""
        return [layer for layer in self._images if layer.visible]

    @property
    def _images(self) -> list[Any]:
        images = [layer for layer in reversed(self.viewer.layers) if kind_of(layer) == "image"]
        return [layer for layer in images if not layer.rgb and layer.ndim >= 2]

    def update_plot(self) -> None:
        shapes, layers = self.lines.layer, self.layers
        line = None
        if shapes is not None:
            line = selected_shape(shapes, OPEN_SHAPES)
        self.profiles, problem = [], ""
        if shapes is not None and line is not None and layers:
            vertices = np.array([shapes.data_to_world(end)[-2:] for end in shapes.data[line]])
            try:
                self._sample(vertices, layers, shapes)
            except InputError as error:
                problem = str(error)
        self.problem.show_text(problem)
        self.hint.setVisible(not self.profiles and not problem)
        if self.profiles or self.plot.figure is not None:
            panels = len({profile.unit for profile in self.profiles}) or 1
            width = self.width_px.value
            averaging = f", mean over {width} px" if width else ""
            curves = self._distance, f"distance ({self._unit}){averaging}", self.profiles
            self.plot.show_drawing(lambda axes: draw_profiles(axes, *curves), panels)
        self._show_measures()

    def _sample(self, vertices: FloatArray, layers: Sequence[Any], shapes: Any) -> None:
        """Sample the layers along a line with corners in the world of its shapes."""
        step = min(float(np.min(np.abs(layer.scale[-2:]))) for layer in layers)
        _, self._distance = sample_path(vertices, step)
        self._unit = f"{layers[0].units[-1]:~P}"
        points = sample_strip(vertices, self._distance, self.width_px.value * step, step)
        position = self.viewer.dims.point
        self.profiles = [
            Profile(
                layer.name,
                unit_of(layer),
                interpolate(shown_plane(layer, position), points, pixel_mapper(layer, shapes)),
            )
            for layer in layers
        ]

    def _show_measures(self) -> None:
        lines = []
        for profile in self.profiles:
            peak = measure_peak(self._distance, profile.values)
            if peak is not None:
                name = f"{profile.name}: " if len(self.profiles) > 1 else ""
                lines.append(f"{name}{peak.text(profile.unit, self._unit)}")
        self.measures.show_text("\n".join(lines))

    def show_problem(self, text: str) -> None:
        """Show a problem until the next profile."""
        self.problem.show_text(text)

    def _schedule_plot(self, _: Any = None) -> None:
        if not self._timer.isActive():
            self._timer.start()

    def _on_data(self, event: Any) -> None:
        if event.source in (self.lines.layer, *self.layers):
            self._schedule_plot()

    @qt.notify_errors
    def _draw(self) -> None:
        images = self.layers or self._images
        if not images:
            raise InputError(
                "there is no image to draw a line on: open one (File → Open) or use a sample "
                "(File → Open Sample)"
            )
        self.lines.layer = new_shapes(self.viewer, images[0], "profile", "add_line")


_ELLIPSE_CORNERS = 90
_ROUND = 0.02  # largest difference of the axes of a circle
_BY_SETUP = "unit of the setup"
_MORE = "more"
# The products that most experiments need; the others follow below *more…*.
_USUAL = ("profile", "region", "flux", "current", "current-density", "axisymmetric")
OPEN_SHAPES = ("line", "path")
_PANEL_HEIGHT_PX = 210


def draw_groups(columns: Sequence[Any], result: ProductResult) -> None:
    """Draw the curves of a product, in a panel for each unit, but the image's intensity."""
    for axes, names in zip(columns, result.curve_groups, strict=True):
        draw_curves(axes, result, names, qt.COLOURS)
        axes.label_outer()


class ProductForm(ToolPanel):
    """Choose a result, a product and a shape, and measure it with its bands."""

    def __init__(self, viewer: Any) -> None:
        run = Run("Measure", "Measure the product with its bands.")
        super().__init__(viewer, run)
        self.measured: list[ProductResult] = []  # the last, of each part of the field
        tip = "Layer of the result of an inversion or a fit."
        self.result = LayerPicker(viewer, tip, suits=_has_fields, label="Result")
        kinds = _forms_of(PRODUCTS)
        usual = {name: kinds.pop(name) for name in _USUAL}
        self.more_products = forms.ModelPicker("", kinds)
        self.product = forms.ModelPicker("Product", {**usual, _MORE: ("more…", self.more_products)})
        tip = "Shapes layer with the line or outline. Of several, the selected is used."
        self.shapes = LayerPicker(viewer, tip, "none yet", kinds=("shapes",), label="Shape")
        self.shapes.add_button("✎", "Draw a new shape for the product.", self._draw)
        self.unit = forms.combo_box("Unit of the field, which chooses the field, too.")
        self.plot, self.report = qt.Plot(_PANEL_HEIGHT_PX, fixed=True), ReportView()
        self.export = qt.push_button("Export CSV…", "Save the numbers and curves.", self._export)
        self.add(
            self.result,
            self.product,
            self.shapes,
            forms.labelled("Unit", self.unit.native),
            self.panel,
            self.plot,
            self.report,
            self.export,
        )
        self.result.picked.connect(self._on_result)
        for picker in (self.product, self.more_products):
            picker.changed.connect(lambda: self.shapes.setVisible(_is_drawn(self.kind)))
        self._on_result()
        self.forget()

    @property
    def _picker(self) -> forms.ModelPicker:
        return self.more_products if self.product.kind == _MORE else self.product

    @property
    def kind(self) -> type[Product]:
        return PRODUCTS[self._picker.kind]

    def _on_result(self) -> None:
        """Offer the units of the result's fields."""
        layer = self.result.layer
        result = None if layer is None else about.result_of(layer)
        setup = None if result is None else result.content.setup
        fields = {"displacement"} if setup is None else {each.name for each in setup.si_fields}
        symbols = [s for s, unit in FIELD_UNITS.items() if unit.field in fields | {"displacement"}]
        self.unit.choices = (_BY_SETUP, *symbols)

    def request(self) -> Job:
        """Return what is to be measured, or raise an `InputError`."""
        layer = self.result.layer
        if layer is None:
            raise InputError(
                "there is no result to measure: run 'Invert' or 'Fit several images', or open a "
                ".shadowinv file; of a store, save the result of a shot, or use shadowinv analyse"
            )
        choices: Any = self._picker.model()
        values = {**choices.model_dump(exclude_unset=True), "product": self.kind.name()}
        if _is_drawn(self.kind):
            values |= self._outline(layer)
        symbol = self.unit.value
        product, unit = product_from_dict(values), None if symbol == _BY_SETUP else symbol
        result: Any = about.result_of(layer)
        measure: Any = partial(analyse, result.content, product, unit=unit)
        return Job(measure, partial(map_layers, layer=layer))

    def _outline(self, layer: Any) -> dict[str, Any]:
        """Return the fields of a product that the selected shape stands for, in px."""
        is_closed = "center" in self.kind.model_fields
        kinds = {"ellipse", "rectangle", "polygon", "path"} if is_closed else set(OPEN_SHAPES)
        shapes: Any = self.shapes.layer
        index = None if shapes is None else selected_shape(shapes, kinds)
        if index is None:
            expected = "closed shape, such as an ellipse," if is_closed else "line or path"
            raise InputError(
                f"there is no {expected} for the {self.kind.title}: press ✎ and draw one on the "
                "image"
            )
        corners = mapped(matrix_between(shapes, layer), shapes.data[index])
        values = shape_fields(shapes.shape_type[index], corners)
        if not values.keys() <= self.kind.model_fields.keys():
            raise InputError(
                f"the shape for the {self.kind.title} is no circle: press ✎ and draw an ellipse "
                "with the Shift key held down"
            )
        return values

    def forget(self) -> None:
        self.measured = []
        for widget in (self.report, self.plot):
            widget.setVisible(False)
        self.export.setEnabled(False)

    def show_result(self, finished: Finished, job: Job) -> None:
        self.measured = finished.content
        measured = self.measured[-1]
        rows = [(fact.title, fact.text) for fact in measured.facts]
        self.report.show_rows([*rows, *(("Note", sentence) for sentence in measured.limits)])
        panels = len(measured.curve_groups)
        self.plot.setVisible(panels > 0)
        if panels:
            self.plot.setFixedHeight(_PANEL_HEIGHT_PX * panels)
            self.plot.show_drawing(lambda axes: draw_groups(axes, measured), panels)
        self.export.setEnabled(True)
        add_layers(self.viewer, finished.layer_data)

    @qt.notify_errors
    def _draw(self) -> None:
        layer = self.result.layer
        if layer is None:
            raise InputError("there is no result to draw on: run 'Invert' first")
        mode = "add_ellipse" if "center" in self.kind.model_fields else "add_line"
        self.shapes.layer = new_shapes(self.viewer, layer, self.kind.name(), mode)

    @qt.notify_errors
    def _export(self) -> None:
        if path := qt.ask_file(self, "Export CSV", "products", qt.TABLES):
            qt.write_text(path, products_table(self.measured))
            show_info(f"Wrote {path}")


def _is_drawn(kind: type[Product]) -> bool:
    """Whether a product needs a line or an outline."""
    return not {"path", "center"}.isdisjoint(kind.model_fields)


def _forms_of(products: Mapping[str, type[Product]]) -> forms.Kinds:
    """Return titles and models of products for a picker, without the fields of shapes."""
    kinds: forms.Kinds = {}
    for name, kind in products.items():
        of_shape = {"label"} | ({"radius"} if "center" in kind.model_fields else set())
        fields: Any = {}
        for key, field in kind.parameters().items():
            extra: Any = field.json_schema_extra or {}
            if key not in of_shape and "metavar" not in extra and "hidden" not in extra:
                fields[key] = field.annotation, field
        title = f"{kind.title[:1].upper()}{kind.title[1:]}"
        kinds[name] = title, create_model(kind.title, __base__=CheckedModel, **fields)
    return kinds


def _has_fields(layer: Any) -> bool:
    return about.result_of(layer) is not None


def selected_shape(shapes: Any, kinds: Collection[str]) -> int | None:
    """Return the index of the selected shape of some kinds, or else of the last one."""
    suitable = [index for index, kind in enumerate(shapes.shape_type) if kind in kinds]
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


_MAP = about.Kind("product", "", "{title} ({unit})", colormap="signed", visible=True)


def map_layers(results: Sequence[ProductResult], layer: Any) -> LayerData:
    """Describe the maps among products, on top of a layer of their result."""
    maps = []
    for measured in results:
        for name, variable in measured.variables.items():
            if variable.dims != PLANE:
                continue
            values = measured[name].value
            largest = float(np.nanpercentile(np.abs(values), 99.8)) or 1.0
            factor, prefix = prefix_for(largest)
            words = {"title": measured.title, "unit": f"{prefix}{variable.unit}"}
            look = {"contrast_limits": (-factor * largest, factor * largest)}
            frame, shot = about.frame_of(layer), name_of_result(layer)
            maps.append(_MAP.layer(factor * values, shot, frame, None, look, words=words))
    return maps
