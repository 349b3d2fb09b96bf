"""Task of a worker for a shot to fit: `FitWork`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv._typing import AnyArray, BoolArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting import Fit
from napari_shadowinv.inversion.variables import dataset_from_field
from napari_shadowinv.io.store_columns import FITS, column_values
from napari_shadowinv.options import FitChoices
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.pipeline import FitShot, run_fit
from napari_shadowinv.preprocessing import Radiograph, Recipe


@dataclass(frozen=True, eq=False)
class FitWork:
    """Task of every shot of a stack to fit."""

    recipe: Recipe
    shape: tuple[int, int]  # of the fields
    setup: Setup | None  # of each shot's first image, after the steps: it gives the units
    variables: tuple[str, ...]
    mask: BoolArray | None = None
    source_mask: BoolArray | None = None

    def invert(
        self,
        content: AnyArray | tuple[FitShot, ...],
        beam: Any,
        source: AnyArray | None = None,
        *,
        start: Fit | None = None,
        workers: int | None = None,
        should_stop: ShouldStop | None = None,
    ) -> Fit:
        """Fit a shot: an image as recorded, or several of one object; `start` is ignored."""
        if isinstance(content, tuple):
            shots: Sequence[FitShot] = content
        else:
            image = Radiograph(np.asarray(content, dtype=np.float64))
            shots = [FitShot(image, self.recipe.setup)]
        common = beam.source if source is None and beam is not None else source
        completed = [self._completed(shot, common) for shot in shots]
        fit = run_fit(self._recipe, completed, should_stop=should_stop)
        shape = fit.fields[0].potential.shape
        if shape != self.shape:
            raise InputError(f"the field has shape {shape}, expected {self.shape} as the others")
        setup = fit.setups[0] if fit.setups else None
        if setup != self.setup:
            raise InputError(
                "the setup of its first image differs from that of the other shots' first images, "
                "and a store has one: write these shots into another store"
            )
        return fit

    @property
    def _recipe(self) -> Recipe:
        """The recipe for a worker; simultaneous fits share the cores."""
        choices = self.recipe.fit or FitChoices()
        options = choices.options
        if options.threads is None:
            options = options.model_copy(update={"threads": 1})
        alone = choices.model_copy(update={"options": options})
        return self.recipe.model_copy(update={"fit": alone, "setup": None})

    def _completed(self, shot: FitShot, source: AnyArray | None) -> FitShot:
        """Complete an image with source and masks of the stack."""
        completed = {
            "source": shot.source if shot.source is not None else source,
            "mask": self.mask if shot.mask is None else shot.mask,
            "source_mask": self.source_mask if shot.source_mask is None else shot.source_mask,
        }
        return dataclasses.replace(shot, **completed)  # type: ignore[arg-type]

    def arrays(self, fit: Fit) -> dict[str, AnyArray]:
        """Return the variables by name, fields in SI units among them."""
        (field,) = fit.fields
        planes = {
            "potential": field.potential,
            "displacement": field.displacement,
            "displacement_uncertainty": field.uncertainty,
        }
        arrays: dict[str, Any] = {
            name: plane for name, plane in planes.items() if plane is not None
        }
        if set(self.variables) - planes.keys():
            in_si = dataset_from_field(field.displacement, field.potential, self.setup)
            arrays |= {str(name): in_si[name].values for name in in_si.data_vars}
        return {name: arrays[name] for name in self.variables if name in arrays}

    def report(self, fit: Fit) -> dict[str, Any]:
        """Return the report of a shot."""
        report, doubt = dataclasses.asdict(fit.report), fit.verdict_caution
        entries = {
            **column_values(FITS, fit),
            "explanation": fit.explanation,
            "chi2_images": fit.chi2.tolist(),
            "brightness": fit.brightness.tolist(),
            "strengths": fit.strengths.tolist(),
            "objective": fit.report.objective,
            "stages": report["seconds"],
            "warnings": [] if doubt is None else [dataclasses.asdict(doubt)],
        }
        provenance = fit.provenance
        if provenance is not None and any(image.file for image in provenance.images):
            entries["images"] = [
                image.model_dump(mode="json", exclude_none=True, exclude={"mask", "source_mask"})
                for image in provenance.images
            ]
        return entries
