"""The form that measures products of a result or of all shots of a store: `ProductForm`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np
from napari.utils.notifications import show_info
from pydantic import Field, create_model
from qtpy import QtWidgets

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.jobs import Finished, Job, name_of_result
from napari_shadowinv._napari.layer_metadata import mapped, matrix_between
from napari_shadowinv._napari.layers import LayerData, add_layers
from napari_shadowinv._napari.run import Run
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._layers import LayerPicker, new_shapes
from napari_shadowinv._napari.widgets._panels import ReportView, ToolPanel
from napari_shadowinv._system.arrays import PLANE
from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv._system.validation import CheckedModel
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
from napari_shadowinv.analysis.series import shot_times
from napari_shadowinv.errors import InputError
from napari_shadowinv.io import write
from napari_shadowinv.io.formats import FIGURE_SUFFIXES
from napari_shadowinv.io.store_shots import open_shots
from napari_shadowinv.physics.beam import numbers_in_unit
from napari_shadowinv.physics.units import prefix_for
from napari_shadowinv.plotting import draw_curves, products_figure, save_figure

_ELLIPSE_CORNERS = 90
_ROUND = 0.02  # largest difference of the axes of a circle
_BY_SETUP = "unit of the setup"
_MORE = "more"
# The products that most experiments need; the others follow below *more…*.
_USUAL = ("profile", "region", "flux", "current", "current-density", "axisymmetric")
OPEN_SHAPES = ("line", "path")
_PANEL_HEIGHT_PX = 210


@dataclass(frozen=True, eq=False)
class ProductJob(Job):
    """The measurement of a product, of a result or of the shots of a store."""

    origin: about.Result[Any] | Path
    layer: Any  # of the result or the store
    product: Product
    unit: str | None
    samples: int
    shots: str | None
    times: str

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> list[ProductResult]:
        common: Any = {"unit": self.unit, "on_progress": on_progress, "should_stop": should_stop}
        if isinstance(self.origin, Path):
            stack = open_shots(self.origin, self.shots)
            seconds = _seconds(self.times, stack["index"].values.tolist())
            return analyse_shots(stack, self.product, seconds, **common)
        return analyse(self.origin.content, self.product, samples=self.samples, **common)

    def layers(self, content: list[ProductResult]) -> LayerData:
        """Describe the maps, on top of the result."""
        return [
            map_layer(measured, name, self.layer)
            for measured in content
            for name, variable in measured.variables.items()
            if variable.dims == PLANE
        ]


def draw_groups(columns: Sequence[Any], result: ProductResult) -> None:
    """Draw the curves of a product, in a panel for each unit, but the image's intensity."""
    for axes, names in zip(columns, result.curve_groups, strict=True):
        draw_curves(axes, result, names, qt.COLOURS)
        axes.label_outer()


class _Bands(CheckedModel):
    """How the bands of a single result are found."""

    samples: int = Field(
        default=100, ge=20, le=2000, description="Number of samples of the field for the bands."
    )


class _Shots(CheckedModel):
    """The shots of a store that are followed."""

    shots: str = Field(
        default="all finished ones",
        description="Shots of the store, such as 3:20 or 0,2,5. Empty: all finished ones.",
    )
    times: str = Field(
        default="shots are numbered",
        description="Time between two shots of the store, such as 1 ns, or the times of all shots "
        "used, such as 0, 1 ns, 3 ns; a number without a unit is in s. Empty: shots are "
        "numbered, and rates are per shot.",
    )


class ProductForm(ToolPanel):
    """Choose a result, a product and a shape, and measure it with its bands.

    Of a store, the product is followed through its shots.
    """

    def __init__(self, viewer: Any) -> None:
        run = Run("Measure", "Measure the product with its bands.")
        super().__init__(viewer, run)
        self.measured: list[ProductResult] = []
        self._origin: about.Result[Any] | Path | None = None
        tip = "Layer of the result of an inversion or a fit, or of a store of shots."
        self.result = LayerPicker(viewer, tip, suits=_has_products, label="Result")
        kinds = _forms_of(PRODUCTS)
        usual = {name: kinds.pop(name) for name in _USUAL}
        self.more_products = forms.ModelPicker("", kinds)
        self.product = forms.ModelPicker("Product", {**usual, _MORE: ("more…", self.more_products)})
        tip = "Shapes layer with the line or outline. Of several, the selected is used."
        self.shapes = LayerPicker(viewer, tip, "none yet", kinds=("shapes",), label="Shape")
        self.shapes.add_button("✎", "Draw a new shape for the product.", self._draw)
        self.unit = forms.combo_box("Unit of the field, which chooses the field, too.")
        self.bands, self.shots = forms.ModelForm(_Bands), forms.ModelForm(_Shots)
        self.plot, self.report = qt.Plot(_PANEL_HEIGHT_PX, fixed=True), ReportView()
        self.export = qt.push_button("Export CSV…", "Save all measured products.", self._export)
        self.save = qt.push_button("Save with result…", "", self._save)
        self.picture = qt.push_button(
            "Save figure…", "Save a figure of all measured products.", self._save_figure
        )
        self.clear = qt.push_button("Clear", "Forget all measured products.", self._clear)
        self.add(
            self.result,
            self.shots,
            self.product,
            self.shapes,
            forms.labelled("Unit", self.unit.native),
            self.bands,
            self.panel,
            self.plot,
            self.report,
            qt.side_by_side((self.export, 1), (self.picture, 1)),
            qt.side_by_side((self.save, 1), (self.clear, 0)),
        )
        self.result.picked.connect(self._on_result)
        for picker in (self.product, self.more_products):
            picker.changed.connect(lambda: self.shapes.setVisible(_is_drawn(self.kind)))
        self._on_result()
        self._clear()

    @property
    def _picker(self) -> forms.ModelPicker:
        return self.more_products if self.product.kind == _MORE else self.product

    @property
    def kind(self) -> type[Product]:
        return PRODUCTS[self._picker.kind]

    def _on_result(self) -> None:
        """Show the entries of a store or of a single result, and offer the units of its fields."""
        layer = self.result.layer
        is_store = layer is not None and _store_of(layer) is not None
        self.shots.setVisible(is_store)
        self.bands.setVisible(not is_store)
        tip = "Save the result with all measured products."
        if is_store:
            tip = "Only for a single result; of a store, export a table or save a figure."
        self.save.setToolTip(f"<qt>{tip}</qt>")
        result = None if layer is None else about.result_of(layer)
        setup = (
            about.setup_of(layer) if is_store else None if result is None else result.content.setup
        )
        fields = {"displacement"} if setup is None else {each.name for each in setup.si_fields}
        symbols = [s for s, unit in FIELD_UNITS.items() if unit.field in fields | {"displacement"}]
        self.unit.choices = (_BY_SETUP, *symbols)

    def request(self) -> ProductJob:
        """Return what is to be measured, or raise an `InputError`."""
        layer = self.result.layer
        if layer is None:
            raise InputError(
                "there is no result to measure: run 'Invert' or 'Fit several images', or open a "
                ".shadowinv file or a store of shots"
            )
        choices: Any = self._picker.model()
        values = {**choices.model_dump(exclude_unset=True), "product": self.kind.name()}
        if _is_drawn(self.kind):
            values |= self._outline(layer)
        symbol = self.unit.value
        product, unit = product_from_dict(values), None if symbol == _BY_SETUP else symbol
        origin: Any = _store_of(layer) or about.result_of(layer)
        bands: Any = self.bands.model()
        shots = self.shots.state()
        followed = shots.get("shots"), shots.get("times", "")
        return ProductJob(origin, layer, product, unit, bands.samples, *followed)

    def _outline(self, layer: Any) -> dict[str, Any]:
        """Return the fields of a product that the selected shape stands for, in px."""
        shapes = self.shapes.layer
        if shapes is None or not len(shapes.data):
            raise InputError(
                f"there is no shape for the {self.kind.title}: press ✎ and draw one on the image"
            )
        is_closed = "center" in self.kind.model_fields
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
        values = shape_fields(shapes.shape_type[index], corners)
        if not values.keys() <= self.kind.model_fields.keys():
            raise InputError(
                f"the shape for the {self.kind.title} is no circle: press ✎ and draw an ellipse "
                "with the Shift key held down"
            )
        return values

    def choose(self, layer: Any) -> None:
        """Select the result that a layer belongs to, or raise an `InputError`."""
        together = [] if layer is None else about.layers_of(self.viewer, layer)
        of_result = [each for each in together if each in self.result.offered]
        if not of_result:
            raise InputError(
                "no result is selected: select a layer of an inversion, a fit or a store of shots"
            )
        self.result.layer = layer if layer in of_result else of_result[-1]

    def forget(self) -> None:
        self.report.setVisible(False)
        self.plot.setVisible(False)

    def show_result(self, finished: Finished, job: ProductJob) -> None:
        if self._origin != job.origin:
            self.measured = []
        self._origin = job.origin
        for measured in finished.content:
            taken = {each.name for each in self.measured}
            numbered = (f"{measured.name}_{number}" for number in count(2))
            name = next(n for n in chain([measured.name], numbered) if n not in taken)
            self.measured.append(replace(measured, name=name))
        measured = self.measured[-1]
        rows = [(fact.title, fact.text) for fact in measured.facts]
        self.report.show_rows([*rows, *(("Note", sentence) for sentence in measured.limits)])
        panels = len(measured.curve_groups)
        self.plot.setVisible(panels > 0)
        if panels:
            self.plot.setFixedHeight(_PANEL_HEIGHT_PX * panels)
            self.plot.show_drawing(lambda axes: draw_groups(axes, measured), panels)
        for widget in (self.export, self.picture, self.clear):
            widget.setEnabled(True)
        self.save.setEnabled(isinstance(job.origin, about.Result))
        add_layers(self.viewer, finished.layer_data)

    def _clear(self) -> None:
        self.measured, self._origin = [], None
        self.forget()
        for widget in (self.export, self.picture, self.save, self.clear):
            widget.setEnabled(False)

    @qt.notify_errors
    def _draw(self) -> None:
        layer = self.result.layer
        if layer is None:
            raise InputError("there is no result to draw on: run 'Invert' first")
        mode = "add_ellipse" if "center" in self.kind.model_fields else "add_line"
        self.shapes.layer = new_shapes(self.viewer, layer, self.kind.name(), mode)

    @qt.notify_errors
    def _export(self) -> None:
        export_csv(self, "products", products_table(self.measured))

    @qt.notify_errors
    def _save_figure(self) -> None:
        formats = ";;".join(qt.filter_of(end[1:].upper(), [end]) for end in FIGURE_SUFFIXES)
        if path := qt.ask_file(self, "Save figure", "products", formats):
            figure = products_figure(self.measured)
            show_info(f"Wrote {save_figure(path, figure, overwrite=True)}")

    @qt.notify_errors
    def _save(self) -> None:
        result: Any = self._origin
        if path := qt.ask_file(self, "Save with result", "products", qt.RESULT_FILES):
            dataset = add_products(result.content.to_dataset(), self.measured)
            show_info(f"Wrote {write(path, dataset, overwrite=True)}")


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


def _has_products(layer: Any) -> bool:
    return about.result_of(layer) is not None or _store_of(layer) is not None


def _store_of(layer: Any) -> Path | None:
    store = about.metadata_of(layer).get("store")
    return None if store is None else Path(store)


def _seconds(times: str, shots: list[int]) -> list[float] | None:
    """Return the time of each shot in s; None if shots are numbered."""
    if not times:
        return None
    return shot_times(numbers_in_unit(times, "s", "Times"), shots, f"Times is '{times}'")


def export_csv(parent: QtWidgets.QWidget, stem: str, text: str) -> None:
    """Ask for a file, offering a name, and write a table."""
    if path := qt.ask_file(parent, "Export CSV", stem, qt.TABLES):
        qt.write_text(path, text)
        show_info(f"Wrote {path}")


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


_MAP = about.Kind("product", "", "{title} ({unit})", colormap="signed", visible=True)


def map_layer(measured: ProductResult, name: str, layer: Any) -> Any:
    """Describe the layer of a map, on top of a layer of its result."""
    values = measured[name].value
    largest = float(np.nanpercentile(np.abs(values), 99.8)) or 1.0
    factor, prefix = prefix_for(largest)
    unit = f"{prefix}{measured.variables[name].unit}"
    look = {"contrast_limits": (-factor * largest, factor * largest)}
    words, name = {"title": measured.title, "unit": unit}, name_of_result(layer)
    return _MAP.layer(factor * values, name, about.frame_of(layer), None, look, words=words)
