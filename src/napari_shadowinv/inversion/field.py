"""A field without the images it was retrieved from: `RetrievedField`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Fact, Headline, Level, ResultKind
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.physics.units import peak_facts
from napari_shadowinv.provenance import Provenance

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.setup import Setup

__all__ = ["RetrievedField"]


@dataclass(frozen=True, eq=False)
class RetrievedField:
    """A displacement of another program, of a pradformat file, or of a shot of a store.

    Attributes
    ----------
    dataset : xarray.Dataset
        With at least ``displacement`` (px), shape (2, H, W).
    """

    kind: ClassVar = ResultKind.FIELD
    cautions: ClassVar[tuple[Caution, ...]] = ()

    dataset: xarray.Dataset

    @property
    def displacement(self) -> FloatArray:
        """Displacement of the ray through each pixel in px, shape (2, H, W)."""
        return np.asarray(self.dataset["displacement"].values)

    @property
    def setup(self) -> Setup | None:
        """The experiment, if the dataset contains it."""
        return setup_from_dataset(self.dataset)

    @property
    def provenance(self) -> Provenance | None:
        """Provenance of the shot, if the dataset contains it."""
        return Provenance.of(self.dataset.attrs)

    @property
    def headline(self) -> Headline:
        """The peak of the field."""
        return Headline(Level.SOUND, self.facts[0].text)

    @property
    def facts(self) -> tuple[Fact, ...]:
        """The peak of the field in words."""
        return tuple(peak_facts(self.displacement, self.setup))

    def to_dataset(self, *, attributes: Mapping[str, str] | None = None) -> xarray.Dataset:
        """Return the dataset with further attributes."""
        return self.dataset.assign_attrs(attributes or {})

    @classmethod
    def from_dataset(cls, dataset: xarray.Dataset) -> RetrievedField:
        """Return the field of a dataset; an `InputError` if it has no displacement."""
        if "displacement" not in dataset:
            raise InputError(
                "dataset has no 'displacement': expected a field of shape (2, height, width) in px"
            )
        return cls(dataset)
