"""Simulations of an object: the image that it casts, or a plan of an experiment with it.

- the object: a phantom, a 3-D field in a file (`GridFile`), or the field of a layer (`InputField`)
- its image: `ForwardJob`; a plan of shots of it: `PlanJob`
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.jobs import Job, name_of_result
from napari_shadowinv._napari.layers import LayerData
from napari_shadowinv._napari.shots import shot_layer
from napari_shadowinv._napari.widgets._layers import image_of, shown_plane
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Level, percent
from napari_shadowinv.io.field_grids import read_field_grid
from napari_shadowinv.options import Instrument, InversionOptions
from napari_shadowinv.physics.beam import displacement_from_potential, number_in_unit
from napari_shadowinv.physics.field_grid import FieldGrid
from napari_shadowinv.physics.forward import jacobian_determinant, synthetic_image
from napari_shadowinv.physics.particle_flight import check_particles
from napari_shadowinv.physics.phantom_models import PhantomRecipe
from napari_shadowinv.physics.projection import default_deflector, transferred_displacement
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.physics.trace_options import GridView
from napari_shadowinv.physics.tracing import trace
from napari_shadowinv.physics.units import intensity_limits
from napari_shadowinv.pipeline.experiment import plan_experiment, sweep_experiment
from napari_shadowinv.pipeline.experiment_object import (
    PlannedObject,
    object_of_displacement,
    object_of_field,
)
from napari_shadowinv.pipeline.experiment_options import ExperimentOptions
from napari_shadowinv.pipeline.experiment_result import ExperimentPlan, ExperimentSweep
from napari_shadowinv.pipeline.inversion_run import plane_of

_FIELDS = ("field", "field y", "field x")


class _File(CheckedModel):
    file: Path = Field(
        title="File",
        description="openPMD file (HDF5), or NetCDF 4 file with Bx, By, Bz or Ex, Ey, Ez; "
        "particles are traced through it.",
    )


class GridFile(GridView, _File):
    """A 3-D field in a file, and the direction from which it is seen."""

    def field(self) -> FieldGrid:
        """Read the field, in the frame of the beam."""
        return self.apply(read_field_grid(self.file))

    @property
    def title(self) -> str:
        """Name of the file without its ending."""
        return self.file.stem


@dataclass(frozen=True, eq=False)
class InputField:
    """A potential or displacement of a layer."""

    values: ArrayLike  # (H, W), or (2, H, W) in px
    to_px2: float = 1.0  # conversion factor of the potential to px²
    setup: Setup | None = None  # of its measurement, if the layer has it
    text: str = ""  # the interpretation, in a sentence
    title: str = ""

    def displacement(self) -> FloatArray:
        """Return the displacement in px."""
        values: Any = self.values
        if np.ndim(values) == 3:
            return np.asarray(values, dtype=np.float64)
        return displacement_from_potential(self.to_px2 * plane_of(values, "the potential"))


SimulatedObject = PhantomRecipe | GridFile | InputField


def is_field(layer: Any) -> bool:
    """Whether a layer is labelled as a potential, or as the field of one result."""
    if about.role_of(layer) == "potential":
        return True
    return about.role_of(layer) in _FIELDS and about.result_of(layer) is not None


def may_be_field(layer: Any) -> bool:
    """Whether a layer is a field, or an image without a label."""
    is_unlabelled = about.may_be_shot(layer) and about.result_of(layer) is None
    return is_field(layer) or (is_unlabelled and not getattr(layer, "rgb", False))


def input_field(layer: Any | None, point: Any, setup: Any) -> InputField:
    """Return the field of a layer, or of its shot in view.

    `setup` converts a potential in m whose layer has no setup.
    """
    if layer is None:
        raise InputError(
            "there is no potential or result to start from: invert a shot (Plugins → Shadowinv → "
            "Invert), open a .shadowinv file or an image of a potential in px² (File → Open), "
            "or select a simulated object"
        )
    result, title = about.result_of(layer), name_of_result(layer)
    is_masked = about.role_of(layer) == "potential" and bool(np.isnan(layer.data).any())
    if result is not None and (about.role_of(layer) in _FIELDS or is_masked):
        displacement = np.asarray(about.displacement_of(layer))
        return InputField(
            displacement, 1.0, result.setup, "The displacement of this result.", title
        )
    potential = shown_plane(layer, point) if layer.ndim == 3 else image_of(layer, "potential")
    unit, layer_setup = about.unit_of(layer), about.setup_of(layer)
    if about.role_of(layer) != "potential":
        _refuse_counts(potential, layer.name)
        text = (
            "This image is not labelled as a potential. Its values are treated as a potential in "
            "px² of the object plane."
        )
        return InputField(potential, 1.0, layer_setup, text, title)
    if unit in ("", "px²"):
        return InputField(potential, 1.0, layer_setup, "A potential in px².", title)
    field_setup = layer_setup or setup
    if field_setup is None:
        raise InputError(
            f"'{layer.name}' is in {unit}: select the setup of its experiment, which is needed "
            "to convert it to pixels"
        )
    to_px2 = float(field_setup.normalized_potential(number_in_unit(f"1 {unit}", "m")))
    return InputField(potential, to_px2, field_setup, f"A potential in {unit}.", title)


def _refuse_counts(potential: ArrayLike, name: str) -> None:
    """Refuse whole numbers from zero on, which a detector counts and no potential has."""
    values = np.asarray(potential)
    if values.any() and values.min() >= 0 and np.array_equal(values, np.round(values)):
        raise InputError(
            f"'{name}' has whole numbers from {values.min():g} to {values.max():g}, as a detector "
            "counts, expected a potential in px²: invert the image first (Plugins → Shadowinv → "
            "Invert), or choose a layer of a result"
        )


@dataclass(frozen=True, eq=False)
class Prediction:
    """The image that an object casts, with its displacement and source."""

    image: FloatArray  # in the unit of the source
    displacement: FloatArray  # px
    source: FloatArray | None  # the beam past opaque parts of the object; None if uniform
    caustic_share: float  # of the pixels: rays cross or nearly cross there
    flux_inside: float  # share of the flux that lands inside the image
    assumption: str = ""  # about the deflecting field, for another setup than the field's

    @property
    def warning(self) -> str:
        """Warnings about caustics, lost flux and assumptions; empty without any."""
        texts = [self.assumption] if self.assumption else []
        if self.caustic_share > 0:
            texts.append(
                f"Caustics: rays cross or nearly cross in {percent(self.caustic_share)} of the "
                "pixels. Once rays cross, one image no longer determines the whole field."
            )
        if self.flux_inside < 0.99:
            texts.append(f"Only {percent(self.flux_inside)} of the flux lands inside the image.")
        return " ".join(texts)


@dataclass(frozen=True, eq=False)
class ForwardJob(Job):
    """A prediction of the image of an object."""

    object: SimulatedObject
    shape: tuple[int, int] = (200, 200)  # of the image of a phantom, or of a field in a file
    setup: Setup | None = None
    deflector: str | None = None
    source: ArrayLike | None = None  # None for a uniform beam
    name: str = ""  # of the image
    frame: about.Frame = about.Frame()  # noqa: RUF009
    unit: str = ""  # of the source
    setup_origin: str = ""
    subject: Any = None  # the layer of the field, or the name of an object

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> Prediction:
        Reporter(on_progress, should_stop)("field", 0, None)
        keywords: dict[str, Any] = {"on_progress": on_progress, "should_stop": should_stop}
        if isinstance(self.object, GridFile):
            source, shadow = self._source(self.shape)
            grid = self.object.field()
            shape: Any = self.shape if source is None else np.shape(source)
            traced = trace(grid, check_particles(self.setup), shape, profile=source, **keywords)
            image, displacement = traced.image, np.nan_to_num(traced.displacement)
            flux = traced.source.sum()
            doubts = [fact.text for fact in traced.facts if fact.level is not Level.SOUND]
            assumption = " ".join(f"{text[0].upper()}{text[1:]}." for text in doubts)
        else:
            displacement, assumption = self._transfer(self._displacement())
            source, shadow = self._source(displacement.shape[1:])
            image = synthetic_image(displacement, source, **keywords)
            flux = image.size if source is None else source.sum()
        caustic = jacobian_determinant(displacement) < InversionOptions().caustic_jacobian
        if shadow is not None:
            caustic &= ~shadow
        flux_inside = float(image.sum() / flux) if flux else 1.0
        share = float(caustic.mean())
        return Prediction(image, displacement, source, share, flux_inside, assumption)

    def layers(self, content: Prediction) -> LayerData:
        origin = f"{about.CAME_WITH} the forward model, {self.setup_origin}"
        layer = shot_layer(
            content.image,
            self.name,
            self.setup,
            intensity_limits(content.image),
            frame=self.frame,
            unit=self.unit,
            source=content.source,  # for an inversion of the image
            setup_origin=origin if self.setup_origin else None,
        )
        return [layer]

    def _source(self, shape: tuple[int, ...]) -> tuple[FloatArray | None, BoolArray | None]:
        """Return the beam that passes the object, and where the object stops it."""
        source = None if self.source is None else plane_of(self.source, "the source")
        if not isinstance(self.object, PhantomRecipe):
            return source, None
        shadow = self.object.shadow(self.shape, self.setup)
        if shadow is None:
            return source, None
        return np.where(shadow, 0.0, np.ones(shape) if source is None else source), shadow

    def _transfer(self, displacement: FloatArray) -> tuple[FloatArray, str]:
        """Return the displacement in the chosen setup, and the assumption behind it."""
        field_setup, setup = getattr(self.object, "setup", None), self.setup
        if field_setup is None or setup is None or field_setup == setup:
            return displacement, ""
        deflector = self.deflector or default_deflector(field_setup, setup)
        shape: Any = None if self.source is None else np.shape(self.source)
        moved = transferred_displacement(
            displacement, field_setup, setup, deflector=deflector, shape=shape
        )
        text = f"Converted to another setup, assuming that only a {deflector} deflects the beam."
        return moved, text

    def _displacement(self) -> FloatArray:
        if isinstance(self.object, PhantomRecipe):
            return self.object.phantom(self.shape, self.setup).displacement
        assert isinstance(self.object, InputField)
        return self.object.displacement()


@dataclass(frozen=True, eq=False, kw_only=True)
class PlanJob(Job):
    """A plan of an experiment, or a sweep of one of its quantities."""

    object: SimulatedObject
    setups: tuple[Setup, ...]
    shape: tuple[int, int] | None
    instrument: Instrument
    options: ExperimentOptions
    quantity: str = ""  # none
    values: tuple[float, ...] = ()

    def run(
        self, on_progress: OnProgress, should_stop: ShouldStop
    ) -> ExperimentPlan | ExperimentSweep:
        choices = {"shape": self.shape, "instrument": self.instrument, "options": self.options}
        keywords: Any = {**choices, "on_progress": on_progress, "should_stop": should_stop}
        setups, target = self.setups or None, self._object(on_progress, should_stop)
        if self.quantity:
            return sweep_experiment(target, setups, vary={self.quantity: self.values}, **keywords)
        return plan_experiment(target, setups, **keywords)

    def _object(self, *callbacks: Any) -> PhantomRecipe | PlannedObject:
        if isinstance(self.object, PhantomRecipe):
            return self.object
        Reporter(*callbacks)("field", 0, None)
        if isinstance(self.object, GridFile):
            setup, name = next(iter(self.setups), None), self.object.file.name
            return object_of_field(self.object.field(), setup, title=name)
        field = self.object
        return object_of_displacement(field.displacement(), field.setup, title=field.title)

    def layers(self, content: ExperimentPlan | ExperimentSweep) -> LayerData:
        """Describe the image of the first draw."""
        plan = content.plans[content.best] if isinstance(content, ExperimentSweep) else content
        setup = plan.setups[0] if plan.setups else None
        image, name = plan.images[0], f"{plan.title}, planned"
        return [shot_layer(image, name, setup, intensity_limits(image), unit="counts")]
