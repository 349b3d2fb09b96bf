"""The result of an inversion, `Inversion` with a `Report`, and a field alone, `RetrievedField`.

The result in words, in the units of a setup: `InversionInUnits`.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import TypeAdapter

from napari_shadowinv._system.safety import as_input_errors
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
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
from napari_shadowinv.inversion.error_budget import Errors
from napari_shadowinv.inversion.normalise import lit_pixels
from napari_shadowinv.inversion.solution_checks import DECISIVE
from napari_shadowinv.inversion.variables import (
    CELL_VARIABLES,
    DISPLACEMENT_STD,
    VARIABLES,
    dataset_from_field,
    setup_from_dataset,
)
from napari_shadowinv.options import Instrument, InversionOptions
from napari_shadowinv.physics.edge import beyond_sides
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.physics.significance import (
    PixelErrors,
    Structures,
    significance_facts,
    structures_of,
)
from napari_shadowinv.physics.units import ShownField, label, numbers_of, peak_facts, shown_fields
from napari_shadowinv.provenance import Provenance

if TYPE_CHECKING:
    import xarray

_MOST_ADVICE = 12  # words
_REPORT = (  # keys of the rows of a report
    *("verdict", "field", "displacement", "image_residual"),
    *("errors", "error_noise", "error_limited_by", "error_measure_next"),
)


@dataclass(frozen=True)
class Report:
    """Report on an inversion.

    Attributes
    ----------
    converged : bool
        Whether the flux residual fell below the tolerance.
    iterations : int
        Solver iterations, summed over all levels.
    residual : float
        Largest relative flux error of a cell, max ``|T - S| / S``.
    tolerance : float
        The residual required for convergence.
    n_sites : int
        Number of sites.
    floor : float
        Smallest intensity allowed in the image, as a share of its mean.
    floored_pixels : int
        Pixels raised to the floor, including clipped ones.
    clipped_pixels : int
        Negative pixels set to zero.
    levels : tuple of (int, int, float)
        Sites, solver steps and final residual of each level, coarse to fine.
    seconds : dict of str to float
        Time of each stage: prepare, sites, transport, read-out, errors; of the errors what they
        take longer than the re-projection, beside which they are estimated.
    warnings : tuple of Caution
        Reasons to doubt the result.
    flux_scale : float
        Factor by which the image was divided to match the source.
    flux_left, flux_entered : dict of str to float
        With a free boundary the flux that crossed each side of the image (top, bottom, left,
        right), as a share of the source's flux in the image; else empty.
    sites_reason : str
        Reason for the number of sites.
    errors : Errors or None
        Error budget of the displacement; None if the solver did not converge.
    image_residual : float
        Difference of re-projection and image, r.m.s. over the used pixels, as a share of the
        image's mean there.
    """

    converged: bool
    iterations: int
    residual: float
    tolerance: float
    n_sites: int
    floor: float
    floored_pixels: int
    clipped_pixels: int
    levels: tuple[tuple[int, int, float], ...]
    seconds: dict[str, float]
    warnings: tuple[Caution, ...]
    flux_scale: float
    flux_left: dict[str, float]
    flux_entered: dict[str, float]
    image_residual: float
    sites_reason: str = ""
    errors: Errors | None = None


@dataclass(frozen=True, eq=False)
class Cells:
    """The power diagram of an inversion: n sites with their cells in source and image.

    Attributes
    ----------
    sites : ndarray, shape (n, 2)
        Positions of the sites, px.
    weights : ndarray, shape (n,)
        Weights of the power diagram, px².
    mass : ndarray, shape (n,)
        Flux of the source in each site's cell.
    flux : ndarray, shape (n,)
        Flux of the image in each site's power cell. It differs from `mass` by the residual,
        ``max(abs(flux / mass - 1))``.
    displacement : ndarray, shape (n, 2)
        Centroid of each site's cell in the image minus its centroid in the source, px.
    """

    sites: FloatArray
    weights: FloatArray
    mass: FloatArray
    flux: FloatArray
    displacement: FloatArray


@dataclass(frozen=True, repr=False)
class Inversion(Summarised):
    """Deflection potential of one shot, with its errors and warnings.

    Lengths are object-plane pixels; arrays are ``[y, x]``, vectors in axis order
    (y, x); a pixel's centre is at its integer index.

    Attributes
    ----------
    image : ndarray, shape (H, W)
        The image that was inverted, after clipping, scaled to the flux of the source.
    source : ndarray, shape (H, W)
        The undisturbed beam.
    potential : ndarray, shape (H, W)
        Normalised deflection potential in px²; its mean over the image's border is 0.
    displacement : ndarray, shape (2, H, W)
        Displacement of the ray through each pixel, minus the gradient of the potential,
        in px.
    cells : Cells
        Sites, weights and cells that the solver found.
    reprojection : ndarray, shape (H, W)
        The source as displaced by the retrieved field.
    residual : ndarray, shape (H, W)
        ``image - reprojection``.
    caustic : ndarray of bool, shape (H, W)
        Where the map folds or its Jacobian is below the threshold, without specks by noise.
    mask : ndarray of bool, shape (H, W)
        The pixels that were used; image, source, residual and caustic are 0 elsewhere.
    report : Report
        Convergence, timing and warnings.
    options : InversionOptions
        The options used.
    instrument : Instrument
        How well the experiment is known, which the errors hold.
    provenance : Provenance or None
        Recipe and input files, if it was made by a recipe.
    pixel_errors : PixelErrors or None
        Standard deviation of the displacement in every pixel, if `uncertainty` computed it.
    """

    kind: ClassVar = ResultKind.INVERSION

    image: FloatArray
    source: FloatArray
    potential: FloatArray
    displacement: FloatArray
    cells: Cells
    reprojection: FloatArray
    residual: FloatArray
    caustic: BoolArray
    mask: BoolArray
    report: Report
    options: InversionOptions
    instrument: Instrument = field(default_factory=Instrument)
    provenance: Provenance | None = None
    pixel_errors: PixelErrors | None = None

    def _picture(self) -> FloatArray:
        (field,) = shown_fields([self.displacement], self.setup, mask=self.lit)
        return field.magnitude

    @property
    def errors(self) -> Errors | None:
        """Error budget of the displacement; see `Report`."""
        return self.report.errors

    @property
    def total_error(self) -> float | None:
        """Total error as a share of the displacement (r.m.s.); None if not estimated."""
        return None if self.errors is None else self.errors.share

    @property
    def limited_by(self) -> str | None:
        """Largest part of the error with its share, such as "beam 23 %"; None if not estimated."""
        return None if self.errors is None else self.errors.limited_by

    @property
    def cautions(self) -> tuple[Caution, ...]:
        """Reasons to doubt the result."""
        return self.report.warnings

    @property
    def lit(self) -> BoolArray:
        """Used pixels from which rays start, (H, W): the field is that of these."""
        return lit_pixels(self.source, self.mask, self.options)

    @property
    def structures(self) -> Structures | None:
        """Regions where the displacement stands above its error; None without pixel errors."""
        element = self.displacement[0].size / len(self.cells.sites)
        errors = self.pixel_errors
        if errors is None:
            return None
        return structures_of(self.displacement, errors, self.mask, element=element)

    @property
    def setup(self) -> Setup | None:
        """Geometry of the pixels, if the provenance contains it."""
        return None if self.provenance is None else self.provenance.setup

    @property
    def verdict(self) -> Verdict:
        """Whether the field is known within the largest error of the options."""
        return self.in_units(self.setup).assessment.verdict

    @property
    def headline(self) -> Headline:
        """The peak of the main field, its limit, and the next step."""
        return self.in_units(self.setup).headline

    @property
    def facts(self) -> tuple[Fact, ...]:
        """The result in words, as every face shows it below the headline."""
        return self.in_units(self.setup).facts

    def variable(self, name: str) -> AnyArray:
        """Return the array of a variable of the dataset, one of `VARIABLES`."""
        part = CELL_VARIABLES.get(name)
        return np.asarray(getattr(self, name) if part is None else getattr(self.cells, part))

    def in_units(self, setup: Setup | None) -> InversionInUnits:
        """Return errors, assessment, headline and facts in the units of a setup.

        Parameters
        ----------
        setup : Setup or None
            Gives the main field in SI units, and the error of its energy; None the displacement in
            px.

        Returns
        -------
        InversionInUnits
        """
        return InversionInUnits(self, setup)

    def with_warnings(self, cautions: Iterable[Caution]) -> Inversion:
        """Return the same inversion with more warnings in its report.

        Parameters
        ----------
        cautions : iterable of Caution
            To be appended.
        """
        warnings = (*self.report.warnings, *cautions)
        return replace(self, report=replace(self.report, warnings=warnings))

    def to_dataset(
        self, setup: Setup | None = None, *, attributes: Mapping[str, str] | None = None
    ) -> xarray.Dataset:
        """Return everything as one labelled dataset, with units.

        Parameters
        ----------
        setup : Setup, optional
            Adds the potential and the line-integrated fields in SI units, and coordinates in
            metres. Default: the provenance's.
        attributes : mapping of str to str, optional
            Further attributes.

        Returns
        -------
        xarray.Dataset
            Dimensions y, x, component ("y", "x") and site. Each variable has ``units`` and
            ``long_name``; verdict and explanation are attributes; options, report (with the errors
            in px), setup and ``errors_si`` (the errors of the setup's main field) are JSON texts
            in the attributes.
        """
        history = {
            "format": self.kind.value,
            "options": self.options.model_dump_json(),
            "instrument": self.instrument.model_dump_json(),
            "report": json.dumps(dataclasses.asdict(self.report)),
            "image_residual": self.report.image_residual,
        }
        if self.provenance is not None:
            setup = self.setup if setup is None else setup
        if self.pixel_errors is not None:
            history["error_causes"] = json.dumps(self.pixel_errors.causes)
        in_units = self.in_units(setup)
        errors, assessment = in_units.errors, in_units.assessment
        history |= {"verdict": assessment.verdict.value, "explanation": assessment.explanation}
        if errors is not None and setup is not None:
            field = setup.main_field
            (unit,) = (si_field.unit for si_field in setup.si_fields if si_field.name == field.name)
            factor = np.abs(setup.field_in_si(field.name, np.ones((2, 1, 1)))).max()
            in_si = dataclasses.asdict(errors.times(float(factor)))
            history["errors_si"] = json.dumps({"field": field.name, "unit": unit, **in_si})
        dataset = dataset_from_field(
            self.displacement, self.potential, setup, attributes=history | dict(attributes or {})
        )
        if self.pixel_errors is not None:
            dims, *words = DISPLACEMENT_STD
            dataset["displacement_std"] = dims, self.pixel_errors.std, label(*words)
        dataset = dataset.assign(
            {
                name: (dims, self.variable(name), label(units, long_name))
                for name, (dims, units, long_name) in VARIABLES.items()
                if name not in dataset
            }
        )
        return dataset if self.provenance is None else self.provenance.added_to(dataset)

    @classmethod
    @as_input_errors("the result")
    def from_dataset(cls, dataset: xarray.Dataset) -> Inversion:
        """Rebuild an inversion from the dataset of `to_dataset`.

        Raises
        ------
        InputError
            If a variable or attribute is missing or damaged.
        """
        missing = [name for name in VARIABLES if name not in dataset.variables]
        missing += [
            name for name in ("options", "instrument", "report") if name not in dataset.attrs
        ]
        if missing:
            raise InputError(
                f"dataset has no {', '.join(map(repr, missing))}: expected the result of an "
                "inversion"
            )
        arrays: dict[str, Any] = {name: numbers_of(dataset, name) for name in VARIABLES}
        cells = Cells(**{part: arrays.pop(name) for name, part in CELL_VARIABLES.items()})
        content = json.loads(dataset.attrs["report"])
        content["warnings"] = [Caution.from_json(caution) for caution in content["warnings"]]
        return cls(
            **arrays,
            cells=cells,
            report=_report_schema().validate_python(content),
            options=InversionOptions.model_validate_json(dataset.attrs["options"]),
            instrument=Instrument.model_validate_json(dataset.attrs["instrument"]),
            provenance=Provenance.of(dataset.attrs, dataset.variables),
            pixel_errors=_pixel_errors(dataset, "displacement_std"),
        )


@dataclass(frozen=True)
class InversionInUnits:
    """An inversion in the units of a setup.

    Attributes
    ----------
    inversion : Inversion
        The result.
    setup : Setup or None
        Gives the main field in SI units, and the error of its energy; None the displacement in px.
    """

    inversion: Inversion
    setup: Setup | None

    @property
    def field(self) -> ShownField:
        """The main field, where rays start."""
        (field,) = shown_fields([self.inversion.displacement], self.setup, mask=self.inversion.lit)
        return field

    @property
    def errors(self) -> Errors | None:
        """Error budget of the main field, px of displacement; None if it was not estimated."""
        errors, setup, error = self.inversion.errors, self.setup, self.inversion.instrument.energy
        if errors is None or setup is None or not error:
            return errors
        share = error * abs(setup.sensitivity_to_beam(setup.main_field.name))
        if not share:
            return errors
        noun = setup.beam_quantity().noun
        return errors.with_scale(f"{noun}, {percent(error)}", error, share)

    @property
    def assessment(self) -> Assessment:
        """Verdict on the main field, its limit, and the next step."""
        report, max_error = self.inversion.report, self.inversion.options.max_error
        by_code = {caution.code: caution for caution in reversed(report.warnings)}
        if not report.converged:
            caution = by_code.get("not-converged")
            advice = "do not trust the field"
            return Assessment(Verdict.UNCERTAIN, "not converged", advice, caution=caution)
        errors = self.errors
        for code, (verdict, advice) in DECISIVE.items():
            if code in by_code:
                caution = by_code[code]
                reason = caution.short
                if code == "edge" and errors is not None and errors.sides:
                    reason = f"the object goes on {beyond_sides(errors.sides)}"
                return Assessment(verdict, reason, advice, caution.text, caution)
        if errors is None:
            return Assessment(Verdict.UNCERTAIN, "errors were not worked out")
        if not errors.rms > 0:
            return Assessment(Verdict.UNCERTAIN, "there is no displacement to compare errors with")
        if errors.share <= max_error:
            return Assessment(Verdict.DETERMINED, errors.limit)
        if condition := errors.condition(max_error):
            return self.field.conditional(condition)
        steps = (errors.measure_next(share) for share in (max_error, errors.share / 2))
        # That of the headline is a short one.
        advice = next((text for text in steps if len(text.split()) <= _MOST_ADVICE), "")
        return Assessment(Verdict.UNCERTAIN, errors.reason, advice)

    @property
    def headline(self) -> Headline:
        """The peak of the main field, its limit, and the next step."""
        errors = self.errors
        error = None if errors is None else errors.of_peak
        peaks, report = [self.field.short_peak_text(error)], self.inversion.report
        return Headline.of(peaks, self.assessment, report.warnings, converged=report.converged)

    @property
    def facts(self) -> tuple[Fact, ...]:
        """The result in words, as every face shows it below the headline."""
        inversion = self.inversion
        report, errors = inversion.report, self.errors
        error_of_peak = None if errors is None else errors.of_peak
        flows = {
            "flux_left": ("Flux left", report.flux_left),
            "flux_entered": ("Flux entered", report.flux_entered),
        }
        details = {
            "sites": f"{report.n_sites:,}; {report.sites_reason}".removesuffix("; "),
            "iterations": f"{report.iterations} on {len(report.levels)} levels",
            "floor": f"{report.floor:g} of the mean: {report.floored_pixels} pixels raised, "
            f"{report.clipped_pixels} clipped",
        }
        convergence = Level.SOUND if report.converged else Level.FAILED
        assessment, error_rows = self.assessment, dict(self._error_rows(errors))
        if assessment.verdict is Verdict.CONDITIONAL:
            error_rows["measure next"] = assessment.explanation
        facts = (
            verdict_fact(assessment.verdict),
            *caution_facts(report.warnings),
            *peak_facts(
                inversion.displacement, self.setup, mask=inversion.lit, error=error_of_peak
            ),
            *(error_fact(name, text) for name, text in error_rows.items()),
            Fact(
                "image_residual",
                "Image residual",
                f"{percent(report.image_residual)} of the mean (r.m.s.)",
                short=f"residual {percent(report.image_residual)}",
            ),
            *significance_facts(inversion.structures, inversion.pixel_errors),
            Fact("caustics", "Caustics", f"{percent(inversion.caustic.mean())} of the pixels"),
            *masked_fact(inversion.mask),
            *(
                Fact(
                    key,
                    title,
                    ", ".join(f"{side} {percent(share)}" for side, share in flow.items()),
                )
                for key, (title, flow) in flows.items()
                if flow
            ),
            Fact(
                "flux_residual",
                "Flux residual",
                f"{to_figures(report.residual)} of a cell, tolerance "
                f"{to_figures(report.tolerance)}: "
                f"{'converged' if report.converged else 'NOT converged'}",
                convergence,
                short="" if report.converged else "NOT converged",
            ),
            *(Fact(key, key.capitalize(), text, is_detail=True) for key, text in details.items()),
            time_fact(report.seconds),
        )
        return folded(facts, _REPORT)

    def _subject(self, errors: Errors) -> str:
        return "displacement" if errors is self.inversion.errors else "field"

    def _error_rows(self, errors: Errors | None) -> list[tuple[str, str]]:
        """Describe an error budget in words: names and texts."""
        if errors is None:
            return []
        rows = errors.rows(self._subject(errors))
        provenance, options = self.inversion.provenance, self.inversion.options
        steps = () if provenance is None else provenance.recipe.steps
        smoothing = [step.title for step in steps if step.smooths]
        is_stated = (options.noise_level, options.units_per_quantum) != (None, None)
        if smoothing and not is_stated and not errors.noise_correlation:
            caveat = (
                f"measured after {', '.join(smoothing)}, where most of it cannot be seen: its "
                "error is larger than stated; give the noise level, or units per quantum, of the "
                "recorded image"
            )
            rows.append(("noise", caveat))
        return rows


@cache
def _report_schema() -> TypeAdapter[Report]:
    return TypeAdapter(Report)


def _pixel_errors(dataset: xarray.Dataset, name: str) -> PixelErrors | None:
    if name not in dataset:
        return None
    std, shape = numbers_of(dataset, name), dataset["displacement"].shape
    if std.shape != shape:
        raise ValueError(f"{name} has shape {std.shape}, displacement {shape}")
    causes = json.loads(dataset.attrs.get("error_causes", "[]"))
    return PixelErrors(std, tuple(map(str, causes)))


_STORED_CAUSES = ("noise, instrument and beam",)


@dataclass(frozen=True, eq=False, repr=False)
class RetrievedField(Summarised):
    """A displacement of another program, of a pradformat file, or of a shot of a store.

    Attributes
    ----------
    dataset : xarray.Dataset
        With at least ``displacement`` (px), shape (2, H, W).
    """

    kind: ClassVar = ResultKind.FIELD
    cautions: ClassVar[tuple[Caution, ...]] = ()

    dataset: xarray.Dataset

    def _picture(self) -> FloatArray:
        return np.asarray(np.hypot(*self.displacement))

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
        return Provenance.of(self.dataset.attrs, self.dataset.variables)

    @property
    def headline(self) -> Headline:
        """The peak of the field."""
        return Headline(Level.SOUND, self.facts[0].text)

    @property
    def facts(self) -> tuple[Fact, ...]:
        """The peak of the field and its significance in words."""
        significance = significance_facts(self.structures, self.pixel_errors)
        return (*peak_facts(self.displacement, self.setup), *significance)

    @property
    def pixel_errors(self) -> PixelErrors | None:
        """Standard deviation of the displacement in every pixel, if the dataset contains it."""
        errors = _pixel_errors(self.dataset, "displacement_uncertainty")
        return errors and replace(errors, causes=_STORED_CAUSES)

    @property
    def structures(self) -> Structures | None:
        """Regions where the displacement stands above its error; None without pixel errors."""
        errors = self.pixel_errors
        return None if errors is None else structures_of(self.displacement, errors)

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
