"""Many shots with all inputs of their inversion: `Stack`, `TableStack`, `FitStack`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from napari_shadowinv._typing import AnyArray
from napari_shadowinv.inversion import count_sites
from napari_shadowinv.inversion.variables import fit_labels, variable_labels
from napari_shadowinv.io.store import OWN_SETUPS
from napari_shadowinv.options import FitChoices
from napari_shadowinv.pipeline import Inputs
from napari_shadowinv.pipeline.fit_run import usual_fields
from napari_shadowinv.preprocessing import Estimate, Radiograph, Recipe
from napari_shadowinv.stack._discovery import Shots
from napari_shadowinv.stack._fit_work import FitWork
from napari_shadowinv.stack._sources import ArrayShot, Shot, checksum
from napari_shadowinv.stack._table_shots import RowShot, RowWork
from napari_shadowinv.stack._worker import Beam, Work

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Setup

CHAINED = "each shot from an earlier one, as they arrived"


@dataclass(frozen=True, eq=False)
class Stack:
    """Shots, and everything that their inversions share."""

    shots: Shots
    inputs: Inputs  # recipe, masks, and their origin
    beam: Beam | None  # source, after all steps, and mask of all shots; None if each has its own
    sources: Shots | None  # one for each shot, if these were measured
    variables: tuple[str, ...]
    warm_start: int = 1  # shots in a group, each initialised from the one before
    reader: str = ""  # name of the reader of the files
    sites_chosen: bool = False  # whether the number of sites follows from the accuracy
    as_arrived: bool = False  # whether its shots are numbered as they arrive in a folder
    chained: bool = False  # whether each shot starts from an earlier one, without groups

    @property
    def warm_start_text(self) -> str:
        """Description of the shots that start from others."""
        return CHAINED if self.chained else str(self.warm_start)

    @property
    def recipe(self) -> Recipe:
        return self.inputs.recipe

    @property
    def chooses_sites(self) -> bool:
        """Whether the number of sites still has to be derived from the accuracy."""
        return self.beam is not None and self.recipe.options.is_adaptive

    def with_sites(self, n_sites: int) -> Stack:
        """Return the stack with the number of sites derived from the accuracy."""
        options = self.recipe.options.model_copy(update={"n_sites": n_sites})
        provenance = self.inputs.provenance
        recipe = provenance.recipe.model_copy(update={"options": options})
        inputs = replace(
            self.inputs,
            recipe=self.recipe.model_copy(update={"options": options}),
            provenance=provenance.model_copy(update={"recipe": recipe}),
        )
        return replace(self, inputs=inputs, sites_chosen=True)

    @cached_property
    def moved(self) -> Radiograph:
        """Masks and setup after the steps that move pixels; its image means nothing."""
        return self.recipe.move(self.inputs.shot)

    @property
    def shape(self) -> tuple[int, int]:
        return self.moved.shape

    @property
    def setup(self) -> Setup | None:
        return self.moved.setup

    @cached_property
    def sizes(self) -> dict[str, int]:
        height, width = self.shape
        # Sites of shots with their own beams are stored only if they do not depend on the beam.
        beam = self.beam or Beam.of(self.shape, None, self.moved.mask)
        sites = count_sites(beam.image, self.recipe.options, mask=beam.mask)
        return {"shot": len(self.shots), "y": height, "x": width, "component": 2, "site": sites}

    @property
    def labels(self) -> dict[str, tuple[tuple[str, ...], dict[str, str]]]:
        """Dimensions and labels of all variables that its shots can have."""
        return variable_labels(self.setup)

    @property
    def options_text(self) -> str:
        """The options as JSON, except those that do not affect the results."""
        options = self.recipe.options
        if self.sites_chosen:
            options = options.model_copy(update={"n_sites": None})
        return options.model_dump_json(exclude={"threads"})

    @property
    def fit_text(self) -> str:
        """The choices of a fit as JSON, except its options; empty for inversions."""
        return ""

    @property
    def setup_texts(self) -> dict[str, str]:
        """Description of the setup, for the store's identity."""
        setup = "" if self.setup is None else self.setup.model_dump_json()
        return {OWN_SETUPS: "", "setup": setup}

    @property
    def setups(self) -> list[str] | None:
        """The setup of each shot after the steps, as JSON; None unless they have their own."""
        return None

    def source_text(self, shots: int | None) -> str:
        """Describe the source of the first shots."""
        estimate = self.recipe.estimate
        if self.sources is not None:
            return f"one for each shot: {', '.join(self.sources.names[:shots])}"
        if self.beam is not None and self.beam.source is not None:
            return f"sha256 {checksum(self.beam.source)}"
        if self.beam is None and estimate is not None:
            return f"estimated from each shot: {estimate.model_dump_json()}"
        return "uniform"

    def is_shared(self, name: str) -> bool:
        """Return whether all shots share a variable."""
        return (
            self.beam is not None
            and name in ("sites", "site_mass", "source", "mask")
            and not (name == "source" and self.beam.source is None)
        )

    def source_of(self, index: int) -> Shot | None:
        """Reference to the measured source of one shot; None if it is shared, or estimated."""
        return None if self.sources is None else self.sources.items[index]

    def reordered(self, order: Sequence[int]) -> Stack:
        """Return the stack with its shots, and their sources, in another order."""
        sources = None if self.sources is None else self.sources.reordered(order)
        return replace(self, shots=self.shots.reordered(order), sources=sources)

    def work(self, variables: tuple[str, ...]) -> Work | FitWork:
        """Return the task of each shot, which computes some variables."""
        return Work(self.shots.shape, self.inputs, variables, self.sites_chosen)

    def changed(self, index: int, origin: dict[str, Any]) -> str:
        """Name the part of a shot that differs from its report; empty if none does."""
        if not self.shots.items[index].unchanged(origin):
            return self.shots.label(index)
        source = None if self.sources is None else self.source_of(index)
        if source is not None and not source.unchanged(origin["source"]):
            return f"the source of {self.shots.label(index)}"
        return ""


@dataclass(frozen=True, eq=False)
class TableStack(Stack):
    """A stack of rows of a table: shots may have their own setup, source and mask.

    The beam belongs to rows without source and mask, and is None if any has one. Nothing is shared,
    because a row that is added later may have its own; the setup of the first row sets the units.
    """

    common: AnyArray | None = None  # measured source of rows without one, as recorded
    estimate: Estimate | None = None  # the same, if it is estimated

    @property
    def setup_texts(self) -> dict[str, str]:
        return {OWN_SETUPS: "a row for each shot"}

    def source_text(self, shots: int | None) -> str:
        if self.common is not None:
            return f"sha256 {checksum(self.common)}"
        return super().source_text(shots) if self.estimate is not None else "uniform"

    def is_shared(self, name: str) -> bool:
        return False

    def source_of(self, index: int) -> Shot | None:
        if self._shot(index).row.source is not None or self.beam is not None:
            return None
        alone = None if self.common is None else ArrayShot(self.common)
        return super().source_of(index) or alone

    @property
    def setups(self) -> list[str] | None:
        if self.setup is None:
            return None
        recorded = (self._shot(index).setup for index in range(len(self.shots)))
        bare = replace(self.inputs.shot, mask=None, source_mask=None)
        moved = (self.recipe.move(replace(bare, setup=setup)).setup for setup in recorded)
        return ["" if setup is None else setup.model_dump_json() for setup in moved]

    def work(self, variables: tuple[str, ...]) -> RowWork:
        shape, chosen = self.shots.shape, self.sites_chosen
        return RowWork(shape, self.inputs, variables, chosen, self.estimate)

    def changed(self, index: int, origin: dict[str, Any]) -> str:
        difference = self._shot(index).difference(origin)
        if difference:
            return f"the row of {self.shots.label(index)} ({difference})"
        return super().changed(index, origin)

    def _shot(self, index: int) -> RowShot:
        shot = self.shots.items[index]
        assert isinstance(shot, RowShot)
        return shot


@dataclass(frozen=True, eq=False)
class FitStack(Stack):
    """A stack to fit; its beam is as recorded, because the fit applies the steps itself."""

    fit_recipe: Recipe = field(default_factory=Recipe)  # with the original setup and choices

    @property
    def chooses_sites(self) -> bool:
        return False

    @property
    def choices(self) -> FitChoices:
        return self.fit_recipe.fit or FitChoices()

    @property
    def fitted_field(self) -> str:
        """Name of the field that is fitted to each shot."""
        setups = None if self.setup is None else [self.setup]
        (name,) = self.choices.fields or usual_fields(setups)
        return name

    @cached_property
    def sizes(self) -> dict[str, int]:
        height, width = self.shape
        return {"shot": len(self.shots), "y": height, "x": width, "component": 2}

    @property
    def labels(self) -> dict[str, tuple[tuple[str, ...], dict[str, str]]]:
        return fit_labels(self.fitted_field, self.setup)

    @property
    def options_text(self) -> str:
        return self.choices.options.model_dump_json(exclude={"threads"})

    @property
    def fit_text(self) -> str:
        return self.choices.model_dump_json(exclude={"options"}, exclude_none=True)

    def is_shared(self, name: str) -> bool:
        return False

    def work(self, variables: tuple[str, ...]) -> FitWork:
        shot = self.inputs.shot
        choices = self.choices.model_copy(update={"fields": (self.fitted_field,)})
        cleared = {
            "source": self.fit_recipe.estimate,
            "mask": None,
            "source_mask": None,
            "fit": choices,
        }
        recipe = self.fit_recipe.model_copy(update=cleared)
        return FitWork(recipe, self.shape, self.setup, variables, shot.mask, shot.source_mask)
