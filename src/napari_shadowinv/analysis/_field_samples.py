"""A field with random samples of its errors, for each kind of result: `sampled_fields`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._system.safety import check_memory
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.analysis.frame import FIELD_UNITS, FieldFrame, FieldUnit
from napari_shadowinv.analysis.paths import is_inside
from napari_shadowinv.analysis.product import FieldNoise
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion import invert
from napari_shadowinv.inversion.budget import discretisation_share
from napari_shadowinv.inversion.error_budget import ErrorBudget
from napari_shadowinv.options import Instrument
from napari_shadowinv.physics.beam import displacement_from_potential
from napari_shadowinv.physics.derivatives import finer_field
from napari_shadowinv.physics.forward import jacobian_determinant
from napari_shadowinv.physics.poisson import potential_from_displacement
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.preprocessing.pixels import LEAST_LIGHT

if TYPE_CHECKING:
    from napari_shadowinv.fitting.result import Fit
    from napari_shadowinv.inversion.result import Inversion, RetrievedField

Measure = Callable[[FloatArray, FloatArray], FloatArray]
"""Returns all numbers of all products of a potential and a displacement, shape (m,)."""

Choose = Callable[[FieldNoise | None], Measure]
"""Returns the measure, with the choices that follow from the noise."""

Callbacks = dict[str, Any]
"""Arguments `on_progress` and `should_stop` by their names."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """All numbers of all products, shape (m,), with samples (n, m) and systematic errors.

    `systematic` has errors (m,) by their causes, each of one sign or the other.
    """

    value: FloatArray
    samples: FloatArray
    systematic: dict[str, FloatArray]
    causes: tuple[str, ...]
    cautions: tuple[Caution, ...] = ()


@dataclass(frozen=True, eq=False)
class SampledField:
    """A field and the scatter of products of it; here one whose errors are not known."""

    frame: FieldFrame
    potential: FloatArray
    displacement: FloatArray
    instrument: Instrument

    def evaluate(self, choose: Choose, samples: int, callbacks: Callbacks) -> Evaluation:
        """Measure the field and samples of its errors."""
        value = choose(None)(self.potential, self.displacement)
        return Evaluation(value, np.zeros((0, value.size)), {}, ())

    def at_points(
        self, potential: FloatArray, displacement: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return potential and displacement at the middles of pixels."""
        return potential, displacement

    def within_pixels(self) -> tuple[FloatArray, FloatArray]:
        """Return potential and displacement with the most that means over pixels can hide."""
        return finer_field(self.potential, self.displacement)


@dataclass(frozen=True, eq=False)
class StoredSamples(SampledField):
    """A fitted field with stored changes of its potential, (n, H, W)."""

    changes: FloatArray
    causes: tuple[str, ...]

    def evaluate(self, choose: Choose, samples: int, callbacks: Callbacks) -> Evaluation:
        report = Reporter(**callbacks)
        # Eight suffice for choices by the noise.
        measure = choose(FieldNoise(np.asarray(self.changes[:8], dtype=np.float64)))
        value = measure(self.potential, self.displacement)
        count = min(samples, len(self.changes))
        scatter = np.empty((count, value.size), sample_type(count, value.size))
        for index, change in enumerate(self.changes[:count]):
            report("samples", index, count)
            moved = self.displacement + displacement_from_potential(change)
            scatter[index] = measure(self.potential + change, moved)
        return Evaluation(value, scatter, {}, self.causes)


@dataclass(frozen=True, eq=False)
class ResampledInversion(SampledField):
    """An inversion, of which samples are drawn by its noise and instrument."""

    inversion: Inversion

    def at_points(
        self, potential: FloatArray, displacement: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return a field that is read out as a mean over pixels, and by differences, at points."""
        if self.inversion.cells.are_pixels:
            return potential, displacement
        return finer_field(potential, displacement)

    def evaluate(self, choose: Choose, samples: int, callbacks: Callbacks) -> Evaluation:
        inversion = self.inversion
        coarse = self._coarse_inversion(callbacks)
        measures: list[Measure] = []

        def quantities(changes: FloatArray) -> dict[str, Measure]:
            spacing = (inversion.image.size / number_of_inner_sites(inversion)) ** 0.5
            of_pixels = inversion.cells.are_pixels
            noise = FieldNoise(changes, spacing, of_pixels, Reporter(**callbacks))
            measures.append(choose(noise))
            size = measures[0](self.potential, self.displacement).size
            kind = sample_type(samples, size)
            return {"all": lambda *field: measures[0](*field).astype(kind, copy=False)}

        sampled = inversion.uncertainty(samples, quantities=quantities, **callbacks)
        (measure,) = measures
        value, errors, systematic = measure(self.potential, self.displacement), sampled.errors, {}
        assert errors is not None
        assert errors.samples is not None
        if coarse is not None:
            share = discretisation_share(len(inversion.cells.sites) / len(coarse.cells.sites))
            # The coarse field is no field at points.
            correct = finer_field if inversion.cells.are_pixels else lambda *fields: fields
            change = value - measure(*correct(coarse.potential, coarse.displacement))
            systematic["discretisation"] = share * change
        numbers, cautions = errors.samples.quantities["all"].samples, []
        if is_noise_notable(errors):
            cautions = [each for each in sampled.cautions if each.code == "samples"]
        return Evaluation(value, numbers, systematic, errors.causes, tuple(cautions))

    def within_pixels(self) -> tuple[FloatArray, FloatArray]:
        """Return the field if the brightness had a slope within pixels.

        An inversion whose cells are no pixels takes it as constant there, and so it misses the
        inverse of a blur of 1/6 px²,
        which moves light by 1/12 of the logarithm's slope.
        """
        if self.inversion.cells.are_pixels:
            return self.potential, self.displacement
        area = jacobian_determinant(self.displacement)
        change = np.log(np.maximum(area, LEAST_LIGHT)) / 12
        return self.potential + change, self.displacement + displacement_from_potential(change)

    def _coarse_inversion(self, callbacks: Callbacks) -> Inversion | None:
        """Invert the image with a quarter of the sites; None if these are fewer than 16."""
        inversion = self.inversion
        count = number_of_inner_sites(inversion) // 4
        if count < 16:
            return None
        changes: dict[str, Any] = {"n_sites": count}
        # The image of a result is scaled to the flux of its source.
        for name in ("noise_level", "units_per_quantum"):
            if (stated := getattr(inversion.options, name)) is not None:
                changes[name] = stated / inversion.report.flux_scale
        coarse = invert(
            inversion.image,
            source=inversion.source,
            mask=None if inversion.mask.all() else inversion.mask,
            options=inversion.options.model_copy(update=changes),
            instrument=inversion.instrument,
            **callbacks,
        )
        return coarse if len(coarse.cells.sites) < len(inversion.cells.sites) else None


def is_noise_notable(errors: ErrorBudget, least: float = 0.2) -> bool:
    """Return whether samples scatter by more than a share of the discretisation error.

    Without noise, they differ by the tolerance of the solver.
    """
    if errors.per_pixel is None or errors.discretisation is None:
        return True
    scatter = float(np.sqrt((errors.per_pixel**2).sum(axis=0).mean()))
    return scatter >= least * errors.discretisation.rms


def number_of_inner_sites(inversion: Inversion) -> int:
    """Return the number of sites to ask for: without those in a margin."""
    return max(int(is_inside(inversion.cells.sites, inversion.image.shape).sum()), 4)


def sample_type(count: int, size: int, *, most_double: int = 20_000) -> type[Any]:
    """Return the type of samples, single precision for maps; refuse more than fit in memory."""
    kind = np.float32 if size > most_double else np.float64
    bytes_of_number = 4 * np.dtype(kind).itemsize  # with copies of it
    check_memory((count, size), bytes_of_number, "the samples of these products")
    return kind


def sampled_fields(
    result: Any, setup: Setup | None, unit: FieldUnit | None, deflector: str | None
) -> list[SampledField]:
    """Return the fields of a result with samples of their errors; an `InputError` if none fits."""
    makers: dict[str, Callable[..., Iterator[SampledField]]] = {
        "shadowinv result": _of_inversion,
        "shadowinv fit": _of_fit,
        "shadowinv field": _of_field,
    }
    if str(result.kind) not in makers:
        raise InputError(
            f"got a {result.kind.noun}, expected the result of an inversion or a fit, or a field"
        )
    fields = list(makers[str(result.kind)](result, setup, unit, deflector))
    if not fields:
        symbol = deflector if unit is None else unit.symbol
        raise InputError(f"the result has no field for {symbol!r}: choose another unit")
    return fields


def _of_inversion(
    inversion: Inversion, setup: Setup | None, unit: FieldUnit | None, deflector: str | None
) -> Iterator[SampledField]:
    frame = make_frame(
        setup, inversion.mask, unit, deflector,
        image=np.where(inversion.mask, inversion.image * inversion.report.flux_scale, np.nan),
        source=np.where(inversion.mask, inversion.source * inversion.report.flux_scale, np.nan),
    )  # fmt: skip
    is_folded = any(caution.code == "folds" for caution in inversion.cautions)
    frame = replace(frame, has_crossed_rays=is_folded)
    parts = frame, inversion.potential, inversion.displacement, inversion.instrument
    if inversion.errors is None:
        yield SampledField(*parts)
    else:
        yield ResampledInversion(*parts, inversion)


def _of_fit(
    fit: Fit, setup: Setup | None, unit: FieldUnit | None, deflector: str | None
) -> Iterator[SampledField]:
    for field in fit.fields:
        if deflector not in (None, field.name):
            continue
        if unit is not None and setup is not None and not is_field_of(setup, unit, field.name):
            continue
        image = np.where(fit.mask[0], fit.images[0], np.nan)
        source = np.where(fit.mask[0], fit.source[0], np.nan)
        frame = make_frame(setup, fit.used, unit, field.name, image=image, source=source)
        parts = frame, field.potential, field.displacement, fit.instrument
        if field.samples is None or not len(field.samples):
            yield SampledField(*parts)
        else:
            causes = ("noise",) if field.errors is None else field.errors.causes
            yield StoredSamples(*parts, field.samples, causes)


def _of_field(
    retrieved: RetrievedField, setup: Setup | None, unit: FieldUnit | None, deflector: str | None
) -> Iterator[SampledField]:
    displacement = retrieved.displacement
    if displacement.ndim != 3:
        raise InputError(
            f"got displacements of shape {displacement.shape}, expected the result of one shot: "
            "choose one by its index"
        )
    dataset = retrieved.dataset
    potential = (
        np.asarray(dataset["potential"].values, dtype=np.float64)
        if "potential" in dataset
        else potential_from_displacement(displacement)
    )
    mask = np.asarray(np.isfinite(displacement).all(axis=0))
    frame = make_frame(setup, mask, unit, deflector)
    yield SampledField(frame, potential, displacement, Instrument())


def make_frame(
    setup: Setup | None,
    mask: BoolArray,
    unit: FieldUnit | None,
    deflector: str | None,
    *,
    image: FloatArray | None = None,
    source: FloatArray | None = None,
) -> FieldFrame:
    """Return the frame of a field; an `InputError` if the unit does not belong to the setup."""
    height, width = mask.shape
    if setup is None:
        if unit is not None and unit.field != "displacement":
            raise InputError(
                f"unit is {unit.symbol!r}, and the result has no setup to convert pixels with: "
                "expected 'px', or give the setup to the inversion"
            )
        return FieldFrame((height, width), mask, None, "", FIELD_UNITS["px"], image, source)
    titles = {each.key: each.title for each in setup.deflectors}
    if deflector is not None and deflector not in titles:
        raise InputError(
            f"deflector is {deflector!r}, expected one of {', '.join(titles)} for this beam"
        )
    if unit is None:
        main = setup.other_fields.get(titles.get(deflector or "", ""), setup.main_field)
        unit = next(each for each in FIELD_UNITS.values() if each.field == main.name)
    elif not is_field_of(setup, unit, deflector):
        names = {"displacement", *(each.name for each in setup.si_fields)}
        symbols = [each.symbol for each in FIELD_UNITS.values() if each.field in names]
        raise InputError(
            f"unit is {unit.symbol!r}, expected one of {', '.join(symbols)} for a beam of "
            f"{setup.beam}"
        )
    of_unit = [each.deflector for each in setup.si_fields if each.name == unit.field]
    key = deflector or next(filter(None, of_unit), "")
    return FieldFrame((height, width), mask, setup, key, unit, image, source)


def is_field_of(setup: Setup, unit: FieldUnit, deflector: str | None) -> bool:
    """Return whether a setup has the field of a unit, for a deflector if one is chosen."""
    if unit.field == "displacement":
        return True
    return any(
        each.name == unit.field and (deflector is None or each.deflector in ("", deflector))
        for each in setup.si_fields
    )
