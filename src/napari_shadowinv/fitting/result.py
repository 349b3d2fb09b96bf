"""The result of a fit: `Fit`, its `FittedField`, `Basin` and `FitReport`."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from napari_shadowinv._system.safety import as_input_errors
from napari_shadowinv._system.validation import schema_of
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.facts import (
    Assessment,
    Fact,
    Headline,
    Level,
    ResultKind,
    Summarised,
    Verdict,
    caution_facts,
    error_fact,
    folded,
    masked_fact,
    percent,
    time_fact,
    to_figures,
    verdict_fact,
)
from napari_shadowinv.fitting.instrument import number_text
from napari_shadowinv.inversion.error_bars import FIT_LINEARITY, Linearity
from napari_shadowinv.inversion.error_budget import ErrorBudget, per_pixel_of
from napari_shadowinv.inversion.variables import FIT_VARIABLES, belongs, dataset_from_field
from napari_shadowinv.options import FitOptions, Instrument
from napari_shadowinv.physics.edge import LARGER_FIELD
from napari_shadowinv.physics.setup import Setup, deflector_titles, setup_from_dict
from napari_shadowinv.physics.significance import (
    Structures,
    significance_facts,
    structures_of,
)
from napari_shadowinv.physics.units import (
    FLUX_DENSITY,
    PIXEL,
    PeakError,
    ShownField,
    label,
    numbers_of,
    peak_facts,
    refuse_missing,
    shown_fields,
)
from napari_shadowinv.provenance import ImageOrigin, Provenance

if TYPE_CHECKING:
    import xarray

_IMAGES = ("image", "y", "x")
# Variables beside those of the fields: dimensions, units, long name.
_VARIABLES: dict[str, tuple[tuple[str, ...], str, str]] = {
    "images": (_IMAGES, FLUX_DENSITY, "Image"),
    "source": (_IMAGES, FLUX_DENSITY, "Undisturbed beam"),
    "reprojection": (_IMAGES, FLUX_DENSITY, "Image as explained by the fields"),
    "residual": (_IMAGES, FLUX_DENSITY, "Image minus re-projection"),
    "mask": (_IMAGES, "1", "Pixels that were used"),
    "chi2": (("image",), "1", "Mean squared residual over the noise"),
    "brightness": (("image",), "1", "Brightness relative to the source"),
    "strength": (("image", "field"), "1", "Displacement relative to image 1"),
    "frame": (("image", "frame_term"), "1", "How the image lies on image 1"),
    "smoothness": (
        ("field", "derivative"),
        "1",
        "Weights of each field's squared fourth and sixth derivatives",
    ),
    "basin_objective": (("basin",), "1", "Misfit and priors where a start has led"),
    "basin_chi2": (("basin",), "1", "Mean squared residual over the noise of all images"),
    "basin_distance": (("basin",), "1", "Distance from the best displacement, as a share of it"),
    "basin_displacement": (
        ("basin", "field", "component", "coarse_y", "coarse_x"),
        PIXEL,
        "Displacement where a start has led, at every other pixel",
    ),
    "noise": (_IMAGES, FLUX_DENSITY, "Standard deviation of the noise"),  # or of images
}
# Those with the name of their attribute.
_OF_IMAGES = "images", "source", "reprojection", "residual", "mask", "chi2", "brightness"
_OF_BASINS = "objective", "chi2", "distance", "displacement"
_WORDS = "reason", "advice", "explanation"  # of the assessment
_BUDGET = "errors", "error_causes"
_CONTENT = "result of a fit"
_ATTRIBUTES = ("options", "instrument", "report", *_BUDGET, "verdict", *_WORDS, "folded", "setups")
_REPORT = "verdict", "errors", "error_limited_by", "error_measure_next", "residual"

# What makes a part of the errors smaller.
_MEASURE = "measure the {}, or add an image at another energy"
_REMEDIES = {
    "noise": "average shots, or take images at energies that differ more",
    "other field": "fit both fields, with images at more energies",
    "registration": "align the images by marks on each of them",
    "edge": LARGER_FIELD,
    "beam": "record a reference",
}


@dataclass(frozen=True, eq=False)
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
    errors : ErrorBudget or None
        Errors of the displacement, in all and in every pixel, if error bars were asked for.
    smoothness : tuple of float
        The weights λ and κ of its squared fourth and sixth derivatives (px).
    samples : ndarray of float32, shape (n, H, W), or None
        Random changes of the potential, px², that its total error allows, if error bars were
        asked for.
    """

    name: str
    potential: FloatArray
    displacement: FloatArray
    errors: ErrorBudget | None
    smoothness: tuple[float, float]
    samples: AnyArray | None = None


@dataclass(frozen=True, eq=False)
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
        Time of each stage; of "samples" what they take longer than "full size", beside which they
        are drawn.
    pattern : float or None
        How far the smoothed residual of an image stands out of white noise, in standard
        deviations; the largest of all images. See `pattern_strength`.
    numbers : dict of str to list
        Numbers of the instrument as fitted, by their names in `Instrument`, each with its standard
        deviation, for all images or for each; see `numbers_in_units`.
    linearity : Linearity or None
        Displacements of samples to first order against those that were fitted; None if all or none
        were.
    """

    objective: float
    iterations: int
    converged: bool
    seconds: dict[str, float]
    pattern: float | None = None
    numbers: dict[str, list[list[float]]] = dataclasses.field(default_factory=dict)
    linearity: Linearity | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Fit(Summarised):
    """Fields, beam and brightness that explain several images of one object.

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
        The undisturbed beam of each image, its brightness included.
    brightness : ndarray, shape (L,)
        How much brighter each image is than the source that was given.
    frames : ndarray, shape (L, 6)
        Position on each detector of the landing point (y, x), px from the image's middle:
        (f0 + f1 y + f2 x, f3 + f4 y + f5 x).
    reprojection, residual : ndarray, shape (L, H, W)
        The images as explained, and data minus that; the residual is 0 where masked.
    chi2 : ndarray, shape (L,)
        Mean of (residual / σ)² over each image.
    noise : ndarray, shape (L,) or (L, H, W)
        Standard deviation σ of the noise in each image, or in each pixel if it varies, then NaN
        where masked.
    basins : tuple of Basin
        Where the starts have led, the best first.
    folded : float
        Share of the pixels whose rays have crossed others, in the image where it is largest.
    assessment : Assessment
        Whether the fields may be believed, and why.
    report : FitReport
        Time and convergence.
    options : FitOptions
        The options used.
    instrument : Instrument
        How well beam, detector and alignment were stated to be known.
    setups : tuple of Setup
        The experiment of each image, if they are known.
    provenance : Provenance or None
        How it was made, if that is known: from which files, and by which recipe.
    """

    kind: ClassVar = ResultKind.FIT

    images: FloatArray
    mask: BoolArray
    strengths: FloatArray
    fields: tuple[FittedField, ...]
    source: FloatArray
    brightness: FloatArray
    frames: FloatArray
    reprojection: FloatArray
    residual: FloatArray
    chi2: FloatArray
    noise: FloatArray
    basins: tuple[Basin, ...]
    folded: float
    assessment: Assessment
    report: FitReport
    options: FitOptions
    instrument: Instrument = dataclasses.field(default_factory=Instrument)
    setups: tuple[Setup, ...] = ()
    provenance: Provenance | None = None

    @property
    def verdict(self) -> Verdict:
        """Whether the fields may be believed."""
        return self.assessment.verdict

    @property
    def explanation(self) -> str:
        """Why, in a sentence."""
        return self.assessment.explanation

    @property
    def normalised_residual(self) -> FloatArray:
        """The residual over σ, shape (L, H, W); NaN where masked."""
        is_plane = self.noise.ndim == self.residual.ndim
        noise = self.noise if is_plane else self.noise[:, None, None]
        return np.where(self.mask, self.residual / noise, np.nan)

    @property
    def used(self) -> BoolArray:
        """Pixels that at least one image uses, shape (H, W); elsewhere the fields have no data."""
        return np.asarray(self.mask.any(axis=0))

    @property
    def errors(self) -> ErrorBudget | None:
        """Error budget of the field with the largest share of errors; None if not computed."""
        budgets = [field.errors for field in self.fields if field.errors is not None]
        return max(budgets, key=lambda budget: budget.share, default=None)

    @property
    def total_error(self) -> float | None:
        """Total error as a share of the displacement (r.m.s.); None if not computed."""
        return None if self.errors is None else self.errors.share

    @property
    def limited_by(self) -> str | None:
        """Largest part of the error with its share, such as "beam 3 %"; None if not computed."""
        return None if self.errors is None else self.errors.limited_by

    @property
    def next_step(self) -> str:
        """A remedy for the largest part of the errors."""
        largest = "noise" if self.errors is None else self.errors.limiting
        return _REMEDIES.get(largest, _MEASURE).format(largest)

    def _error_facts(self) -> Iterator[Fact]:
        if self.errors is None:
            return
        is_condition = self.verdict.level is Level.CONDITIONAL
        rows = {"errors": "", "limited by": "", "measure next": ""} | dict(self.errors.rows())
        rows["measure next"] = self.explanation if is_condition else self.next_step
        if numbers := self.report.numbers:
            rows["instrument"] = "; ".join(number_text(*each) for each in numbers.items())
        yield from (error_fact(name, text) for name, text in rows.items())

    @property
    def _input_cautions(self) -> tuple[Caution, ...]:
        """Reasons to doubt the images, each with the name of its image, and the error bars."""
        of_images = tuple(
            caution.about(each.file or f"image {number}")
            for number, each in enumerate(self._origins, 1)
            for caution in each.cautions
        )
        linearity = self.report.linearity
        if linearity is None:
            return of_images
        remedy = "error bars are as rough, so measure the instrument"
        caution = linearity.caution(FIT_LINEARITY, "noise and instrument", remedy)
        return of_images if caution is None else (*of_images, caution)

    @property
    def setup(self) -> Setup | None:
        """The experiment of the first image, in which the fields are shown; None if unknown."""
        return self.setups[0] if self.setups else None

    @property
    def cautions(self) -> tuple[Caution, ...]:
        """Reasons to doubt the result: its verdict, unless it is a success, and of its images."""
        if self.verdict.level.is_success:
            return self._input_cautions
        text = f"the fit's verdict is '{self.verdict}': {self.explanation}"
        return (Caution("verdict", text), *self._input_cautions)

    @property
    def headline(self) -> Headline:
        """The peaks of the fields, the verdict and the cautions in one line."""
        peaks = [
            self.shown(field).short_peak_text(self.peak_error(field, self.setup))
            for field in self.fields
        ]
        converged = self.report.converged
        return Headline.of(peaks, self.assessment, self._input_cautions, converged=converged)

    @property
    def facts(self) -> tuple[Fact, ...]:
        """The result in words, as every face shows it."""
        return self.facts_with_names([each.file for each in self._origins])

    def facts_with_names(self, names: Sequence[str]) -> tuple[Fact, ...]:
        """Return the facts with names of the images, which may be empty."""
        numbers = ", ".join(to_figures(chi2, 3) for chi2 in self.chi2)
        fields = [fact for field in self.fields for fact in self._field_facts(field)]
        facts = (
            verdict_fact(self.verdict),
            *caution_facts(self._input_cautions),
            *self._why(),
            *fields,
            *self._error_facts(),
            Fact("residual", "Residual", f"χ² {numbers}, where 1 is expected"),
            *self._significance_facts(),
            *_image_facts(self, names),
            *_solution_facts(self),
            time_fact(self.report.seconds),
        )
        return folded(facts, (*(f"field_{field.name}" for field in self.fields), *_REPORT))

    def _why(self) -> Iterator[Fact]:
        """The explanation if it says more than the headline and the errors."""
        level = self.verdict.level
        if level is not Level.CONDITIONAL and self.explanation != self.assessment.short:
            yield Fact("why", "Why", self.explanation, level)

    def structures(self, field: FittedField) -> Structures | None:
        """Return the regions where a field stands above its error; None if that is not known."""
        std = per_pixel_of(field.errors)
        return structures_of(field.displacement, std, self.used)

    def _significance_facts(self) -> Iterator[Fact]:
        for field in self.fields:
            key, causes = f"significance_{field.name}", field.errors.causes if field.errors else ()
            structures = self.structures(field)
            yield from significance_facts(structures, causes, key=key, name=field.name)

    def peak_error(self, field: FittedField, setup: Setup | None) -> PeakError | None:
        """Return the error of the largest magnitude of a field in a setup's units, if known."""
        main = ""
        if setup is not None:
            main = setup.other_fields.get(deflector_titles()[field.name], setup.main_field).name
        errors = field.errors and field.errors.in_field(setup, main, self.instrument.energy)
        return None if errors is None else errors.of_peak

    @property
    def _origins(self) -> tuple[ImageOrigin, ...]:
        return () if self.provenance is None else self.provenance.images

    def shown(self, field: FittedField) -> ShownField:
        """Return a field in the unit that it is shown in."""
        deflector = deflector_titles()[field.name]
        (shown,) = shown_fields([field.displacement], self.setup, deflector, mask=self.used)
        return shown

    def _field_facts(self, field: FittedField) -> Iterator[Fact]:
        setup, deflector = self.setup, deflector_titles()[field.name]
        in_pixels, in_setup = (self.peak_error(field, each) for each in (None, setup))
        errors = {"error": in_pixels, "field_error": in_setup}
        peaks = peak_facts(field.displacement, setup, deflector, mask=self.used, **errors)
        for key, peak in zip(("field", "displacement"), peaks, strict=False):
            yield Fact(f"{key}_{field.name}", f"{key.capitalize()} {field.name}", peak.text)

    def to_dataset(self) -> xarray.Dataset:
        """Return everything as one labelled dataset, with units.

        The first setup adds fields in SI units, and coordinates in metres.

        Returns
        -------
        xarray.Dataset
            Dimensions image, y, x and component ("y", "x"). Variables of each field end with its
            name, as in ``displacement_B``, unless there is only one field. Options, report,
            verdict and setups are in the attributes; `from_dataset` finds all of the fit in it.
        """
        names, budgets = (
            [getattr(each, key) for each in self.fields] for key in ("name", "errors")
        )
        history = {
            "format": self.kind.value,
            "options": self.options.model_dump_json(),
            "instrument": self.instrument.model_dump_json(),
            "report": json.dumps(dataclasses.asdict(self.report)),
            "verdict": self.verdict.value,
            **{name: getattr(self.assessment, name) for name in _WORDS},
            "folded": self.folded,
            "fields": json.dumps(names),
            "errors": json.dumps([each and each.to_dict() for each in budgets]),
            "error_causes": json.dumps([each and each.causes for each in budgets]),
            "setups": json.dumps([each.model_dump(mode="json") for each in self.setups]),
        }
        merged = merge_fields(names, [field_dataset(field, self.setup) for field in self.fields])
        merged.attrs.update(history)
        merged["field"] = ("field", names)
        merged["basin"] = ("basin", [basin.start for basin in self.basins])
        arrays = {
            **{name: getattr(self, name) for name in _OF_IMAGES},
            "strength": self.strengths,
            "frame": self.frames,
            "smoothness": np.array([field.smoothness for field in self.fields]),
            **{
                f"basin_{name}": np.array([getattr(basin, name) for basin in self.basins])
                for name in _OF_BASINS
            },
            "noise": self.noise,
        }
        for name, values in arrays.items():
            dims, units, text = _VARIABLES[name]
            merged[name] = dims[: values.ndim], values, label(units, text)
        return merged if self.provenance is None else self.provenance.added_to(merged)

    @classmethod
    @as_input_errors("the fit")
    def from_dataset(cls, dataset: xarray.Dataset) -> Fit:
        """Rebuild a fit from its dataset; an `InputError` if a part is missing or wrong."""
        refuse_missing(dataset, _CONTENT, (*_VARIABLES, "field", "basin"), _ATTRIBUTES)
        arrays = {name: numbers_of(dataset, name) for name in _VARIABLES}
        attributes = dataset.attrs
        names = [str(name) for name in dataset["field"].values]
        budgets = zip(*(json.loads(attributes[key]) for key in _BUDGET), strict=True)
        fields = [
            _field(dataset, name, f"_{name}" if len(names) > 1 else "", smoothness, budget)
            for name, smoothness, budget in zip(names, arrays["smoothness"], budgets, strict=True)
        ]
        rows = zip(*(arrays[f"basin_{name}"] for name in _OF_BASINS), strict=True)
        basins = [
            Basin(str(start), float(objective), float(chi2), float(distance), displacement)
            for start, (objective, chi2, distance, displacement) in zip(
                dataset["basin"].values, rows, strict=True
            )
        ]
        return cls(
            **{name: arrays[name] for name in _OF_IMAGES},
            strengths=arrays["strength"],
            fields=tuple(fields),
            frames=arrays["frame"],
            basins=tuple(basins),
            folded=float(attributes["folded"]),
            assessment=Assessment(
                Verdict(attributes["verdict"]),
                reason=str(attributes["reason"]),
                advice=str(attributes["advice"]),
                explanation=str(attributes["explanation"]),
            ),
            report=schema_of(FitReport).validate_python(json.loads(attributes["report"])),
            options=FitOptions.model_validate_json(attributes["options"]),
            instrument=Instrument.model_validate_json(attributes["instrument"]),
            setups=_setups(dataset),
            provenance=Provenance.of(attributes, dataset.variables),
            noise=_noise(dataset),
        )


def _image_facts(fit: Fit, names: Sequence[str]) -> Iterator[Fact]:
    for k, chi2 in enumerate(fit.chi2):
        parts = [names[k]] if names and names[k] else []
        parts += [fit.setups[k].probe] if fit.setups else []
        strengths = ", ".join(f"{strength:.3g}" for strength in fit.strengths[k])
        parts += [
            f"χ² {to_figures(chi2, 3)}",
            f"strength {strengths}",
            f"brightness {fit.brightness[k]:.4g}",
        ]
        if k and fit.options.align != "none":
            dy, dx = fit.frames[k][[0, 3]]
            parts.append(f"shifted by y {dy:+.3g}, x {dx:+.3g} px")
        text = ", ".join(parts)
        yield Fact(f"image_{k + 1}", f"Image {k + 1}", text, short=f"χ² {to_figures(chi2, 3)}")


def _solution_facts(fit: Fit) -> Iterator[Fact]:
    best, *alternatives = fit.basins
    for solution in alternatives:
        excess = solution.objective / best.objective - 1
        text = (
            f"{solution.start}: objective {100 * excess:+.2g} %, displacement "
            f"{percent(solution.distance)} away"
        )
        yield Fact("alternative", "Alternative", text)
    yield from masked_fact(fit.mask)
    if fit.folded:
        yield Fact("crossed_rays", "Crossed rays", f"{percent(fit.folded)} of the pixels")
    steps = f"{fit.report.iterations} iteration{'s' * (fit.report.iterations != 1)}"
    if fit.report.converged:
        yield Fact("converged", "Converged", f"in {steps}")
    else:
        text = f"NO, not in {steps}: allow more"
        yield Fact("converged", "Converged", text, Level.FAILED)


def _setups(dataset: xarray.Dataset) -> tuple[Setup, ...]:
    """Return the setups of the images in the dataset of a fit."""
    setups = json.loads(dataset.attrs.get("setups", "[]"))
    return tuple(setup_from_dict(values, "the dataset's setups") for values in setups)


def field_dataset(field: FittedField, setup: Setup | None) -> xarray.Dataset:
    """Return a field with its errors and samples, in the units of its setup as well."""
    part = dataset_from_field(field.displacement, field.potential, setup)
    part = part.drop_vars([name for name in part.data_vars if not belongs(name, field.name)])
    optional = per_pixel_of(field.errors), field.samples
    for (name, (dims, *words)), values in zip(FIT_VARIABLES.items(), optional, strict=True):
        if values is not None:
            part[name] = dims, values, label(*words)
    return part


def merge_fields(names: Sequence[str], parts: Sequence[xarray.Dataset]) -> xarray.Dataset:
    """Return datasets of fields as one; of several, each variable ends with its field's name."""
    import xarray as xr

    merged = xr.Dataset()
    for name, part in zip(names, parts, strict=True):
        if len(names) > 1:
            part = part.rename({variable: f"{variable}_{name}" for variable in part.data_vars})
        merged = merged.assign_coords(part.coords).assign(part.data_vars)
        merged.attrs.update(part.attrs)
    return merged


def _noise(dataset: xarray.Dataset) -> FloatArray:
    """Return the noise of the images in a dataset, or of their pixels."""
    noise, shape = numbers_of(dataset, "noise"), dataset["images"].shape
    if noise.shape not in (shape, shape[:1]):
        raise ValueError(f"noise has shape {noise.shape}, expected {shape[:1]} or {shape}")
    return noise


def _field(
    dataset: xarray.Dataset,
    name: str,
    ending: str,
    smoothness: FloatArray,
    budget: tuple[Any, Any],
) -> FittedField:
    refuse_missing(dataset, _CONTENT, (f"potential{ending}", f"displacement{ending}"))
    potential, displacement = (
        numbers_of(dataset, variable + ending) for variable in ("potential", "displacement")
    )
    std, samples = (
        numbers_of(dataset, variable + ending) if variable + ending in dataset else None
        for variable in FIT_VARIABLES
    )
    if displacement.shape != (2, *potential.shape):
        raise ValueError(
            f"displacement has shape {displacement.shape}, potential {potential.shape}"
        )
    if samples is not None and samples.shape[1:] != potential.shape:
        raise ValueError(f"samples have shape {samples.shape}, potential {potential.shape}")
    weights = float(smoothness[0]), float(smoothness[1])
    errors = ErrorBudget.from_dict(*budget, std) if budget[0] else None
    return FittedField(name, potential, displacement, errors, weights, samples)
