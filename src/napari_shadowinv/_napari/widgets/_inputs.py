"""Inputs of an inversion or fit other than its images: source, masks, setup and options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import BaseModel
from qtpy.QtCore import QSignalBlocker
from qtpy.QtWidgets import QFileDialog, QWidget

from napari_shadowinv import preprocessing
from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.preferences import preference
from napari_shadowinv._napari.shots import shot_of_layer, source_of_shot
from napari_shadowinv._napari.widgets import _layers as layers
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._files import RecipeButton
from napari_shadowinv._napari.widgets._layers import LAYER
from napari_shadowinv._napari.widgets._panels import ResultView, ToolPanel
from napari_shadowinv._typing import BoolArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.io import read_toml
from napari_shadowinv.options import (
    ASSUMED_BEAM,
    BEAM_SOURCES,
    DETECTORS,
    REFERENCE_BEAM,
    Instrument,
)
from napari_shadowinv.physics.beam import geometry_text, setup_cautions, text_in_unit, unit_in_title
from napari_shadowinv.physics.setup import SETUPS, Setup
from napari_shadowinv.pipeline.files import complete_setup
from napari_shadowinv.shot import Shot

_NONE = "none"
_INSTRUMENT_KINDS = ("detector", "beam_source")
_KINDS: Mapping[Any, Mapping[str, float]] = {**DETECTORS, **BEAM_SOURCES}
# Numbers of an instrument without a default.
_UNSTATED = {
    "beam_rms": f"{ASSUMED_BEAM.rms:g}, or {REFERENCE_BEAM.rms:g} if recorded",
    "noise_correlation": "measured in the image",
    "registration": "measured in the images",
}
_CHANGED = ", changed by hand"
_EARLIER = ", in an earlier session"
UNIFORM, FILE, SUPPLIED, UNKNOWN = "uniform", "file", "own", "unknown"
"""Kinds of sources; all other kinds are estimates."""
SHOT_SOURCES = tuple(dict.fromkeys((UNIFORM, LAYER, FILE, SUPPLIED, *preprocessing.ESTIMATES)))
FIT_SOURCES = (UNIFORM, LAYER, UNKNOWN)
_SOURCE_TITLES = {
    **{kind: f"estimate: {each.title}" for kind, each in preprocessing.ESTIMATES.items()},
    UNIFORM: preprocessing.ESTIMATES[UNIFORM].title,
    LAYER: "",
    FILE: "a file",
    SUPPLIED: "supplied with the shot",
    UNKNOWN: "unknown (fit it)",
}


class SetupPicker(forms.ModelPicker):
    """A setup, stored with its image; the user's setups are offered to the next image.

    If it `waits`, a loaded setup goes with whatever image is chosen until `keep` is called.
    """

    def __init__(self, name: str, *, waits: bool = False) -> None:
        self._saved_as, self._waits, self._is_loaded = name, waits, False
        self._layer: Any = None
        self._name, self._stores = "", True
        self._before: Any = None  # kind and values before an edit
        self._origins: dict[str, str] = {}  # by kind, of what the forms show
        state = qt.saved_state(name)
        self._last = state.get("last", _NONE)  # the kind that the user chose last
        # Values and origins of the setups that the user entered, by kind.
        self._entered: dict[str, Any] = {
            kind: (values, origin.removesuffix(_EARLIER) + _EARLIER)
            for kind, (values, origin) in state.get("own", {}).items()
        }
        self.geometry_label = forms.WrappingLabel()
        self.warning_label = forms.WrappingLabel(style=forms.PROBLEM_STYLE)
        self.note = forms.WrappingLabel()
        super().__init__(
            "Setup",
            {_NONE: ("none: results in pixels", None), **forms.kinds_of(SETUPS)},
            "With a setup, results are in SI units. Lengths can be entered as 1.3 mm or 0.0013.",
        )
        self.load_button = qt.push_button(
            "Load setup…", "Read setup from a TOML file.", self._ask_and_load
        )
        self.save_button = qt.push_button(
            "Save…", "Write setup to a TOML file, for use here or on the command line.", self._save
        )
        buttons = qt.side_by_side((self.load_button, 0), (self.save_button, 0), (QWidget(), 1))
        below = QWidget()
        qt.column(below, self.geometry_label, self.warning_label, self.note, buttons)
        self.layout().addWidget(below)
        self._show_default()

    def setup(self) -> Setup | None:
        return self.model()  # type: ignore[return-value]

    def complete_setup(self) -> Setup | None:
        """Return the setup; None without one, or while it is incomplete."""
        try:
            return self.setup()
        except InputError:
            return None  # the form names the field

    @property
    def origin(self) -> str:
        """Where the setup comes from, such as ``"typed for 'shot'"``; empty without a setup."""
        return self._origins.get(self.kind, self._typed_origin) if self.form else ""

    @property
    def summary(self) -> str:
        kind = self.choice.current_choice
        return f"{kind}, {self.origin}" if self.origin else kind

    def follow(self, layer: Any, name: str = "", *, store: bool = True) -> None:
        """Show the setup of another image, or of files; with `store`, the image stores changes."""
        if layer == self._layer and name == self._name:
            return
        # The setup may be typed before the files are chosen.
        is_typed_before = layer is None and self._layer is None and not self._name
        self._layer, self._name, self._stores = layer, name, store
        setup = None if layer is None else about.setup_of(layer)
        if self._is_loaded:
            self._show_notes()
        elif setup is not None:
            origin = about.setup_origin_of(layer) or f"{about.CAME_WITH} '{layer.name}'"
            self._show_setups(setup.model_dump(), origin)
        elif not is_typed_before:
            self._show_default()
        self.changed.emit()

    def suggest(self, setup: Setup, origin: str) -> None:
        """Show a setup that the user did not enter; editing it makes it the user's."""
        self._show_setups(setup.model_dump(), origin)
        self.changed.emit()

    def choose_kind(self, kind: str) -> None:
        """Show the user's setup of a kind, or else the paper's."""
        self.set_kind(kind)
        if self.form is not None and self.form.is_empty:
            self.suggest(SETUPS[kind].example(), "example from the paper")

    def show_setup(self, values: Mapping[str, Any], origin: str = "") -> None:
        """Show a setup from the user: loaded from `origin`, or typed if that is empty."""
        self._is_loaded = bool(origin) and self._waits
        self._show_setups(values, origin or self._typed_origin)
        self._enter()
        self._store()
        self.changed.emit()

    def keep(self) -> None:
        """Store a loaded setup with the image that is chosen now."""
        if self._is_loaded:
            self._is_loaded = False
            self._store()

    def _show_default(self) -> None:
        """Show the setup of images without one of their own: none, or the user's last."""
        self._show_setups(None)
        if preference("widgets", "last_setup") and self._last in self._entered:
            with QSignalBlocker(self):
                self.set_kind(self._last)
            self._show_notes()

    def _show_setups(self, values: Mapping[str, Any] | None, origin: str = "") -> None:
        """Show a setup or none; the forms of other kinds get the user's entries."""
        setups: dict[str, Any] = dict.fromkeys(self._forms, ({}, "")) | self._entered
        kind = _NONE if values is None else str(values["kind"])
        if values is not None:
            setups[kind] = values, origin
        self._origins = {each: origin for each, (_, origin) in setups.items() if origin}
        with QSignalBlocker(self):
            self.restore(kind, {each: values for each, (values, _) in setups.items()})
        self._show_notes()

    def _on_entry(self) -> None:
        """Store what the user has chosen or typed."""
        if self._before is None or self.signalsBlocked():
            return
        kind, values = self._before
        if self.kind != kind:
            self._is_loaded = False
        # Leaving a field as it was changes no values.
        elif self.form is not None and self.form.state() != values:
            is_typed = self.origin.startswith("typed")
            changed = self.origin.removesuffix(_CHANGED) + _CHANGED
            self._origins[kind] = self._typed_origin if is_typed else changed
            self._enter()
        self._store()
        self.changed.emit()

    def _enter(self) -> None:
        """Offer the setup shown to other images, too, unless it came with an image."""
        if self.form is not None and not self.origin.startswith(about.CAME_WITH):
            self._entered[self.kind] = self.form.state(), self.origin

    def _store(self) -> None:
        """Keep the user's setups for later sessions, and the setup shown with its image."""
        self._last = self.kind
        qt.save_state(self._saved_as, {"own": self._entered, "last": self._last})
        self._show_notes()
        if self._layer is not None and self._stores and not self._is_loaded:
            with suppress(InputError):  # incomplete: the image keeps its setup
                about.store_setup(self._layer, self.setup(), self.origin)

    @property
    def _typed_origin(self) -> str:
        name = self._name if self._layer is None else self._layer.name
        return f"typed for '{name}'" if name else "typed"

    def _show_notes(self) -> None:
        """Show where the values come from, field of view, magnification and warnings."""
        form = self.form
        self._before = self.kind, None if form is None else form.state()
        is_filled = form is not None and not form.is_empty
        origin = f"{self.origin[:1].upper()}{self.origin[1:]}."
        self.note.show_text(origin if is_filled else "")
        setup = self.complete_setup()
        shape = None
        if self._layer is not None and not getattr(self._layer, "rgb", False):
            height, width = self._layer.data.shape[-2:]
            shape = height, width
        cautions = () if setup is None else setup_cautions(setup, shape)
        self.geometry_label.show_text("" if setup is None else geometry_text(setup, shape))
        self.warning_label.show_text("\n".join(caution.text for caution in cautions))

    @qt.notify_errors
    def _save(self) -> None:
        setup = self.setup()
        if setup is None:
            raise InputError("there is no setup to save: select one first")
        if path := qt.ask_file(self, "Save setup", "setup.toml", forms.TOML):
            qt.write_text(path, tomli_w.dumps(setup.model_dump()))

    @qt.notify_errors
    def _ask_and_load(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self, "Load setup", "", forms.TOML)
        if path:
            self.load(read_toml(path), path)

    def load(self, entries: dict[str, Any], path: str) -> None:
        """Show a setup of a file, which the sizes in the image's file complete."""
        file = None if self._layer is None else about.metadata_of(self._layer).get("file")
        geometry = dict((file or {}).get("geometry", {}))
        setup = complete_setup(entries, geometry, path)
        self.show_setup(setup.model_dump(), f"loaded from {Path(path).name}")


class SourcePicker(layers.LayerPicker):
    """The undisturbed beam: a layer, or of other kinds that a window offers."""

    def __init__(self, viewer: Any, kinds: Sequence[str], tip: str) -> None:
        self._image: Any = None
        self._takes_supplied = False
        models = {**preprocessing.ESTIMATES, FILE: preprocessing.MeasuredSource}
        entries = {kind: (_SOURCE_TITLES[kind], models.get(kind)) for kind in kinds}
        super().__init__(viewer, tip, suits=self._suits_image, label="Source", entries=entries)

    @property
    def is_made(self) -> bool:
        """Whether it is made by an estimate that is not uniform."""
        return self.kind in preprocessing.ESTIMATES and self.kind != UNIFORM

    @property
    def is_estimated(self) -> bool:
        """Whether it is estimated from the shot, where a mask can exclude the object."""
        return self.is_made and preprocessing.ESTIMATES[self.kind].uses_mask

    @property
    def summary(self) -> str:
        if self.layer is not None:
            return f"layer '{self.layer.name}'"
        model: Any = self.model()
        if model is None:
            return "came with the shot" if self.kind == SUPPLIED else "fitted"
        if self.kind == FILE:
            return f"file {model.file.name}"
        return f"estimate: {model.summary}" if self.is_estimated else str(model.summary)

    def recipe_source(self) -> preprocessing.Estimate | preprocessing.MeasuredSource | None:
        """Return the source as a recipe describes it, None if it is fitted; or an `InputError`."""
        model: Any = self.model()
        if self.kind == FILE and model.file is None:
            raise InputError("no source file is selected: choose one, or choose another source")
        return model or (None if self.kind == UNKNOWN else preprocessing.MeasuredSource())

    def show(self, source: Any) -> None:
        """Show the source of a recipe; None for uniform."""
        if source is None:
            self.set_kind(UNIFORM)
        elif isinstance(source, preprocessing.MeasuredSource) and source.file is None:
            self.set_kind(SUPPLIED)
        else:
            kind = source.name() if isinstance(source, preprocessing.Estimate) else FILE
            self.restore(kind, {kind: source.values()})

    def measured(self, image: Any) -> Shot | None:
        """Return the measured source of an image layer; None for estimates and files."""
        if self.layer is not None:
            data = layers.image_of(self.layer, "source image")
            beam = source_of_shot(self.layer, data, image)
            return replace(beam, cautions=layers.cautions_of(self.layer))
        if self.kind != SUPPLIED:
            return None
        supplied = about.source_of(image)
        if supplied is None:
            raise InputError(
                f"no source was supplied with '{image.name}': choose another kind of source"
            )
        return shot_of_layer(image, supplied)

    def usable(self, source: Any, image: Any, path: Path) -> Any:
        """Return the source of a recipe for these controls; None for uniform."""
        is_supplied = image is not None and about.source_of(image) is not None
        if source is None:
            return preprocessing.MeasuredSource() if is_supplied else None
        if not isinstance(source, preprocessing.MeasuredSource) or source.file is not None:
            return source
        file = None if image is None else about.metadata_of(image).get("path")
        if source.variable is not None and file:
            return preprocessing.MeasuredSource(file=file, variable=source.variable)
        if not is_supplied:
            raise InputError(
                f"{path} uses the source in the shot's file, but this image has none: choose an "
                "image with a source"
            )
        return source

    def to_write(self, recipe: preprocessing.Recipe, image: Any) -> Shot | None:
        """Return the source if it is measured and in no file where a command finds it."""
        source = recipe.source
        if not isinstance(source, preprocessing.MeasuredSource) or source.file is not None:
            return None
        is_in_shot = self.kind == SUPPLIED and bool(about.metadata_of(image).get("path"))
        return None if is_in_shot else self.measured(image)

    def check(self, mask: BoolArray | None) -> None:
        """Refuse a mask over the object that the source layer's estimate excluded."""
        metadata = {} if self.layer is None else about.metadata_of(self.layer)
        beyond_object = metadata.get("source_mask")
        if beyond_object is not None and mask is not None and beyond_object.shape == mask.shape:
            preprocessing.check_masks(mask, beyond_object)

    def follow(self, image: Any) -> None:
        """Select the source supplied with an image, or a likely one; else the chosen one."""
        self._image, self._takes_supplied = image, True
        self.fill()

    def _remember(self, choice: Any) -> None:
        # The source supplied with a shot is not that of the next one.
        self._takes_supplied = choice == SUPPLIED
        self.chosen = UNIFORM if choice == SUPPLIED else choice

    def _preferred(self, before: Any) -> Sequence[Any]:
        """Return the image's own source, the chosen one, or else its only likely beam."""
        image, supplied, likely = self._image, None, None
        if image is not None and about.source_of(image) is not None:
            supplied = SUPPLIED
        if image is not None and self.chosen is None:
            likely = layers.likely_beam(image, self.offered)
        first = supplied if self._takes_supplied else None
        return first, self.chosen, supplied, likely, UNIFORM

    def _suits_image(self, layer: Any) -> bool:
        # An image cannot be its own source.
        return layer is not self._image and about.may_be_source(layer)


class InstrumentForm(forms.ModelForm):
    """A form of an instrument; its empty numbers show their defaults in grey."""

    defaults_vary = True

    def __init__(self) -> None:
        super().__init__(Instrument)
        self.changed.connect(self._show_defaults)
        self._show_defaults()

    def _show_defaults(self) -> None:
        """Show the defaults of the chosen detector and beam source, with their names."""
        kinds = {kind: self.entries[kind].value for kind in _INSTRUMENT_KINDS}
        usual = Instrument(**kinds)
        for name, entry in self.entries.items():
            if name in kinds:
                continue
            value = getattr(usual, name)
            unit = unit_in_title(Instrument.model_fields[name].title)
            text = _UNSTATED[name] if value is None else text_in_unit(value, unit)
            origin = next((kind for kind in kinds.values() if name in _KINDS.get(kind, ())), None)
            entry.show_default(f"{text} ({origin})" if origin else text)


class ImagePanel(ToolPanel):
    """A window with source, masks, setup, steps, instrument and options, as in a recipe."""

    command: str  # that takes the same recipe
    view: ResultView

    def make_inputs(
        self,
        sources: Sequence[str],
        source_tip: str,
        options: type[BaseModel],
        setup: SetupPicker,
        steps: Mapping[str, Any] = preprocessing.STEPS,
    ) -> None:
        """Make the controls; `settings` are those that are folded."""
        self.source = SourcePicker(self.viewer, sources, source_tip)
        tip = "Labels or shapes on bad detector pixels, which are ignored. Do not mask the object."
        self.masks = layers.MaskPicker(self.viewer, self.chosen_image, tip)
        self.mask_pickers = {"mask": self.masks}  # by their keys in a recipe
        self.setup = setup
        self.steps = forms.StepsSection(steps)
        self.instrument, self.options = InstrumentForm(), forms.ModelForm(options)
        self.recipes = RecipeButton(self)
        instrument = forms.section("Instrument", self.instrument)
        self.settings = (self.steps, instrument, forms.section("Options", self.options))

    def parts(self) -> tuple[Any, ...]:
        """Return the controls of a recipe."""
        return self.source, self.setup, self.steps, self.instrument, self.options, self.masks

    def chosen_image(self) -> Any | None:
        """Return the layer to which masks and source belong; None for files."""
        raise NotImplementedError

    def recipe(self) -> preprocessing.Recipe:
        """Return the recipe of the controls, without masks and layers; or raise an `InputError`."""
        raise NotImplementedError

    def compare(self) -> None:
        """Say so if the result shown is of other choices."""
        if self._ready:
            with suppress(InputError):  # Run reports the problem
                self.view.compare(self.recipe())

    def recipe_to_save(self) -> preprocessing.Recipe:
        return self.recipe()

    def input_recipe(self, **parts: Any) -> preprocessing.Recipe:
        """Return the recipe of the common controls and other parts."""
        return preprocessing.Recipe(
            source=self.source.recipe_source(),
            setup=self.setup.setup(),
            instrument=self._instrument(),
            **parts,
        )

    def _instrument(self) -> Instrument:
        """Return the instrument; a layer of an estimated source has the error of an estimate."""
        instrument: Any = self.instrument.model()
        source = self.source.layer
        if source is None or not about.is_estimate(source) or instrument.beam_rms is not None:
            return instrument
        return Instrument(**instrument.stated, beam_rms=ASSUMED_BEAM.rms)

    def shot_of(self, layer: Any) -> Shot:
        """Return an image with its source and mask."""
        shot = shot_of_layer(layer, layers.image_of(layer))
        return replace(shot, source=self.source.measured(layer), mask=self.masks.usable(layer))

    def describe(
        self,
        image: Any,
        recipe: preprocessing.Recipe,
        on_image: Sequence[Any],
        **rows: str,
    ) -> dict[str, Any]:
        """Return the fields of a job about its inputs, with their origins in words.

        `on_image` are its companions besides the source, or None; further `rows` of the report are
        ``name`` of the image, ``source_mask`` and the ``steps`` of a fit.
        """
        origins = {
            "Image": rows.get("name", ""),
            "Source": self.source.summary,
            "Source mask": rows.get("source_mask", ""),
            "Mask": self.masks.summary(image),
            "Setup": self.setup.summary,
            "Steps": rows.get("steps", ""),
        }
        companions = (*on_image, self.source.layer)
        return {
            "recipe": recipe,
            "origins": {title: text for title, text in origins.items() if text},
            "image": image,
            "companions": tuple(c for c in companions if c is not None and c is not image),
        }


BOTH = " and "


def fields_of(kind: str) -> forms.Kinds:
    """Return the fields that can deflect in a kind of setup, by key."""
    if kind not in SETUPS:
        return {"B": ("one field, in pixels", None)}
    choices: forms.Kinds = {each.key: (each.label, None) for each in SETUPS[kind].deflectors}
    together = BOTH.join(choices)
    choices.setdefault(together, (together, None))
    return choices
