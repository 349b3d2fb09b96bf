"""The widget that finds the fields that explain several images of one object: `FitImages`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from qtpy.QtCore import QSignalBlocker

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.widgets import _forms as forms
from napari_shadowinv._napari.widgets import _layers as layers
from napari_shadowinv._napari.widgets._fields import SteadyComboBox
from napari_shadowinv._napari.widgets._fitting import FitAnswer, FitJob, FitView
from napari_shadowinv._napari.widgets._image_table import ImageRow, ImageTable, beam_column
from napari_shadowinv._napari.widgets._inputs import OptionsForm, SetupPicker
from napari_shadowinv._napari.widgets._panels import RunPanel, ToolPanel
from napari_shadowinv._napari.widgets._results import LastResults, result_frame
from napari_shadowinv._napari.widgets._steps import StepsSection
from napari_shadowinv._system.validation import validated
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting import FIELDS, FitOptions
from napari_shadowinv.physics.setup import SETUPS, Setup
from napari_shadowinv.preprocessing import Recipe

if TYPE_CHECKING:
    import napari

_UNIFORM, _LAYER, _UNKNOWN = "uniform", "layer", "unknown"
_TITLES = {
    "B": "magnetic field (B)",
    "E": "electric field (E)",
    "plasma": "plasma (phase ∝ λ²)",
    "phase": "refractive index (phase)",
}
_BOTH = " and "


class BeamPicker(forms.RowPicker):
    """The undisturbed beam: uniform, a layer, or to be fitted, too."""

    def __init__(self, viewer: Any) -> None:
        tip = "Image layer of the undisturbed beam, or a stack with one for each image."
        self.layers = layers.LayerPicker(
            viewer, ("image",), tip, "choose a layer", about.may_be_source
        )
        super().__init__(
            "Source",
            {
                _UNIFORM: ("uniform", None),
                _LAYER: ("a layer", None),
                _UNKNOWN: ("unknown: fit it, too", None),
            },
            "The beam without the object. An unknown one is fitted as a smooth beam that is the "
            "same in all images but for gains.",
            {_LAYER: forms.labelled("", self.layers)},
        )
        self.layers.picked.connect(self.changed)

    @property
    def layer(self) -> Any | None:
        """The chosen layer; None where another kind of source is chosen."""
        return self.layers.layer if self.picker.kind == _LAYER else None

    @property
    def described(self) -> str:
        if self.layer is not None:
            return f"layer '{self.layer.name}'"
        return "fitted" if self.picker.kind == _UNKNOWN else "uniform"

    def chosen(self) -> Any:
        """The source as `fit` takes it, or an `InputError`."""
        if self.picker.kind != _LAYER:
            return _UNKNOWN if self.picker.kind == _UNKNOWN else None
        if self.layer is None:
            raise InputError(
                "no source layer is selected: choose one below 'a layer', or choose another source"
            )
        stacked = self.layer.ndim == 3
        return layers.stack_of(self.layer) if stacked else layers.image_of(self.layer, "source")

    def state(self) -> str:
        """What is kept: layers belong to a session."""
        kind = self.picker.kind
        return _UNIFORM if kind == _LAYER else kind

    def restore(self, state: Any) -> None:
        self.picker.set_kind(str(state))


class ChoiceBox(SteadyComboBox):
    """A choice that is kept between sessions."""

    def __init__(self, choices: dict[str, str], tip: str) -> None:
        super().__init__()
        self._wanted: Any = None
        self.setToolTip(f"<qt>{tip}</qt>")
        self.offer(choices)
        self.activated.connect(self._on_choice)

    def offer(self, choices: dict[str, str]) -> None:
        """Replace the choices, titles by key; what was chosen stays if it is among them."""
        with QSignalBlocker(self):
            self.clear()
            for key, title in choices.items():
                self.addItem(title, key)
            self.setCurrentIndex(max(self.findData(self._wanted), 0))

    def state(self) -> str:
        return str(self.currentData())

    def restore(self, state: Any) -> None:
        """Choose a key, at once or as soon as it is offered."""
        self._wanted = state
        index = self.findData(state)
        if index >= 0:
            self.setCurrentIndex(index)

    def _on_choice(self) -> None:
        self._wanted = self.currentData()


def _warnings_of(rows: list[ImageRow]) -> list[tuple[str, str]]:
    """What the readers of the images said against them, a line each."""
    unique = {id(row.layer): row.layer for row in rows}.values()
    return [
        ("Warning", f"'{layer.name}': {text}")
        for layer in unique
        for text in layers.warnings_of(layer)
    ]


class FitImages(ToolPanel):
    """Choose images of one object at several energies, press Run."""

    def __init__(self, viewer: napari.viewer.Viewer) -> None:
        tip = "Fit the fields, and the beam if it is unknown, to all images together."
        super().__init__(viewer, "fit-images", RunPanel("Fit several images", "Run", tip))
        self._last = LastResults(viewer, self)
        self._build()
        self._connect()
        self.restore_last()
        self._on_reference()
        self._ready = True

    def _build(self) -> None:
        self.source = BeamPicker(self.viewer)
        self.images = ImageTable(self.viewer, self._may_be_image)
        self.fields = ChoiceBox({}, "What deflects. Two fields need images of two energies.")
        self.masks = layers.MaskPicker(
            self.viewer,
            self._reference_layer,
            ("labels", "shapes"),
            "Labels or shapes marking detector pixels of all images. The fit ignores masked "
            "pixels.",
        )
        self.gains = ChoiceBox(
            {"known": "known, as in the table", "free": "free: fitted"},
            "Whether it is known how much brighter than the source each image is. Those of an "
            "unknown source are always fitted.",
        )
        self.noise = ChoiceBox(
            {"": "estimated from each image", "poisson": "of counts (Poisson)"},
            "What χ² and error bars are measured by. 'Of counts': the images are numbers of "
            "particles or photons.",
        )
        self.setup = SetupPicker()
        self.steps = StepsSection()
        self.options = OptionsForm(FitOptions, {"smoothness": 1.0, "strip": 16, "threads": 1})
        self.view = FitView(self.viewer, self.panel)
        self.add(
            self.images,
            forms.labelled("Fields", self.fields),
            self.source,
            self.masks,
            forms.labelled("Gains", self.gains),
            forms.labelled("Noise", self.noise),
            self.setup,
            self.steps,
            forms.section("Options", self.options),
            self._last.keep_earlier,
            self.panel,
            self.view,
        )

    def _connect(self) -> None:
        self.images.first_changed.connect(self._on_reference)
        self.images.first_beam.connect(self._take_beam)
        self.images.changed.connect(self._show_beams)
        self.source.changed.connect(self.images.fill)
        self.setup.changed.connect(self._on_setup)
        self.gains.currentIndexChanged.connect(self._show_beams)
        for signal in (
            self.source.changed,
            self.options.changed,
            self.setup.changed,
            self.steps.changed,
            self.masks.changed,
            self.fields.currentIndexChanged,
            self.gains.currentIndexChanged,
            self.noise.currentIndexChanged,
        ):
            signal.connect(lambda *_: self.keep())

    def parts(self) -> dict[str, Any]:
        return {
            "source": self.source,
            "setup": self.setup,
            "fields": self.fields,
            "gains": self.gains,
            "noise": self.noise,
            "steps": self.steps,
            "options": self.options,
            "painted_is_unusable": self.masks,
        }

    # A run

    def request(self) -> FitJob:
        rows = self._rows()
        first = rows[0]
        setup = self.setup.setup()
        recipe = Recipe(steps=self.steps.steps(), setup=setup)
        known: dict[str, Any]
        if setup is None:
            known = {
                "strengths": [self.images.beam_value(row) for row in rows],
                "setups": None,
            }
            told = [f"displaced by {strength:g}" for strength in known["strengths"]]
        else:
            known = {"setups": [self._setup_of(row, setup) for row in rows]}
            told = [one.probe for one in known["setups"]]
        keywords = {
            **known,
            "fields": tuple(self.fields.state().split(_BOTH)),
            "source": self.source.chosen(),
            "noise": self.noise.state() or None,
            "psf": [self.images.psf(row) for row in rows],
            "mask": self.masks.usable(first.layer),
            "gains": self._chosen_gains(rows),
            "options": self.options.model(),
        }
        words = {
            "images": "; ".join(f"{row.name}: {one}" for row, one in zip(rows, told, strict=True)),
            "source_origin": self.source.described,
            "mask_origin": self.masks.described(first.layer),
            "setup_origin": self.setup.origin,
            "steps": "; ".join(step.described for step in recipe.steps),
        }
        given = [
            ("Source", self.source.described),
            ("Mask", words["mask_origin"]),
            ("Setup", self.setup.described),
            ("Steps", words["steps"]),
        ]
        chosen = (*(row.layer for row in rows), self.masks.layer, self.source.layer)
        return FitJob(
            tuple(row.data for row in rows),
            tuple(row.name for row in rows),
            keywords,
            f"{first.layer.name} fit",
            result_frame(first.layer, recipe),
            [(name, text) for name, text in (*given, *_warnings_of(rows)) if text],
            {name: text for name, text in words.items() if text},
            first.layer,
            tuple(one for one in chosen if one is not None and one is not first.layer),
            recipe,
        )

    def show_result(self, value: FitAnswer, request: FitJob) -> None:
        self.results = self.view.show_result(request, value, self._last)

    def _rows(self) -> list[ImageRow]:
        rows = self.images.used
        if len(rows) < 2:
            raise InputError(
                f"{len(rows) or 'no'} image{'s are' if not rows else ' is'} checked, expected two "
                "or more of one object: open them, or use 'Refine' of Invert shot for a single one"
            )
        shape = tuple(rows[0].data.shape)
        for row in rows[1:]:
            if tuple(row.data.shape) != shape:
                raise InputError(
                    f"'{row.name}' has shape {tuple(row.data.shape)}, '{rows[0].name}' {shape}: "
                    "all images must have the same; uncheck or crop the one that does not fit"
                )
        return rows

    def _chosen_gains(self, rows: list[ImageRow]) -> Any:
        chosen = self.gains.state()
        if chosen == "free":
            return chosen
        gains = [self.images.gain(row) for row in rows]
        return chosen if gains == [1.0] * len(rows) else gains

    def _setup_of(self, row: ImageRow, setup: Setup) -> Setup:
        """The setup of an image: its own, or else that of the first, with the beam in its row."""
        own = row.setup if row.plane is None and row != self.images.reference else None
        base = own if own is not None and own.kind == setup.kind else setup
        values = {**base.model_dump(), self.images.beam.name: self.images.beam_value(row)}
        return validated(SETUPS[setup.kind], values, f"the setup of '{row.name}'")

    # Controls that follow each other

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        # Another widget may have changed the setup of the first image.
        row = self.images.reference
        shown = self._shown_setup()
        if self._ready and row is not None and row.setup not in (None, shown):
            self.setup.suggest(row.setup, about.setup_origin_of(row.layer))

    def _reference_layer(self) -> Any | None:
        row = self.images.reference
        return None if row is None else row.layer

    def _may_be_image(self, layer: Any) -> bool:
        return about.may_be_shot(layer) and layer is not self.source.layer

    def _on_reference(self) -> None:
        """Show the setup of another first image; without one of its own it takes the last one."""
        row = self.images.reference
        before = self._shown_setup()
        self.setup.follow(None if row is None else row.layer)
        if row is not None:
            self.masks.follow(row.layer)
            base = row.setup or before
            if base is not None:
                self._take_over(row, base)
        self.view.empty()
        self._on_setup()

    def _take_over(self, row: ImageRow, base: Setup) -> None:
        values, beam = base.model_dump(), beam_column(base.kind).name
        given = row.kept().get(beam)
        if isinstance(given, float) and (row.plane is not None or row.setup is None):
            values[beam] = given
        shown = self._shown_setup()
        if shown is None or values != shown.model_dump():
            self.setup.show_setup(values)

    def _shown_setup(self) -> Setup | None:
        try:
            return self.setup.setup()
        except InputError:
            return None

    def _take_beam(self, value: float) -> None:
        """The energy of the first image is that of the setup that is shown."""
        form = self.setup.picker.form
        if form is not None:
            self.setup.show_setup({**form.values(), self.images.beam.name: value})

    def _on_setup(self) -> None:
        kind = self.setup.picker.kind
        bends = SETUPS[kind].deflectors if kind in SETUPS else (FIELDS["B"],)
        keys = [key for key, deflector in FIELDS.items() if deflector in bends]
        choices = {key: _TITLES[key] for key in keys}
        if kind not in SETUPS:
            choices = {"B": "one, in pixels"}
        elif len(keys) > 1:
            choices[_BOTH.join(keys)] = _BOTH.join(keys)
        self.fields.offer(choices)
        self._show_beams()

    def _show_beams(self) -> None:
        form = self.setup.picker.form
        beam = None if form is None else form.values().get(self.images.beam.name)
        self.images.show_beams(self.setup.picker.kind, beam, self.gains.state() == "known")
