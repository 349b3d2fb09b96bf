"""Whether one static field explains several images: `LeaveOneOut`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Fact, Level, percent, to_figures
from napari_shadowinv.fitting.result import noise_in, normalise_residual, setups_in
from napari_shadowinv.physics.setup import Setup, beam_values
from napari_shadowinv.physics.units import FLUX_DENSITY, label, refuse_missing
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


@dataclass(frozen=True, eq=False)
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
        text = f"{', '.join(parts)}, r.m.s. {percent(self.rms[k])}: {verdict}"
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

    def added_to(self, dataset: xarray.Dataset) -> xarray.Dataset:
        """Return the dataset of a fit with this."""
        addition = self.to_dataset()
        return dataset.assign(addition.data_vars).assign_attrs(addition.attrs)

    @classmethod
    def from_dataset(cls, dataset: xarray.Dataset) -> LeaveOneOut:
        """Rebuild it from the dataset that has its variables.

        Raises
        ------
        InputError
            If one of them is missing.
        """
        variables = (variable for variable, *_ in _VARIABLES.values())
        refuse_missing(dataset, "result of leaving each image out", variables, [_SENTENCE])
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


def check_count(count: int, least: int = 3) -> None:
    """Reject with an `InputError` images that are too few for one of them to be left out."""
    if count < least:
        raise InputError(
            f"received {count} image{'s' * (count != 1)}: leaving one out needs {least} or "
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
    values = ", ".join(f"{value:.1f}" if value < 100 else f"{value:.0f}" for value in chi2[wrong])
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
