"""Results that show whether the object changed between images.

- fits of neighbouring images one after another, a movie of the field: `FitWindows`
- whether one static field explains several images: `LeaveOneOut`
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Fact, Level, Verdict, to_figures
from napari_shadowinv.fitting.result import (
    Fit,
    field_dataset,
    merge_fields,
    noise_in,
    normalise_residual,
    setups_in,
)
from napari_shadowinv.physics.beam import BeamQuantity
from napari_shadowinv.physics.setup import Setup, beam_values, deflector_titles
from napari_shadowinv.physics.units import FLUX_DENSITY, PIXEL, label, shown_fields
from napari_shadowinv.provenance import Provenance

if TYPE_CHECKING:
    import xarray

_IMAGE, _PLANES = ("image",), ("image", "y", "x")
_NOISE = "left_out_noise"
# Attribute: variable, dimensions, units, long name.
_VARIABLES: dict[str, tuple[str, tuple[str, ...], str, str]] = {
    "images": ("images", _PLANES, FLUX_DENSITY, "Image"),
    "mask": ("mask", _PLANES, "1", "Pixels that were used"),
    "predicted": ("left_out_prediction", _PLANES, FLUX_DENSITY, "Image as the others predict it"),
    "residual": ("left_out_residual", _PLANES, FLUX_DENSITY, "Image minus prediction"),
    "brightness": ("left_out_brightness", _IMAGE, "1", "Brightness relative to the expected one"),
    "chi2": ("left_out_chi2", _IMAGE, "1", "Mean squared residual over the noise"),
    "alone": ("left_out_alone", _IMAGE, "1", "The same with a field of the image's own"),
    "limit": ("left_out_limit", _IMAGE, "1", "Largest χ² that one static field would give"),
    "rms": ("left_out_rms", _IMAGE, "1", "R.m.s. residual over the image's mean"),
    "noise": (_NOISE, _PLANES, FLUX_DENSITY, "Standard deviation of the noise"),  # or of images
}
_SENTENCE = "left_out"
_LARGE = 100.0
_LEAST_IMAGES = 3


@dataclass(frozen=True)
class LeaveOneOut:
    """Several images, each predicted from a fit of the others.

    Attributes
    ----------
    images : ndarray, shape (L, H, W)
        The data.
    mask : ndarray of bool, shape (L, H, W)
        The pixels that were used.
    predicted, residual : ndarray, shape (L, H, W)
        Prediction by the other images, and data minus prediction, 0 where masked.
    brightness : ndarray, shape (L,)
        How much brighter each image is than the source that was given; fitted to the prediction.
    chi2 : ndarray, shape (L,)
        Mean of (residual / σ)² over each image.
    alone : ndarray, shape (L,)
        The same if the image is fitted alone: due to noise, source, point spread.
    limit : ndarray, shape (L,)
        The largest χ² that one static field would give: 1.15 times the χ² of the noise, which
        follows from `alone`, plus five times the variance of the prediction.
    rms : ndarray, shape (L,)
        R.m.s. residual, relative to the image's mean.
    explanation : str
        Which images one static field does not explain, in a sentence.
    setups : tuple of Setup
        The experiment of each image, if they are known.
    names : tuple of str
        The names of the images, if they have any.
    noise : ndarray, shape (L,) or (L, H, W)
        Standard deviation σ of the noise, as in `Fit`.
    """

    images: FloatArray
    mask: BoolArray
    predicted: FloatArray
    residual: FloatArray
    brightness: FloatArray
    chi2: FloatArray
    alone: FloatArray
    limit: FloatArray
    rms: FloatArray
    noise: FloatArray
    explanation: str
    setups: tuple[Setup, ...] = ()
    names: tuple[str, ...] = ()

    @property
    def normalised_residual(self) -> FloatArray:
        """The residual over σ, shape (L, H, W); NaN where masked."""
        return normalise_residual(self.residual, self.mask, self.noise)

    @property
    def explained(self) -> BoolArray:
        """Whether the field of the others explains each image, shape (L,)."""
        return np.asarray(self.chi2 <= self.limit)

    def only(self, numbers: Sequence[int]) -> LeaveOneOut:
        """Return some of the images, in this order."""
        chosen = list(numbers)
        return replace(
            self,
            **{name: getattr(self, name)[chosen] for name in _VARIABLES},
            setups=tuple(self.setups[k] for k in chosen if self.setups),
            names=tuple(self.names[k] for k in chosen if self.names),
        )

    @property
    def facts(self) -> tuple[Fact, ...]:
        """The result in words: the sentence, then each image."""
        is_static = bool(self.explained.all())
        title, level = ("Left out", Level.SOUND) if is_static else ("Warning", Level.DOUBTFUL)
        sentence = Fact("left_out", title, self.explanation, level)
        return (sentence, *(self._image_fact(k) for k in range(len(self.chi2))))

    def _image_fact(self, k: int) -> Fact:
        is_explained = bool(self.explained[k])
        verdict = "explained" if is_explained else "not explained"
        chi2 = f"χ² {to_figures(self.chi2[k], 3)}"
        parts = [self.names[k]] if self.names else []
        parts += [self.setups[k].probe] if self.setups else []
        parts += [
            chi2,
            f"alone {to_figures(self.alone[k], 3)}",
            f"limit {to_figures(self.limit[k], 3)}",
        ]
        text = f"{', '.join(parts)}, r.m.s. {self.rms[k]:.2%}: {verdict}"
        level = Level.SOUND if is_explained else Level.DOUBTFUL
        short = chi2 if is_explained else f"{chi2}, {verdict}"
        return Fact(f"left_out_{k + 1}", f"Left out {k + 1}", text, level, short=short)

    def to_dataset(self) -> xarray.Dataset:
        """Return everything as one labelled dataset, whose variables can join a fit's."""
        import xarray as xr

        variables: dict[str, Any] = {
            variable: (dims[: getattr(self, name).ndim], getattr(self, name), label(units, text))
            for name, (variable, dims, units, text) in _VARIABLES.items()
        }
        return xr.Dataset(variables, attrs={_SENTENCE: self.explanation})

    @classmethod
    def from_dataset(cls, dataset: xarray.Dataset) -> LeaveOneOut:
        """Rebuild it from the dataset that has its variables.

        Raises
        ------
        InputError
            If one of them is missing.
        """
        missing = [variable for variable, *_ in _VARIABLES.values() if variable not in dataset]
        if missing or _SENTENCE not in dataset.attrs:
            raise InputError(
                f"dataset has no {', '.join(missing) or _SENTENCE}: expected the result of leaving "
                "each image out in turn"
            )
        arrays: dict[str, AnyArray] = {
            name: np.ascontiguousarray(dataset[variable].values)
            for name, (variable, *_) in _VARIABLES.items()
        }
        arrays["noise"] = noise_in(dataset, _NOISE)
        provenance = Provenance.of(dataset.attrs)
        names = () if provenance is None else tuple(each.file for each in provenance.images)
        return cls(
            **arrays,
            explanation=str(dataset.attrs[_SENTENCE]),
            setups=setups_in(dataset),
            names=names if all(names) else (),
        )


def check_count(count: int) -> None:
    """Reject with an `InputError` images that are too few for one of them to be left out."""
    if count < _LEAST_IMAGES:
        raise InputError(
            f"received {count} image{'s' * (count != 1)}: leaving one out needs {_LEAST_IMAGES} or "
            "more, so that two or more predict it"
        )


def explanation_of(
    chi2: FloatArray, limit: FloatArray, setups: Sequence[Setup] | None, names: Sequence[str] | None
) -> str:
    """Say which images one static field does not explain, in a sentence.

    Parameters
    ----------
    chi2, limit : ndarray, shape (L,)
        χ² of the prediction of each image, and its upper limit.
    setups : sequence of Setup or None
        Their energies name the images.
    names : sequence of str or None
        Names of the images in messages. Default: their numbers.
    """
    wrong = np.flatnonzero(chi2 > limit)
    if not len(wrong):
        return (
            f"one static field explains all {len(chi2)} images: each is predicted by the others "
            f"(χ² {chi2.min():.2f} to {chi2.max():.2f})"
        )
    values = ", ".join(
        f"{value:.1f}" if value < _LARGE else f"{value:.0f}" for value in chi2[wrong]
    )
    images = f"image{'s' * (len(wrong) > 1)} {_called(wrong, setups, names)}"
    if len(wrong) < len(chi2) / 2:
        verb = "are" if len(wrong) > 1 else "is"
        disagreement = (
            f"the {images} {verb} not explained by one static field with the others (χ² {values})"
        )
    else:
        disagreement = (
            f"no static field explains more than {max(len(chi2) - len(wrong), 1)} of "
            f"{len(chi2)} images: the {images} differ (χ² {values})"
        )
    return (
        f"{disagreement}: the object may have changed between images, or an energy, the source or "
        "the point spread is wrong"
    )


def _called(wrong: AnyArray, setups: Sequence[Setup] | None, names: Sequence[str] | None) -> str:
    beams = beam_values(setups or ())
    if beams is not None:
        quantity, values = beams
        text = quantity.text(*(values[k] for k in wrong), digits=6)
        return f"at {' and '.join(text.rsplit(', ', 1))}"
    *most, last = [names[k] if names else str(k + 1) for k in wrong]
    return f"{', '.join(most)} and {last}" if most else last


PREFIX = "window_"
"""What the variables begin with in the dataset of a fit."""


def window_facts(dataset: xarray.Dataset) -> tuple[Fact, ...]:
    """Return the windows in the dataset of a fit in words; none if it has none.

    Parameters
    ----------
    dataset : xarray.Dataset
        As from `FitWindows.added_to`.
    """
    if f"{PREFIX}chi2" not in dataset:
        return ()
    names = [name for name in dataset.variables if str(name).startswith(PREFIX)]
    windows = dataset[names].rename({name: str(name).removeprefix(PREFIX) for name in names})
    numbers = windows["image_number"].values - 1
    used = np.array([dataset["mask"].values[group].any(axis=0) for group in numbers])
    setups = setups_in(dataset)
    beams = beam_values(setups)
    return _describe_windows(
        windows,
        [str(name) for name in dataset["field"].values],
        used,
        setups[numbers[0][0]] if setups else None,
        None if beams is None else beams[0],
    )


def _describe_windows(
    windows: xarray.Dataset,
    fields: Sequence[str],
    used: BoolArray,
    setup: Setup | None,
    quantity: BeamQuantity | None,
) -> tuple[Fact, ...]:
    """A fact for each group: its images, energy, time, χ², the peaks of its fields, its verdict."""
    peaks = {}
    for name in fields:
        planes = windows[f"displacement_{name}" if len(fields) > 1 else "displacement"].values
        unmasked = list(np.where(used[:, None], planes, np.nan))
        shown = shown_fields(unmasked, setup, deflector_titles()[name])
        peaks[name] = [field.peak_text() for field in shown]
    facts = []
    for w, verdict in enumerate(map(str, windows["verdict"].values)):
        window = windows.isel(window=w)
        parts = [image_numbers(window["image_number"].values - 1)]
        if quantity is not None and quantity.name in window:
            parts.append(f"mean {quantity.noun} {quantity.text(float(window[quantity.name]))}")
        if "time_of_flight" in window:
            parts.append(f"time of flight {float(window['time_of_flight']) * 1e12:.4g} ps")
        parts.append(f"χ² {', '.join(to_figures(value, 3) for value in window['chi2'].values)}")
        parts += [f"{name} {texts[w]}" for name, texts in peaks.items()]
        level = Level.SOUND if verdict == Verdict.DETERMINED else Level.DOUBTFUL
        text = f"{', '.join(parts)}: {verdict}"
        facts.append(Fact(f"window_{w + 1}", f"Window {w + 1}", text, level, short=verdict))
    return tuple(facts)


def image_numbers(indices: Sequence[int] | AnyArray) -> str:
    """Return the numbers of images, counted from 1, such as "images 2, 3"."""
    return f"image{'s' * (len(indices) > 1)} {', '.join(str(k + 1) for k in indices)}"


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
    def facts(self) -> tuple[Fact, ...]:
        """The result in words: each group with the peaks of its fields and its verdict."""
        return _describe_windows(
            self.to_dataset(),
            [field.name for field in self.fits[0].fields],
            np.stack([fit.used for fit in self.fits]),
            self.setup,
            self.beam_quantity,
        )

    @property
    def setup(self) -> Setup | None:
        """The experiment of the image to which all displacements belong; None if not known."""
        return self.fits[0].setup

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
        parts = [
            xr.concat([self._of(w, m) for w in range(len(self.fits))], dim="window")
            for m in range(len(names))
        ]
        merged = merge_fields(names, parts)
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
        errors = fitted.uncertainty
        in_first = replace(
            fitted,
            displacement=fitted.displacement / strength,
            potential=fitted.potential / strength,
            uncertainty=None if errors is None else errors / abs(strength),
            beam_uncertainty=None,
            samples=None,
        )
        part = field_dataset(in_first, self.setup)
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
