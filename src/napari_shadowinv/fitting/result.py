"""The result of a fit: `Fit`, its `FittedField`, `Basin` and `FitReport`."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.fitting.options import FitOptions
from napari_shadowinv.fitting.verdict import Verdict
from napari_shadowinv.inversion.labels import dataset_from_field, label
from napari_shadowinv.physics.setup import Setup

if TYPE_CHECKING:
    import xarray

__all__ = ["Basin", "Fit", "FitReport", "FittedField"]

FORMAT = "shadowinv fit"

_IMAGES = ("image", "y", "x")


@dataclass(frozen=True)
class FittedField:
    """One of the fields that deflect, in the first image's pixels and at its strength.

    Attributes
    ----------
    name : str
        "B", "E", "plasma" or "phase".
    potential : ndarray, shape (H, W)
        Normalised deflection potential in px²; its mean over the image's border is 0.
    displacement : ndarray, shape (2, H, W)
        Displacement in px, axis order (y, x).
    uncertainty : ndarray, shape (2, H, W), or None
        Standard deviation of the displacement in px that the noise leaves, if it was asked for.
    smoothness : tuple of float
        The weights λ and κ of its squared fourth and sixth derivatives (px).
    """

    name: str
    potential: FloatArray
    displacement: FloatArray
    uncertainty: FloatArray | None
    smoothness: tuple[float, float]


@dataclass(frozen=True)
class Basin:
    """Where a start has led.

    Attributes
    ----------
    start : str
        Its name.
    objective : float
        Misfit and priors there, with pixels of two.
    chi2 : float
        Of all images, with pixels of two.
    distance : float
        Of its displacement from the best one's, as a share of that (r.m.s.).
    displacement : ndarray, shape (M, 2, H', W')
        Of each field, px, at every other pixel.
    """

    start: str
    objective: float
    chi2: float
    distance: float
    displacement: FloatArray


@dataclass(frozen=True)
class FitReport:
    """Report on a fit.

    Attributes
    ----------
    objective : float
        Misfit and priors at the end.
    iterations : int
        Steps at full size.
    converged : bool
        Whether they ended before the most that were allowed.
    seconds : dict of str to float
        Time of each stage.
    uncertainty : float
        R.m.s. standard deviation of the displacement as a share of it; NaN if not known.
    log_evidence : float
        Logarithm of the evidence, up to what all choices of fields have in common; NaN if it was
        not asked for.
    """

    objective: float
    iterations: int
    converged: bool
    seconds: dict[str, float]
    uncertainty: float
    log_evidence: float = float("nan")


@dataclass(frozen=True)
class Fit:
    """Fields, beam and gains that explain several images of one object.

    Attributes
    ----------
    images : ndarray, shape (L, H, W)
        The data.
    mask : ndarray of bool, shape (L, H, W)
        The pixels that were used.
    strengths : ndarray, shape (L, M)
        Displacement in each image by each field, relative to the first image.
    fields : tuple of FittedField
        The fields.
    source : ndarray, shape (L, H, W)
        The undisturbed beam of each image, its gain included.
    gains : ndarray, shape (L,)
        Factors that the images were found to be brighter by than given.
    frames : ndarray, shape (L, 6)
        Where each detector sees what lands at (y, x), px from the image's middle: at
        (f0 + f1 y + f2 x, f3 + f4 y + f5 x).
    reprojection, residual : ndarray, shape (L, H, W)
        The images as explained, and data minus that; the residual is 0 where masked.
    chi2 : ndarray, shape (L,)
        Mean of (residual / σ)² over each image.
    basins : tuple of Basin
        Where the starts have led, the best first.
    folded : float
        Share of the pixels whose rays have crossed others, in the image where it is largest.
    verdict : Verdict
        Whether the fields may be believed.
    explanation : str
        Why, in a sentence.
    report : FitReport
        Time and convergence.
    options : FitOptions
        The options used.
    setups : tuple of Setup
        The experiment of each image, if they are known.
    """

    images: FloatArray
    mask: BoolArray
    strengths: FloatArray
    fields: tuple[FittedField, ...]
    source: FloatArray
    gains: FloatArray
    frames: FloatArray
    reprojection: FloatArray
    residual: FloatArray
    chi2: FloatArray
    basins: tuple[Basin, ...]
    folded: float
    verdict: Verdict
    explanation: str
    report: FitReport
    options: FitOptions
    setups: tuple[Setup, ...] = ()

    def to_dataset(
        self,
        setups: tuple[Setup, ...] | None = None,
        *,
        attributes: Mapping[str, str] | None = None,
    ) -> xarray.Dataset:
        """Return everything as one labelled dataset, with units.

        Parameters
        ----------
        setups : tuple of Setup, optional
            The first adds fields in SI units, and coordinates in metres. Default: those of the fit.
        attributes : mapping of str to str, optional
            Further attributes.

        Returns
        -------
        xarray.Dataset
            Dimensions image, y, x and component ("y", "x"). Variables of each field end with its
            name, as in ``displacement_B``; those of the only field do not. Options, report,
            verdict and setups are in the attributes.
        """
        import xarray as xr

        known = self.setups if setups is None else setups
        setup = known[0] if known else None
        history = {
            "format": FORMAT,
            "options": self.options.model_dump_json(),
            "report": json.dumps(dataclasses.asdict(self.report)),
            "verdict": self.verdict.value,
            "explanation": self.explanation,
            "fields": json.dumps([field.name for field in self.fields]),
            "setups": json.dumps([one.model_dump(mode="json") for one in known]),
        }
        merged = xr.Dataset()
        for field in self.fields:
            one = dataset_from_field(field.displacement, field.potential, setup)
            one = one.drop_vars([name for name in one.data_vars if not _belongs(name, field.name)])
            if field.uncertainty is not None:
                told = label("px", "Standard deviation of the displacement")
                one["displacement_uncertainty"] = (
                    one["displacement"].dims,
                    field.uncertainty,
                    told,
                )
            attrs = one.attrs
            if len(self.fields) > 1:
                one = one.rename({name: f"{name}_{field.name}" for name in one.data_vars})
            merged = merged.merge(one)
            merged.attrs.update(attrs)
        merged.attrs.update(history | dict(attributes or {}))
        planes = {
            "image": (self.images, "flux/px²", "Image"),
            "source": (self.source, "flux/px²", "Undisturbed beam"),
            "reprojection": (self.reprojection, "flux/px²", "Image as explained by the fields"),
            "residual": (self.residual, "flux/px²", "Image minus re-projection"),
            "mask": (self.mask, "1", "Pixels that were used"),
        }
        lines = {
            "chi2": (self.chi2, "1", "Mean squared residual over the noise"),
            "gain": (self.gains, "1", "Factor that the image is brighter by than given"),
        }
        for name, (values, units, text) in planes.items():
            merged[f"{name}s" if name == "image" else name] = (_IMAGES, values, label(units, text))
        for name, (values, units, text) in lines.items():
            merged[name] = (("image",), values, label(units, text))
        merged["strength"] = (
            ("image", "field"),
            self.strengths,
            label("1", "Displacement relative to image 1"),
        )
        merged["field"] = ("field", [field.name for field in self.fields])
        return merged


_ASSUMES = {"path_integrated_b": "B", "path_integrated_e": "E"}


def _belongs(variable: object, field: str) -> bool:
    """Whether a variable makes sense for a field: ∫E dz of a magnetic one does not."""
    return _ASSUMES.get(str(variable), field) == field
