"""Fits of neighbouring images one after another, a film of the field: `FitWindows`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting.result import Fit
from napari_shadowinv.inversion.variables import UNCERTAINTY, belongs, dataset_from_field
from napari_shadowinv.physics.labels import PIXEL, label
from napari_shadowinv.physics.setup import BeamQuantity, Setup, beam_values

if TYPE_CHECKING:
    import xarray

__all__ = ["PREFIX", "FitWindows"]

PREFIX = "window_"
"""What the variables begin with in the dataset of a fit."""


@dataclass(frozen=True)
class FitWindows:
    """Groups of neighbouring images, in order of energy, each with the field that explains it.

    Attributes
    ----------
    numbers : tuple of tuple of int
        Indices of the images of each group.
    fits : tuple of Fit
        The fit of each group, in pixels of its first image.
    strengths : ndarray, shape (W, M)
        Displacement of each group's first image by each field, relative to the first image of all.
    """

    numbers: tuple[tuple[int, ...], ...]
    fits: tuple[Fit, ...]
    strengths: FloatArray

    @property
    def setup(self) -> Setup | None:
        """The experiment of the image to which all displacements belong; None if not known."""
        first = self.fits[0]
        return first.setups[0] if first.setups else None

    @property
    def displacement(self) -> FloatArray:
        """Displacement in px by each field in the first of all images, shape (W, M, 2, H, W)."""
        displacements = [[field.displacement for field in fit.fields] for fit in self.fits]
        return np.array(displacements) / self.strengths[:, :, None, None, None]

    @property
    def beam_quantity(self) -> BeamQuantity | None:
        """Quantity that differs between the images' beams, such as the energy; None if unknown."""
        beams = beam_values([setup for fit in self.fits for setup in fit.setups])
        return None if beams is None else beams[0]

    @property
    def beam_means(self) -> FloatArray | None:
        """Mean of the beams' quantity in each group, shape (W,); None if unknown."""
        groups = [beam_values(fit.setups) for fit in self.fits]
        if self.beam_quantity is None or None in groups:
            return None
        return np.array([np.mean(group[1]) for group in groups if group is not None])

    @property
    def times_of_flight(self) -> FloatArray | None:
        """Time in s from the source to the object at each mean energy; None if unknown."""
        quantity, means = self.beam_quantity, self.beam_means
        if quantity is None or means is None:
            return None
        setups = [
            fit.setups[0].model_copy(update={quantity.name: float(mean)})
            for fit, mean in zip(self.fits, means, strict=True)
        ]
        times = np.array([getattr(setup, "time_of_flight", np.inf) for setup in setups])
        return times if np.isfinite(times).all() else None

    def to_dataset(self) -> xarray.Dataset:
        """Return fields, χ² and verdicts as one labelled dataset, with units.

        Returns
        -------
        xarray.Dataset
            Dimensions window, component, y and x, and member for the images of a group. Fields are
            those that displace the first of all images; variables of each end with its name, as in
            ``displacement_B``, unless there is only one field. Coordinates along the windows are
            the mean strength and, where they are known, the mean energy or wavelength and the time
            of flight.
        """
        import xarray as xr

        names = [field.name for field in self.fits[0].fields]
        merged = xr.Dataset()
        for m, name in enumerate(names):
            part = xr.concat([self._of(w, m) for w in range(len(self.fits))], dim="window")
            if len(names) > 1:
                part = part.rename({variable: f"{variable}_{name}" for variable in part.data_vars})
            merged = merged.assign_coords(part.coords).assign(part.data_vars)
            merged.attrs.update(part.attrs)
        members = ("window", "member")
        merged["image_number"] = members, np.array(self.numbers) + 1, label("1", "Image")
        chi2 = np.array([fit.chi2 for fit in self.fits])
        merged["chi2"] = members, chi2, label("1", "Mean squared residual over the noise")
        merged["verdict"] = "window", [str(fit.verdict) for fit in self.fits]
        merged["explanation"] = "window", [fit.explanation for fit in self.fits]
        return merged.assign_coords(self._coordinates())

    def added_to(self, dataset: xarray.Dataset) -> xarray.Dataset:
        """Return the dataset of a fit with these, their names beginning with ``window_``."""
        windows = self.to_dataset()
        names = {*windows.data_vars, *self._coordinates()}
        renamed = windows.rename({name: f"{PREFIX}{name}" for name in names})
        return dataset.assign_coords(renamed.coords).assign(renamed.data_vars)

    def _of(self, window: int, field: int) -> xarray.Dataset:
        """A field of a group."""
        fitted, strength = self.fits[window].fields[field], self.strengths[window, field]
        part = dataset_from_field(
            fitted.displacement / strength, fitted.potential / strength, self.setup
        )
        part = part.drop_vars([name for name in part.data_vars if not belongs(name, fitted.name)])
        if fitted.uncertainty is not None:
            vectors, *words = UNCERTAINTY
            part["displacement_uncertainty"] = (
                vectors,
                fitted.uncertainty / abs(strength),
                label(*words),
            )
        for variable in part.data_vars.values():
            if PIXEL in variable.attrs["units"]:
                variable.attrs["long_name"] += ", in the image displaced most"
        return part

    def _coordinates(self) -> Mapping[str, Any]:
        means = [
            (fit.strengths[:, 0] * strength).mean()
            for fit, strength in zip(self.fits, self.strengths[:, 0], strict=True)
        ]
        coordinates: dict[str, tuple[Sequence[float] | FloatArray | None, str, str]] = {
            "strength": (means, "1", "Mean displacement relative to the first image"),
            "time_of_flight": (self.times_of_flight, "s", "Time of flight from source to object"),
        }
        if (quantity := self.beam_quantity) is not None:
            mean = f"Mean {quantity.noun}"
            coordinates[quantity.name] = self.beam_means, quantity.unit, mean
        return {
            name: ("window", np.array(values), label(unit, text))
            for name, (values, unit, text) in coordinates.items()
            if values is not None
        }
