"""The image that an object casts in an experiment: `predict`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.facts import Level, percent
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.field_grid import FieldGrid
from napari_shadowinv.physics.forward import jacobian_determinant, synthetic_image
from napari_shadowinv.physics.particle_flight import check_particles
from napari_shadowinv.physics.phantom_models import PhantomRecipe
from napari_shadowinv.physics.projection import transferred_displacement
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.physics.trace_options import TraceOptions
from napari_shadowinv.physics.tracing import TracedImage, trace
from napari_shadowinv.pipeline.experiment_object import PlannedObject


@dataclass(frozen=True, eq=False)
class Prediction:
    """The image that an object casts, with its displacement, setup and source."""

    image: FloatArray  # in the unit of the source
    displacement: FloatArray  # px
    setup: Setup | None
    source: FloatArray | None  # the beam past opaque parts of the object; None if uniform
    inside: float  # share of the flux that lands inside the image
    warning: str = ""  # about caustics, lost flux and assumptions
    traced: TracedImage | None = None  # of a 3-D field


def predict(
    target: PhantomRecipe | FieldGrid | PlannedObject,
    setup: Setup | None,
    shape: tuple[int, int],
    *,
    source: FloatArray | None = None,
    deflector: str | None = None,
    options: TraceOptions | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> Prediction:
    """Return the image of a phantom, of a 3-D field, or of the displacement of a result.

    Its (height, width) is the `shape`, or that of the source or the displacement. A `deflector`,
    such as an "electric field", converts a displacement to another setup than its own; in its own,
    it has its own source by default.
    """
    shadow, traced, warnings = None, None, []
    if isinstance(target, FieldGrid):
        particles = check_particles(setup)
        size = shape if source is None else np.shape(source)
        traced = trace(
            target,
            particles,
            (size[0], size[1]),
            options=options,
            profile=source,
            on_progress=on_progress,
            should_stop=should_stop,
        )
        image, displacement = traced.image, np.nan_to_num(traced.displacement)
        flux = traced.source.sum()
        doubts = [fact.text for fact in traced.facts if fact.level is not Level.SOUND]
        warnings += [f"{text[0].upper()}{text[1:]}." for text in doubts]
    else:
        if isinstance(target, PlannedObject):
            setup = setup or target.setup
            if source is None and target.setup == setup:
                source = target.source
            displacement, warnings = _transfer(target, setup, source, deflector)
        else:
            displacement = target.phantom(shape, setup).displacement
            shadow = target.shadow(shape, setup)
        if shadow is not None:
            source = np.where(shadow, 0.0, 1.0 if source is None else source)
        image = synthetic_image(
            displacement, source, on_progress=on_progress, should_stop=should_stop
        )
        flux = image.size if source is None else source.sum()
    caustic = jacobian_determinant(displacement) < InversionOptions().caustic_jacobian
    share = float((caustic if shadow is None else caustic & ~shadow).mean())
    if share > 0:
        warnings.append(
            f"Caustics: rays cross or nearly cross in {percent(share)} of the pixels. Once "
            "rays cross, one image no longer determines the whole field."
        )
    inside = float(image.sum() / flux) if flux else 1.0
    if inside < 0.99:
        warnings.append(f"Only {percent(inside)} of the flux lands inside the image.")
    return Prediction(image, displacement, setup, source, inside, " ".join(warnings), traced)


def _transfer(
    field: PlannedObject, setup: Setup | None, source: FloatArray | None, deflector: str | None
) -> tuple[FloatArray, list[str]]:
    """Return the displacement in a setup, and the assumption behind it."""
    if field.setup is None or setup is None or field.setup == setup:
        return field.samples, []
    cause = deflector or field.cause(setup)
    shape = None if source is None else (source.shape[0], source.shape[1])
    moved = transferred_displacement(
        field.samples, field.setup, setup, deflector=cause, shape=shape
    )
    return moved, [
        f"Converted to another setup, assuming that the {cause} alone deflects the beam."
    ]
