"""Products of a result with their bands, in one pass over samples of its field: `analyse`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.analysis._field_samples import Evaluation, SampledField, sampled_fields
from napari_shadowinv.analysis.frame import FieldFrame, field_unit
from napari_shadowinv.analysis.kinds import product_from_dict, product_from_text
from napari_shadowinv.analysis.product import FieldNoise, Product, Values
from napari_shadowinv.analysis.result import ProductResult
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Fact, Level, caution_facts, percent
from napari_shadowinv.inversion.error_bars import Quantity
from napari_shadowinv.inversion.samples import stratified_numbers
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.results import unpack_result


def analyse(
    result: Any,
    products: Product | Mapping[str, Any] | str | Sequence[Product | Mapping[str, Any] | str],
    *,
    samples: int = 100,
    unit: str | None = None,
    deflector: str | None = None,
    setup: Setup | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> list[ProductResult]:
    """Measure products of a result, each with its band.

    All products share one pass over samples of the field. An inversion's, also of one that was
    read from a file, are drawn from the noise of its image and from its instrument, as by
    `uncertainty`; its discretisation error is added. A fit has stored its samples. The field of
    another program has none, so its products have no bands.

    Parameters
    ----------
    result : Inversion, Fit, RetrievedField or Dataset
        Of one shot; a dataset as `read` returns it.
    products : Product, mapping, str, or sequence of these
        Products, tables of their fields, such as ``{"product": "flux", "path": …}``, or texts, such
        as "flux 100,20 100,180", which `product_syntax` describes.
    samples : int
        Number of samples, at least 20. A band of 95 % needs about 100. For a fit at most the
        number that it has stored.
    unit : str, optional
        Unit of the field, such as "MG µm"; all are in `FIELD_UNITS`. It chooses the field, too:
        "V" an electric one. Default: the SI unit of the deflector.
    deflector : str, optional
        Key of the deflector, such as "E". Of a fit with several fields only this one is analysed.
    setup : Setup, optional
        The experiment, for SI units. Default: the result's.
    on_progress, should_stop
        As of `invert`.

    Returns
    -------
    list of ProductResult
        For each product, and each field that it is defined for.

    Raises
    ------
    InputError
        If a product cannot be measured in this result, the unit is unknown or does not belong to
        the result, or the result is not of one shot.
    InversionCancelled
        If `should_stop` returned true.

    Examples
    --------
    >>> from napari_shadowinv import invert
    >>> y, x = np.mgrid[:40, :40] - 19.5
    >>> image = 400 * (1 + 0.2 * np.exp(-(x**2 + y**2) / 50))
    >>> line = {"product": "profile", "path": [(20, 5), (20, 35)]}
    >>> (profile,) = analyse(invert(np.random.default_rng(0).poisson(image)), line, samples=20)
    >>> profile["magnitude"].value.shape, profile.variables["magnitude"].unit
    ((31,), 'pixel')
    """
    is_list = isinstance(products, Sequence) and not isinstance(products, str)
    numbered = enumerate(products if is_list else [products], 1)
    listed = [_checked_product(each, number) for number, each in numbered]
    if not listed:
        raise InputError("got no product, expected at least one")
    if not isinstance(samples, int | np.integer) or isinstance(samples, bool):
        raise InputError(f"samples is {samples!r}, expected a whole number")
    if samples < 20:
        raise InputError(f"samples is {samples}, expected at least 20")
    chosen_unit = None if unit is None else field_unit(unit)
    content = unpack_result(result)
    fields = sampled_fields(content, setup or content.setup, chosen_unit, deflector)
    callbacks = {"on_progress": on_progress, "should_stop": should_stop}
    tasks = [_Task(each, _products_for(listed, each.frame, len(fields))) for each in fields]
    missing = [each for each in listed if not any(each in task.products for task in tasks)]
    if missing:
        missing[0].check(fields[0].frame)
    names = _names([product for task in tasks for product in task.products])
    headline = Fact("result", "Field", str(content.headline), content.headline.level)
    results: list[ProductResult] = []
    for task in tasks:
        if not task.products:
            continue
        evaluation = task.field.evaluate(task.choose, int(samples), callbacks)
        rng = np.random.default_rng(0)  # of errors that are the same in all samples
        results += task.results(evaluation, rng, names[len(results) :], headline)
    return results


def _checked_product(product: Any, number: int) -> Product:
    if isinstance(product, Product):
        return product
    if isinstance(product, str):
        return product_from_text(product)
    if isinstance(product, Mapping):
        return product_from_dict(product, f"product {number}")
    raise InputError(
        f"product {number} is a {type(product).__name__}, expected a product, a table of its "
        "fields, or a text such as 'profile 100,20 100,180 width=5'"
    )


def _products_for(products: list[Product], frame: FieldFrame, n_fields: int) -> list[Product]:
    """Return the products of one of several fields, after a check that they can be measured."""
    suitable = [each for each in products if n_fields == 1 or each.is_defined_for(frame.unit.field)]
    for product in suitable:
        product.check(frame)
    return suitable


def _names(products: Sequence[Product]) -> list[str]:
    bases = [(each.label or each.name()).replace(" ", "_").replace("-", "_") for each in products]
    return [
        base if bases.count(base) == 1 else f"{base}_{bases[:number].count(base)}"
        for number, base in enumerate(bases, 1)
    ]


@dataclass
class _Task:
    """The products of one field; `choose` replaces them by those that are measured."""

    field: SampledField
    products: list[Product]
    _shapes: Sequence[dict[str, tuple[int, ...]]] = ()

    def choose(self, noise: FieldNoise | None) -> Any:
        """Make the choices by the noise, and return the function that measures everything."""
        frame, potential = self.field.frame, self.field.potential
        self.products = [each.adapt(potential, noise, frame) for each in self.products]
        values = self._values(potential, self.field.displacement)
        self._shapes = [{name: value.shape for name, value in each.items()} for each in values]
        return self.measure

    def _values(self, potential: FloatArray, displacement: FloatArray) -> list[Values]:
        field = self.field.at_points(potential, displacement)
        measured = (each.measure(*field, self.field.frame) for each in self.products)
        return [
            {name: np.asarray(value, dtype=np.float64) for name, value in values.items()}
            for values in measured
        ]

    def measure(self, potential: FloatArray, displacement: FloatArray) -> FloatArray:
        """Return all numbers of all products as one vector."""
        values = self._values(potential, displacement)
        return np.concatenate([value.ravel() for each in values for value in each.values()])

    def results(
        self, evaluation: Evaluation, rng: np.random.Generator, names: Sequence[str], headline: Fact
    ) -> Iterator[ProductResult]:
        """Yield the results, with systematic errors of random sign added to the samples."""
        systematic = {**evaluation.systematic, **self._by_energy(evaluation.value)}
        if len(evaluation.samples):
            systematic["pixels"] = self.measure(*self.field.within_pixels()) - evaluation.value
            systematic |= self._by_product()
        samples = evaluation.samples
        numbers = stratified_numbers(rng, len(samples), len(systematic))
        for sample, strengths in zip(samples, numbers, strict=True):
            for strength, error in zip(strengths, systematic.values(), strict=True):
                sample += strength * error
        doubts = [headline, *caution_facts(evaluation.cautions)]
        start = 0
        for product, name, shapes in zip(self.products, names, self._shapes, strict=False):
            quantities: dict[str, Quantity] = {}
            causes = list(evaluation.causes)
            for variable, shape in shapes.items():
                part = slice(start, start + math.prod(shape))
                start = part.stop
                for cause, error in systematic.items():
                    if len(samples) and error[part].any() and cause not in causes:
                        causes.append(cause)
                value, scatter = evaluation.value[part], samples[:, part]
                if product.subtracts_noise and len(scatter):
                    scatter = scatter + (value - scatter.mean(axis=0))
                scatter = scatter.reshape(len(samples), *shape)
                is_maximum = variable in product.maxima
                quantities[variable] = Quantity(value.reshape(shape), scatter, is_maximum)
            yield _result(product, name, quantities, self.field.frame, causes, doubts)

    def _by_energy(self, value: FloatArray) -> Values:
        """Return the errors by the energy of the beam, which scales fields in SI units."""
        frame, share = self.field.frame, self.field.instrument.energy
        if not share or frame.setup is None or frame.unit.field == "displacement":
            return {}
        factor = 1.0 + share * abs(frame.setup.sensitivity_to_beam(frame.unit.field))
        scaled = self.measure(factor * self.field.potential, factor * self.field.displacement)
        return {f"{frame.setup.beam_quantity().noun}, {percent(share)}": scaled - value}

    def _by_product(self) -> Values:
        field = self.field.potential, self.field.displacement, self.field.frame
        errors = [product.systematic(*field) for product in self.products]
        if not any(errors):
            return {}
        parts = [
            np.broadcast_to(errors_of_product.get(name, 0.0), shape).ravel()
            for errors_of_product, shapes in zip(errors, self._shapes, strict=True)
            for name, shape in shapes.items()
        ]
        return {"smoothing": np.concatenate(parts)}


def _result(
    product: Product,
    name: str,
    quantities: dict[str, Quantity],
    frame: FieldFrame,
    causes: Sequence[str],
    doubts: Sequence[Fact],
) -> ProductResult:
    variables = product.variables(frame)
    quantities = product.refine(quantities)
    for constant, values in product.constants(frame).items():
        array = np.asarray(values, dtype=np.float64)
        quantities[constant] = Quantity(array, np.zeros((0, *array.shape)))
    text, level = "none: the errors of this field are not known", Level.DOUBTFUL
    if causes:
        count = max(len(quantity.samples) for quantity in quantities.values())
        text, level = f"68 and 95 %, by {', '.join(causes)}; {count} samples", Level.SOUND
    cautions = caution_facts(product.cautions(quantities, frame))
    bands = Fact("bands", "Bands", text, level)
    return ProductResult(
        name=name,
        product=product,
        field=frame.unit.field,
        unit=frame.unit,
        quantities={each: quantities[each] for each in variables},
        variables=variables,
        coordinates=product.coordinates(frame),
        facts=(*product.facts(quantities, frame), *cautions, *doubts, bands),
        limits=(*product.remarks(frame), *frame.limits),
        causes=tuple(causes),
    )
