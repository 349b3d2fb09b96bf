"""What an inversion is given, beside the shots: source, masks, setup, steps and options."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pydantic import BaseModel
from qtpy.QtCore import QSignalBlocker, Signal
from qtpy.QtWidgets import QWidget

from napari_shadowinv import preprocessing
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.shots import radiograph_of, source_of_shot
from napari_shadowinv._napari.widgets import _forms as forms
from napari_shadowinv._napari.widgets import _layers as layers
from napari_shadowinv._napari.widgets._qt import column
from napari_shadowinv._napari.widgets._recipes import RecipeButton
from napari_shadowinv._napari.widgets._results import Origins
from napari_shadowinv._napari.widgets._steps import StepsSection
from napari_shadowinv._system.validation import validated
from napari_shadowinv._typing import BoolArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.setup import SETUPS, Setup, geometry_text, setup_warnings
from napari_shadowinv.pipeline._run import PREVIEW_SITES

_NONE = "none"
_CHANGED = ", changed by hand"
_EARLIER = ", in an earlier session"
_OWN, _LAYER, _FILE = "own", "layer", "file"


@dataclass(frozen=True)
class _Given:
    values: dict[str, Any]
    origin: str


class SetupPicker(QWidget):
    """A setup, kept with its image; what the user typed or loaded is offered to the next image."""

    changed = Signal()

    def __init__(self) -> None:
        super().__init__()
        self._layer: Any = None
        self._name, self._keeps = "", True
        self._own: dict[str, _Given] = {}
        self._shown: dict[str, _Given] = {}
        self.picker = forms.ModelPicker(
            "Setup", {_NONE: ("none: results in pixels", None), **forms.kinds_of(SETUPS)}
        )
        self.picker.choice.setToolTip(
            "<qt>With a setup the results are in SI units; lengths can be entered as 1.3 mm or "
            "0.0013.</qt>"
        )
        self.geometry_label = forms.wrapping_label()
        self.doubts = forms.wrapping_label(style=forms.PROBLEM_STYLE)
        self.note = forms.wrapping_label()
        self.files = forms.TomlButtons("setup", self._to_save, self.load)
        column(self, self.picker, self.geometry_label, self.doubts, self.note, self.files)
        self._state = self.picker.state()
        self.picker.changed.connect(self._on_edit)

    def setup(self) -> Setup | None:
        return self.picker.model()  # type: ignore[return-value]

    @property
    def origin(self) -> str:
        """Where the setup comes from, such as ``"typed for 'shot'"``; empty for none."""
        if self.picker.kind == _NONE:
            return ""
        given = self._shown.get(self.picker.kind)
        return self._typed() if given is None else given.origin

    @property
    def described(self) -> str:
        kind = self.picker.choice.currentText()
        return f"{kind}, {self.origin}" if self.origin else kind

    def state(self) -> dict[str, Any]:
        """What is kept: what the user gave. Whether it is chosen is a matter of the image."""
        return {"own": {kind: asdict(given) for kind, given in self._own.items()}}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Have ready what `state` has returned; none is chosen."""
        own = state.get("own")
        for kind, given in own.items() if isinstance(own, Mapping) else ():
            origin = str(given["origin"]).removesuffix(_EARLIER) + _EARLIER
            self._own[kind] = _Given(dict(given["values"]), origin)
        self._show(_NONE)

    def follow(self, layer: Any, name: str = "", *, keep: bool = True) -> None:
        """Show the setup of another image, or of files; with `keep`, changes stay with it."""
        if layer == self._layer and name == self._name:
            return
        # Files may be named after their setup is typed.
        stays = layer is None and self._layer is None and not self._name
        self._layer, self._name, self._keeps = layer, name, keep
        setup = None if layer is None else about.setup_of(layer)
        if setup is not None:
            self.suggest(setup, about.setup_origin_of(layer) or f"{about.CAME_WITH} '{layer.name}'")
        elif not stays:
            self._show(_NONE)
            self.changed.emit()

    def suggest(self, setup: Setup, origin: str) -> None:
        """Show a setup that is not the user's own, until he changes it."""
        self._show(setup.kind, _Given(setup.model_dump(), origin))
        self.changed.emit()

    def show_setup(self, values: Mapping[str, Any], origin: str = "") -> None:
        """Fill in a setup that the user gives; without an origin he has typed it."""
        kind = str(values["kind"])
        given = _Given(dict(values), origin or self._typed())
        self._show(kind, given)
        self._remember(kind, given)
        self._keep_with_image()
        self.changed.emit()

    def _show(self, kind: str, given: _Given | None = None) -> None:
        """Fill in one setup, or none, and for the other kinds what the user gave last."""
        self._shown = {**self._own} | ({} if given is None else {kind: given})
        blank: dict[str, Any] = {known: {} for known in self.picker.state()["values"]}
        values = blank | {known: held.values for known, held in self._shown.items()}
        with QSignalBlocker(self.picker):
            self.picker.restore({"kind": kind, "values": values})
        self._tell()

    def _on_edit(self) -> None:
        kind, before = self.picker.kind, self._state
        values = self.picker.state()["values"].get(kind, {})
        # To look at another form, or to leave a field as it was, is no change of values.
        if kind == before["kind"] and values != before["values"].get(kind):
            shown = self._shown.get(kind)
            if shown is None or shown.origin.startswith("typed"):
                origin = self._typed()
            else:
                origin = shown.origin.removesuffix(_CHANGED) + _CHANGED
            self._remember(kind, _Given(values, origin))
        self._tell()
        self._keep_with_image()
        self.changed.emit()

    def _remember(self, kind: str, given: _Given) -> None:
        """Keep what is shown for other images, if it is the user's own."""
        self._shown[kind] = given
        if not given.origin.startswith(about.CAME_WITH):
            self._own[kind] = given

    def _keep_with_image(self) -> None:
        if self._layer is None or not self._keeps:
            return
        try:
            setup = self.setup()
        except InputError:
            return  # half a setup: the image keeps the one it has
        if setup != about.setup_of(self._layer) or self.origin != about.setup_origin_of(
            self._layer
        ):
            about.keep_setup(self._layer, setup, self.origin)

    def _typed(self) -> str:
        name = self._name if self._layer is None else self._layer.name
        return f"typed for '{name}'" if name else "typed"

    def _tell(self) -> None:
        """Say beside the fields where they come from, unless there is nothing in them."""
        self._state = self.picker.state()
        form = self.picker.form
        filled = form is not None and not form.is_empty
        self.note.setText(f"{self.origin[:1].upper()}{self.origin[1:]}." if filled else "")
        self.note.setVisible(filled)
        self._show_geometry()

    def _show_geometry(self) -> None:
        """Show field of view and magnification under the fields, and what is doubtful of them."""
        try:
            setup = self.setup()
        except InputError:
            setup = None  # the form names the field
        shape = None
        if self._layer is not None and not getattr(self._layer, "rgb", False):
            height, width = self._layer.data.shape[-2:]
            shape = height, width
        line = "" if setup is None else geometry_text(setup, shape)
        doubts = [] if setup is None else [each.text for each in setup_warnings(setup, shape)]
        for label, text in ((self.geometry_label, line), (self.doubts, "\n".join(doubts))):
            label.setText(text)
            label.setVisible(bool(text))

    def _to_save(self) -> dict[str, object]:
        setup = self.setup()
        return {} if setup is None else setup.model_dump()

    def load(self, loaded: dict[str, Any], path: str) -> None:
        """Show a setup that a file holds."""
        from napari_shadowinv.physics.setup import setup_from_dict

        values = setup_from_dict(loaded, path).model_dump()
        whom = self._typed().removeprefix("typed")
        self.show_setup(values, f"loaded from {Path(path).name}{whom}")


class SourcePicker(forms.RowPicker):
    """Uniform, a layer, a file, what came with the shot, or an estimate from it."""

    def __init__(self, viewer: Any) -> None:
        self._image: Any = None
        self._before_own = "uniform"
        self._loaded = preprocessing.MeasuredSource()
        tip = "Image layer of the undisturbed beam."
        self.layers = layers.LayerPicker(viewer, ("image",), tip, "choose a layer", self._offers)
        self.file = forms.PathEdit("Image of the undisturbed beam")
        kinds = forms.kinds_of(preprocessing.ESTIMATES, "estimate: ")
        _, uniform = kinds.pop("uniform")
        super().__init__(
            "Source",
            {
                "uniform": ("uniform", uniform),
                _LAYER: ("a layer", None),
                _FILE: ("a file", None),
                _OWN: ("the one supplied with the shot", None),
                **kinds,
            },
            "The beam without the object: ideally a measured reference image, otherwise uniform "
            "or estimated from the shot itself.",
            {_LAYER: forms.labelled("", self.layers), _FILE: forms.labelled("", self.file)},
        )
        self.layers.picked.connect(self.changed)
        self.file.changed.connect(self.changed)

    @property
    def is_guessed(self) -> bool:
        """Whether it is an estimate from the shot, which a mask can keep from the object."""
        estimate = preprocessing.ESTIMATES.get(self.picker.kind)
        return estimate is not None and estimate.uses_mask

    @property
    def is_own(self) -> bool:
        """Whether it is the one that came with the shot."""
        return self.picker.kind == _OWN

    @property
    def described(self) -> str:
        kind = self.picker.kind
        if kind == _LAYER and self.layers.layer is not None:
            return f"layer '{self.layers.layer.name}'"
        if kind == _FILE:
            return f"file {Path(self.file.path).name}"
        if kind == _OWN:
            return "came with the shot"
        model = self.picker.model()
        assert isinstance(model, preprocessing.Estimate)
        return f"estimate: {model.described}" if self.is_guessed else model.described

    @property
    def short_name(self) -> str:
        """The source in the name of a result; empty for a uniform one and for the shot's."""
        kind = self.picker.kind
        if kind in (_OWN, "uniform"):
            return ""
        if kind == _LAYER:
            return "" if self.layers.layer is None else str(self.layers.layer.name)
        return Path(self.file.path).name if kind == _FILE else f"{kind} source"

    def chosen(self) -> preprocessing.Estimate | preprocessing.MeasuredSource:
        """What a recipe says of the source, or an `InputError`."""
        model = self.picker.model()
        if isinstance(model, preprocessing.Estimate):
            return model
        if self.picker.kind != _FILE:
            return preprocessing.MeasuredSource()
        if not self.file.path:
            raise InputError("no source file is selected: choose one, or choose another source")
        if self._loaded.file is not None and str(self._loaded.file) == self.file.path:
            return self._loaded  # the form has no name for what is in the file
        return preprocessing.MeasuredSource(file=Path(self.file.path))

    def show(self, source: Any) -> None:
        """Show the source of a recipe; None for uniform."""
        if isinstance(source, preprocessing.Estimate):
            name = source.name()
            self.restore({"kind": name, "values": {name: source.values()}})
        elif source is None:
            self.picker.set_kind("uniform")
        elif source.file is None:
            self.picker.set_kind(_OWN)
        else:
            self._loaded = source
            self.file.edit.setText(str(source.file))
            self.picker.set_kind(_FILE)
            self.changed.emit()

    def measured(self, image_layer: Any) -> preprocessing.Radiograph | None:
        """The measured source of an image layer unless it is a file, or an `InputError`."""
        kind = self.picker.kind
        if kind == _LAYER:
            if self.layers.layer is None:
                raise InputError(
                    "no source layer is selected: choose one below 'a layer', or choose another "
                    "source"
                )
            chosen = self.layers.layer
            data = layers.image_of(chosen, "source image")
            shot = preprocessing.Radiograph(data)
            if image_layer is not None:
                shot = radiograph_of(image_layer, image_layer.data)
            beam = source_of_shot(chosen, data, shot)
            return replace(beam, warnings=layers.warnings_of(chosen))
        if kind == _OWN:
            own = about.source_of(image_layer)
            if own is None:
                raise InputError(
                    f"'{image_layer.name}' has no source of its own: choose another kind of source"
                )
            return radiograph_of(image_layer, own)
        return None

    def check(self, mask: BoolArray | None) -> None:
        """Refuse a mask over what the chosen layer was estimated without: the object."""
        layer = self.layers.layer if self.picker.kind == _LAYER else None
        bare = None if layer is None else about.mark_of(layer).get("source_mask")
        if bare is not None and mask is not None and bare.shape == mask.shape:
            preprocessing.check_masks(mask, bare)

    def state(self) -> dict[str, Any]:
        """What is kept: layers and files belong to a session."""
        kept = self.picker.state()
        kind = self._before_own if kept["kind"] == _OWN else kept["kind"]
        return {**kept, "kind": "uniform" if kind in (_LAYER, _FILE) else kind}

    def restore(self, state: Mapping[str, Any]) -> None:
        self.picker.restore(state)

    def follow(self, image_layer: Any) -> None:
        """Take the source that came with an image, or leave that of another image."""
        self._image = image_layer
        self.layers.fill()
        if image_layer is not None and about.source_of(image_layer) is not None:
            if self.picker.kind != _OWN:
                self._before_own = self.picker.kind
            self.picker.set_kind(_OWN)
        elif self.picker.kind == _OWN:
            self.picker.set_kind(self._before_own)

    def _offers(self, layer: Any) -> bool:
        # An image is not its own source: it would differ from it nowhere.
        return layer != self._image and about.may_be_source(layer)

    def _on_kind(self) -> None:
        if self.picker.kind == _LAYER and self.layers.layer is None:
            self.layers.layer = self._only_source()
        super()._on_kind()

    def _only_source(self) -> Any | None:
        """The one layer, no result's, that is known to be a source and fits the image, or None."""
        shape = None if self._image is None else tuple(self._image.data.shape[-2:])
        known = [
            layer
            for layer in self.layers.offered
            if about.role_of(layer) == about.SOURCE and about.result_of(layer) is None
        ]
        fitting = [layer for layer in known if tuple(layer.data.shape[-2:]) == shape]
        return fitting[0] if len(fitting) == 1 else None


class OptionsForm(forms.ModelForm):
    """The form of options, with buttons that load and save them."""

    def __init__(
        self,
        model_class: type[BaseModel] = InversionOptions,
        first: Mapping[str, Any] = MappingProxyType({"n_sites": PREVIEW_SITES}),
    ) -> None:
        super().__init__(model_class, first=first)
        self.files = forms.TomlButtons("options", self._to_save, self._take)
        self.layout().addWidget(self.files)

    def _to_save(self) -> dict[str, object]:
        self.model()
        return self.values()

    def _take(self, loaded: dict[str, object], path: str) -> None:
        validated(self._model_class, loaded, path)
        self.set_values(loaded)


class InversionInputs:
    """The controls that panels for a shot and for a stack have in common."""

    viewer: Any
    crop: Any = None  # a picker, where a rectangle can be drawn

    def make_inputs(
        self, image: Callable[[], Any], kinds: tuple[str, ...], mask_tip: str, source_mask_tip: str
    ) -> None:
        """Make them, in rows `beam` and `how`; masks are layers of these kinds for the image."""
        self.source = SourcePicker(self.viewer)
        self.masks = layers.MaskPicker(self.viewer, image, kinds, mask_tip)
        self.source_masks = layers.MaskPicker(
            self.viewer, image, kinds, source_mask_tip, "Source mask"
        )
        self.setup = SetupPicker()
        self.steps = StepsSection()
        self.options = OptionsForm()
        self.recipes = RecipeButton(self)
        self.chosen_image = image
        self.beam = (self.source, self.source_masks, self.masks)
        options = forms.section("Options", self.options)
        self.how = (self.setup, self.steps, options, self.recipes)
        self.inputs = (*self.beam, self.setup, self.steps, self.options)
        self.source.changed.connect(self._show_source_mask)
        self._show_source_mask()

    def _show_source_mask(self) -> None:
        self.source_masks.setVisible(self.source.is_guessed)

    def parts(self) -> dict[str, Any]:
        return {
            "source": self.source,
            "setup": self.setup,
            "steps": self.steps,
            "options": self.options,
            "painted_is_unusable": self.masks,
            "painted_is_object": self.source_masks,
        }

    def all_steps(self) -> tuple[preprocessing.Step, ...]:
        """What is done to an image first; or an `InputError`."""
        part = None if self.crop is None else layers.crop_of(self.crop.layer, self.chosen_image())
        if part is None:
            return self.steps.steps()
        rows, columns = part
        crop = preprocessing.Crop(y=(rows.start, rows.stop), x=(columns.start, columns.stop))
        return (crop, *self.steps.steps())

    def hidden_from_source(self, image: Any) -> BoolArray | None:
        """False where the object is, as far as the source is estimated without it."""
        return self.source_masks.usable(image) if self.source.is_guessed else None

    def recipe(self) -> preprocessing.Recipe:
        """What the controls ask for, but for masks and layers; or an `InputError`."""
        return preprocessing.Recipe(
            steps=self.all_steps(),
            source=self.source.chosen(),
            setup=self.setup.setup(),
            options=self.options.model(),
        )

    def companions(self, image: Any, *others: Any) -> tuple[Any, ...]:
        """Layers that lie on an image: masks and source, and others if there are any."""
        chosen = (self.masks.layer, self.source_masks.layer, *others, self.source.layers.layer)
        return tuple(one for one in chosen if one is not None and one is not image)

    def origins(self, layer: Any, name: str) -> Origins:
        """Where all of it comes from, for an image or the images of that name."""
        return Origins(
            name,
            self.source.described,
            self.masks.described(layer),
            self.source_masks.described(layer) if self.source.is_guessed else "",
            self.setup.described,
            self.setup.origin,
        )
