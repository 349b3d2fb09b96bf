"""The result of an inversion, `Inversion` with a `Report`, and a field alone, `RetrievedField`."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._system.safety import as_input_errors
from napari_shadowinv._system.validation import schema_of
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
    assess,
    caution_facts,
    error_fact,
    folded,
    masked_fact,
    percent,
    time_fact,
    to_figures,
    verdict_fact,
)
from napari_shadowinv.instrument.effects import RecordedShot
from napari_shadowinv.inversion.error_bars import Quantities
from napari_shadowinv.inversion.error_budget import ErrorBudget, per_pixel_of, share_of
from napari_shadowinv.inversion.normalise import gaps_in, lit_pixels
from napari_shadowinv.inversion.solution_checks import DECISIVE
from napari_shadowinv.inversion.variables import (
    DISPLACEMENT_STD,
    VARIABLES,
    dataset_from_field,
    setup_from_dataset,
)
from napari_shadowinv.options import Instrument, InversionOptions
from napari_shadowinv.physics.edge import beyond_sides
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.physics.significance import (
    Structures,
    significance_facts,
    structures_of,
)
from napari_shadowinv.physics.units import (
    ShownField,
    label,
    numbers_of,
    peak_facts,
    refuse_missing,
    shown_fields,
)
from napari_shadowinv.provenance import Provenance
from napari_shadowinv.transport.sites import are_middles

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
    cautions : tuple of Caution
        Reasons to doubt the result.
    flux_scale : float
        Factor by which the image was divided to match the source.
    flux_left, flux_entered : dict of str to float
        With a free boundary the flux that crossed each side of the image (top, bottom, left,
        right), as a share of the source's flux in the image; else empty.
    sites_reason : str
        Reason for the number of sites.
    measured : bool
        Whether the source was recorded; else it is an estimate.
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
    cautions: tuple[Caution, ...]
    flux_scale: float
    flux_left: dict[str, float]
    flux_entered: dict[str, float]
    image_residual: float
    sites_reason: str = ""
    measured: bool = True


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

    @property
    def are_pixels(self) -> bool:
        """Whether each cell of the source is a pixel.

        Then the image has slopes inside its pixels, and the displacement is that at their centres;
        else a pixel's brightness is constant, and the displacement is read over two pixels.
        """
        return are_middles(self.sites)


@dataclass(frozen=True, eq=False, repr=False)
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
        Convergence, timing and cautions.
    options : InversionOptions
        The options used.
    instrument : Instrument
        How well the experiment is known, which the errors hold.
    setup : Setup or None
        The experiment: gives the main field in SI units. None: all is in pixels.
    provenance : Provenance or None
        Recipe and input files, if it was made by a recipe.
    errors : ErrorBudget or None
        Error budget of the displacement; None if the solver did not converge.
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
    setup: Setup | None = None
    provenance: Provenance | None = None
    errors: ErrorBudget | None = None

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
        return self.report.cautions

    @property
    def lit(self) -> BoolArray:
        """Used pixels from which rays start, (H, W), where the field counts."""
        return lit_pixels(self.source, self.mask, self.options)

    @property
    def structures(self) -> Structures | None:
        """Regions where the displacement stands above its error; None without pixel errors."""
        element = self.displacement[0].size / len(self.cells.sites)
        std = per_pixel_of(self.errors)
        return structures_of(self.displacement, std, self.mask, element=element)

    @property
    def main_field(self) -> ShownField:
        """The main field of the setup, where rays start."""
        (field_in_units,) = shown_fields([self.displacement], self.setup, mask=self.lit)
        return field_in_units

    @property
    def field_errors(self) -> ErrorBudget | None:
        """Errors of the main field, px of displacement, with that by the energy of the beam."""
        name = "" if self.setup is None else self.setup.main_field.name
        return self.errors and self.errors.in_field(self.setup, name, self.instrument.energy)

    @property
    def assessment(self) -> Assessment:
        """Verdict on the main field, its limit, and the next step."""
        return assess(self, (_by_caution, _without_total, _by_total))

    @property
    def verdict(self) -> Verdict:
        """Whether the field is known within the largest error of the options."""
        return self.assessment.verdict

    @property
    def headline(self) -> Headline:
        """The peak of the main field, its limit, and the next step."""
        errors, report = self.field_errors, self.report
        error = None if errors is None else errors.of_peak
        peaks = [self.main_field.short_peak_text(error)]
        return Headline.of(peaks, self.assessment, report.cautions, converged=report.converged)

    @property
    def facts(self) -> tuple[Fact, ...]:
        """The result in words, as every face shows it below the headline."""
        report, errors = self.report, self.field_errors
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
        if errors is not None and errors.by_counts is not None:
            details["limit by counts"] = (
                f"{share_of(errors.by_counts.rms, errors.rms)} of the displacement (r.m.s.), by "
                "all waves of 2 px and more if the beam is known; only assumptions about the "
                f"field, such as few sites, leave less: {share_of(errors.noise.rms, errors.rms)}"
            )
        convergence = Level.SOUND if report.converged else Level.FAILED
        assessment, error_rows = self.assessment, dict(self._error_rows(errors))
        if assessment.verdict is Verdict.CONDITIONAL:
            error_rows["measure next"] = assessment.explanation
        facts = (
            verdict_fact(assessment.verdict),
            *caution_facts(report.cautions),
            *peak_facts(
                self.displacement,
                self.setup,
                mask=self.lit,
                error=None if errors is None else errors.of_peak,
            ),
            *(error_fact(name, text) for name, text in error_rows.items()),
            Fact(
                "image_residual",
                "Image residual",
                f"{percent(report.image_residual)} of the mean (r.m.s.)",
                short=f"residual {percent(report.image_residual)}",
            ),
            *significance_facts(self.structures, () if errors is None else errors.causes),
            Fact("caustics", "Caustics", f"{percent(self.caustic.mean())} of the pixels"),
            *masked_fact(self.mask),
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
            ),
            *(Fact(key, key.capitalize(), text, is_detail=True) for key, text in details.items()),
            time_fact(report.seconds),
        )
        return folded(facts, _REPORT)

    def _error_rows(self, errors: ErrorBudget | None) -> list[tuple[str, str]]:
        if errors is None:
            return []
        rows = errors.rows("displacement" if errors is self.errors else "field")
        provenance, options = self.provenance, self.options
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

    def variable(self, name: str) -> AnyArray:
        """Return the array of a variable of the dataset, one of `VARIABLES`."""
        owner = self.cells if _is_of_cells(name) else self
        return np.asarray(getattr(owner, name.removeprefix("site_")))

    def in_units(self, setup: Setup | None) -> Inversion:
        """Return the same in the units of another experiment; None for px."""
        return replace(self, setup=setup)

    @property
    def recorded(self) -> RecordedShot:
        """The image in its own units, whole numbers if it was counts, with its source."""
        image = self.image * self.report.flux_scale
        counts, used = np.rint(image), self.mask
        return RecordedShot(
            image=counts if np.allclose(image[used], counts[used], rtol=1e-12, atol=0) else image,
            source=self.source,
            displacement=self.displacement,
            mask=self.mask,
        )

    def uncertainty(
        self,
        n: int = 200,
        *,
        noise: Literal["poisson"] | float | ArrayLike | None = None,
        noise_only: bool = False,
        method: Literal["linear", "resolve"] = "linear",
        quantities: Quantities | None = None,
        on_progress: OnProgress | None = None,
        should_stop: ShouldStop | None = None,
    ) -> Inversion:
        """Estimate how noise and instrument scatter potential and displacement in every pixel.

        Each sample is the image with fresh noise on top, inverted like the image. All share the
        image's own noise, so their scatter is the effect of one dose of noise: the standard
        deviation that shots of the same object would show. Each sample also draws the imperfections
        of the instrument (beam, background, gamma, blur, absorption, registration, another field)
        and is the mirror image, about the inversion, of the field without them. Where the object
        goes on beyond the edge, what may lie there is added. Other errors are not included (folds
        behind caustics).

        Parameters
        ----------
        n : int
            Number of samples, at least two. Random numbers come from the options' `seed`; samples
            are worked on side by side in its `threads`, as far as memory has room, which does not
            change the result.
        noise : "poisson" or float or array_like of shape (H, W), optional
            ``"poisson"``: each pixel counts quanta (photons, protons), whose number scatters by
            its square root: a pixel of value v by √(u · v), with the options' `units_per_quantum`
            u. Default of u: 1 for an image of whole numbers, which are taken as counts; any other
            image needs it. Else the standard deviation of Gaussian noise, in the image's units.
            Default: as in the error budget, counting noise if the options state
            `units_per_quantum`, the stated `noise_level`, or else as measured in the image.
            Gaussian noise is correlated between pixels as measured in the image. Samples that it
            drives below zero are clipped there, whatever `options.negative` says of the image.
        noise_only : bool, default False
            Whether the instrument and the source count as exact.
        method : {"linear", "resolve"}
            ``"linear"``: by the linear response of the transport. Three samples that are solved as
            well check it; with an instrument, 24 correct the mean and the deviation. ``"resolve"``:
            solve the transport of each sample, which takes many times as long; for caustics and
            strong noise.
        quantities : dict of str to callable, or callable, optional
            Numbers whose error bars are needed: functions of potential, (H, W), and displacement,
            (2, H, W), that return a number or an array: a line profile, the mean of a region, an
            integral, a peak. Several threads may call them at once. A function that returns the
            dictionary is called with the changes of the potential in a few samples, (k, H, W), from
            which it may choose a smoothing. Of a maximum give a `Maximum`.
        on_progress, should_stop : callable, optional
            As of `invert`.

        Returns
        -------
        Inversion
            The same, with the deviation of the displacement as ``errors.per_pixel``, all else of
            the samples as ``errors.samples``, and cautions about them.

        Raises
        ------
        InputError
            If the inversion did not converge, or `n`, `noise`, `method` or `quantities` make no
            sense.
        InversionCancelled
            If `should_stop` returned true.

        Examples
        --------
        >>> from napari_shadowinv.inversion import Maximum, invert
        >>> counts = np.random.default_rng(0).poisson(400, (24, 24))
        >>> errors = invert(counts).uncertainty(4, noise="poisson", noise_only=True).errors
        >>> errors.per_pixel.shape, errors.causes, errors.samples.converged
        ((2, 24, 24), ('noise',), (True, True, True))
        >>> peak = {"peak": Maximum(lambda potential, displacement: np.hypot(*displacement).max())}
        >>> blurred = invert(counts, instrument={"blur": 1.0})
        >>> errors = blurred.uncertainty(20, noise="poisson", quantities=peak).errors
        >>> errors.causes
        ('noise', 'beam, 5 %', 'blur, 1 px')
        >>> low, high = errors.samples.quantities["peak"].band(0.95)
        >>> bool(low < high)
        True
        """
        # Here, as they load the solver.
        from napari_shadowinv.inversion import plans, resampling, samples

        resampling.check_choices(n, method)
        errors, options, measured = self.errors, self.options, self.report.measured
        if errors is None:
            raise InputError(
                "the inversion did not converge, so its errors are not known: invert the image "
                "with more iterations or another source first"
            )
        shot, correlation = self.recorded, self.instrument.noise_correlation
        draw, described = resampling.noise_draw(shot, noise, errors, options, correlation)
        draws = None
        if not noise_only:
            lit = replace(shot, mask=self.mask | gaps_in(self.mask, self.source))
            draws = resampling.instrument_draws(lit, self.instrument, errors, measured=measured)
        sites, weights = self.cells.sites, self.cells.weights
        plan = plans.plan_of(sites, self.source, self.mask, options, measured=measured)
        images = samples.FullResampling(plan, weights, shot.image, draw, options, draws)
        fields = np.stack([self.potential, *self.displacement])
        assumed = resampling.assumed_changes(errors, fields, shot, options)
        sampler = resampling.Sampler.of(images, int(n), fields, assumed, quantities)
        error_samples = sampler.draw(method, described, Reporter(on_progress, should_stop))
        std, causes = error_samples.displacement_std, sampler.causes
        errors = replace(errors, per_pixel=std, causes=causes, samples=error_samples)
        earlier = (each for each in self.report.cautions if each.code != "samples")
        report = replace(self.report, cautions=(*earlier, *sampler.cautions(error_samples)))
        return replace(self, errors=errors, report=report)

    def with_cautions(self, cautions: Iterable[Caution]) -> Inversion:
        """Return the same inversion with more cautions in its report, after its own."""
        report = replace(self.report, cautions=(*self.report.cautions, *cautions))
        return replace(self, report=report)

    def to_dataset(self) -> xarray.Dataset:
        """Return everything as one labelled dataset, with units.

        The setup adds the line-integrated fields in SI units, and coordinates in metres.

        Returns
        -------
        xarray.Dataset
            Dimensions y, x, component ("y", "x") and site. Each variable has ``units`` and
            ``long_name``; verdict and explanation are attributes; options, report, errors (in px),
            setup and ``errors_si`` (the errors of the setup's main field) are JSON texts in the
            attributes. After `uncertainty` it has the deviations that `ErrorSamples.added_to`
            lists.
        """
        history = {
            "format": self.kind.value,
            "options": self.options.model_dump_json(),
            "instrument": self.instrument.model_dump_json(),
            "report": json.dumps(dataclasses.asdict(self.report)),
            "image_residual": self.report.image_residual,
        }
        if self.errors is not None:
            history["errors"] = json.dumps(self.errors.to_dict())
            history["error_causes"] = json.dumps(self.errors.causes)
        errors, assessment, setup = self.field_errors, self.assessment, self.setup
        history |= {"verdict": assessment.verdict.value, "explanation": assessment.explanation}
        if errors is not None and setup is not None:
            field = setup.main_field
            (unit,) = (si_field.unit for si_field in setup.si_fields if si_field.name == field.name)
            factor = np.abs(setup.field_in_si(field.name, np.ones((2, 1, 1)))).max()
            in_si = errors.times(float(factor)).to_dict()
            history["errors_si"] = json.dumps({"field": field.name, "unit": unit, **in_si})
        dataset = dataset_from_field(self.displacement, self.potential, setup, attributes=history)
        if (std := per_pixel_of(self.errors)) is not None:
            dims, *words = DISPLACEMENT_STD
            dataset["displacement_std"] = dims, std, label(*words)
        dataset = dataset.assign(
            {
                name: (dims, self.variable(name), label(units, long_name))
                for name, (dims, units, long_name) in VARIABLES.items()
                if name not in dataset
            }
        )
        if self.errors is not None and self.errors.samples is not None:
            dataset = self.errors.samples.added_to(dataset, setup)
        return dataset if self.provenance is None else self.provenance.added_to(dataset)

    @classmethod
    @as_input_errors("the result")
    def from_dataset(cls, dataset: xarray.Dataset) -> Inversion:
        """Rebuild an inversion from its dataset; an `InputError` if a part is missing or wrong."""
        attributes = "options", "instrument", "report"
        refuse_missing(dataset, "result of an inversion", VARIABLES, attributes)
        arrays: dict[str, Any] = {name: numbers_of(dataset, name) for name in VARIABLES}
        of_cells = filter(_is_of_cells, VARIABLES)
        cells = Cells(**{name.removeprefix("site_"): arrays.pop(name) for name in of_cells})
        content = json.loads(dataset.attrs["report"])
        content["cautions"] = [Caution.from_json(caution) for caution in content["cautions"]]
        return cls(
            **arrays,
            cells=cells,
            report=schema_of(Report).validate_python(content),
            options=InversionOptions.model_validate_json(dataset.attrs["options"]),
            instrument=Instrument.model_validate_json(dataset.attrs["instrument"]),
            setup=setup_from_dataset(dataset),
            provenance=Provenance.of(dataset.attrs, dataset.variables),
            errors=_errors_in(dataset),
        )


def _by_caution(case: Inversion) -> Assessment | None:
    by_code = {caution.code: caution for caution in reversed(case.report.cautions)}
    for code, (verdict, advice) in DECISIVE.items():
        if code in by_code:
            caution, errors = by_code[code], case.errors
            reason = caution.short
            if code == "edge" and errors is not None and errors.sides:
                reason = f"the object goes on {beyond_sides(errors.sides)}"
            return Assessment(verdict, reason, advice, caution.text, caution)
    return None


def _without_total(case: Inversion) -> Assessment | None:
    if case.errors is None:
        return Assessment(Verdict.UNCERTAIN, "errors were not worked out")
    if not case.errors.rms > 0:
        return Assessment(Verdict.UNCERTAIN, "there is no displacement to compare errors with")
    return None


def _by_total(case: Inversion) -> Assessment:
    errors, max_error = case.field_errors, case.options.max_error
    assert errors is not None
    if errors.share <= max_error:
        return Assessment(Verdict.DETERMINED, errors.limit)
    if condition := errors.condition(max_error):
        return case.main_field.conditional(condition)
    steps = (errors.measure_next(share) for share in (max_error, errors.share / 2))
    # That of the headline is a short one.
    advice = next((text for text in steps if len(text.split()) <= _MOST_ADVICE), "")
    return Assessment(Verdict.UNCERTAIN, errors.reason, advice)


def _is_of_cells(name: str) -> bool:
    return "site" in VARIABLES[name][0]


def _errors_in(dataset: xarray.Dataset) -> ErrorBudget | None:
    if "errors" not in dataset.attrs:
        return None
    content, causes = (json.loads(dataset.attrs[name]) for name in ("errors", "error_causes"))
    return ErrorBudget.from_dict(content, causes, _deviation(dataset, "displacement_std"))


def _deviation(dataset: xarray.Dataset, name: str) -> FloatArray | None:
    if name not in dataset:
        return None
    std, shape = numbers_of(dataset, name), dataset["displacement"].shape
    if std.shape != shape:
        raise ValueError(f"{name} has shape {std.shape}, displacement {shape}")
    return std


_STORED_CAUSES = ("noise, instrument and beam",)


@dataclass(frozen=True, eq=False, repr=False)
class RetrievedField(Summarised):
    """A displacement of another program, or of a shot of a store.

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
        return Provenance.of(self.dataset.attrs, self.dataset.variables)

    @property
    def headline(self) -> Headline:
        """The peak of the field."""
        return Headline(Level.SOUND, self.facts[0].text)

    @property
    def facts(self) -> tuple[Fact, ...]:
        """The peak of the field and its significance in words."""
        significance = significance_facts(self.structures, _STORED_CAUSES)
        return (*peak_facts(self.displacement, self.setup), *significance)

    @property
    def displacement_std(self) -> FloatArray | None:
        """Standard deviation of the displacement in every pixel, if the dataset contains it."""
        return _deviation(self.dataset, "displacement_uncertainty")

    @property
    def structures(self) -> Structures | None:
        """Regions where the displacement stands above its error; None without pixel errors."""
        return structures_of(self.displacement, self.displacement_std)

    def to_dataset(self) -> xarray.Dataset:
        """Return the dataset."""
        return self.dataset

    @classmethod
    def from_dataset(cls, dataset: xarray.Dataset) -> RetrievedField:
        """Return the field of a dataset; an `InputError` if it has no displacement."""
        refuse_missing(dataset, "displacement (2, height, width) in px", ["displacement"])
        return cls(dataset)
