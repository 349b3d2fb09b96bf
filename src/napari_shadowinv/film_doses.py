"""The result of a film pack: `FilmDoses`; its mean spectrum in a region: `Spectrum`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from napari_shadowinv._system.safety import as_input_errors
from napari_shadowinv._system.validation import validate
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import (
    Fact,
    Headline,
    Level,
    ResultKind,
    Summarised,
    caution_facts,
    percent,
)
from napari_shadowinv.film.pack import Pack
from napari_shadowinv.film.unfolding import relative_strengths
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.physics.units import (
    PIXEL,
    label,
    numbers_of,
    place_coordinates,
    refuse_missing,
)
from napari_shadowinv.provenance import Provenance

if TYPE_CHECKING:
    import xarray

_PLANES = ("layer", "y", "x")
_PER_AREA = "1/(m² MeV)"
# Variable: attribute of `FilmDoses`, dimensions, units, long name.
_VARIABLES: dict[str, tuple[str, tuple[str, ...], str, str]] = {
    "dose": ("dose", _PLANES, "Gy", "Dose, per area of the first film"),
    "dose_error": ("dose_error", _PLANES, "Gy", "Standard deviation of the dose"),
    "usable": ("usable", _PLANES, "1", "Pixels whose dose can be trusted"),
    "fluence": ("fluence", _PLANES, _PER_AREA, "Protons per area of the first film and energy"),
    "fluence_error": ("fluence_error", _PLANES, _PER_AREA, "Standard deviation of the fluence"),
    "shift": ("shifts", ("layer", "component"), PIXEL, "Shift of the alignment"),
    "turn": ("turns", ("layer",), "rad", "Rotation of the alignment"),
    "shift_error": ("shift_errors", ("layer",), PIXEL, "Standard deviation of the shift"),
    "by_images": ("by_images", ("layer",), "1", "Aligned on the image content"),
    "corners": ("corners", ("layer", "corner", "component"), PIXEL, "Corners on the scan"),
}
_MIN_SIGNIFICANCE = 2.0  # fluence over its error, dose over that of a flat background
_MAX_BACKGROUND_SHARE = 0.05  # of the largest dose; above, the last film sees the beam
_BANDS = ("peak", "energy_low", "energy_high")  # columns of `FilmDoses.bands`


class Spectrum(NamedTuple):
    """Mean over the usable pixels of a region, by film; NaN for films without usable pixels."""

    energies: FloatArray  # MeV
    fluence: FloatArray  # protons per m² and MeV
    error: FloatArray  # median standard deviation of a pixel; mostly common to all pixels
    bands: FloatArray  # shape (n, 2), MeV
    is_measured: BoolArray
    """False for layers without usable pixels or with a fluence below twice its error, and for the
    last layer, whose fluence depends on the assumed spectrum beyond it. Also for a faint layer
    whose dose exceeds the dose of the last film, which electrons or X-rays may leave in all films,
    by less than twice that dose."""


@dataclass(frozen=True, eq=False, repr=False)
class FilmDoses(Summarised):
    """Doses and fluences of the films of a pack on common pixels, with their warnings.

    Arrays have an entry for each of the n layers, also for excluded films, whose values are NaN.
    Planes are ``[y, x]``, as on the first film.

    Attributes
    ----------
    dose, dose_error : ndarray, shape (n, H, W)
        Dose and its standard deviation, Gy, per area of the first film.
    usable : ndarray of bool, shape (n, H, W)
        Pixels whose dose can be trusted.
    fluence, fluence_error : ndarray, shape (n, H, W)
        Protons per m² of the first film and MeV, and their standard deviation.
    energies : ndarray, shape (n,)
        Energy of the protons that each fluence represents, MeV.
    bands : ndarray, shape (n, 3)
        Energy whose Bragg peak lies in each film, and the lower and upper limit of the band around
        it, MeV.
    shifts, shift_errors, turns : ndarray, shape (n, 2), (n,) and (n,)
        Alignment of each film: shift and its standard deviation, px, and rotation, rad.
    by_images : ndarray of bool, shape (n,)
        Whether each film was aligned on its content.
    corners : ndarray, shape (n, 4, 2)
        Corners of each film on its scan, px.
    provenance : Provenance
        The pack and its scans, by which the result can be repeated.
    cautions : tuple of Caution
        Reasons to doubt the result.
    pixel_size : float or None
        Of the upright films, m.
    setups : tuple of ProtonSetup
        The experiment of each film, if the pack has distances.
    created : str
        Time of the evaluation.
    """

    kind: ClassVar = ResultKind.FILM_DOSES

    dose: FloatArray
    dose_error: FloatArray
    usable: BoolArray
    fluence: FloatArray
    fluence_error: FloatArray
    energies: FloatArray
    bands: FloatArray
    shifts: FloatArray
    shift_errors: FloatArray
    turns: FloatArray
    by_images: BoolArray
    corners: FloatArray
    provenance: Provenance
    cautions: tuple[Caution, ...] = ()
    pixel_size: float | None = None
    setups: tuple[ProtonSetup, ...] = ()
    created: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))

    @property
    def pack(self) -> Pack:
        """The pack that was evaluated."""
        assert self.provenance.pack is not None
        return self.provenance.pack

    @property
    def setup(self) -> ProtonSetup | None:
        """The experiment of the first film, if it is known."""
        return self.setups[0] if self.setups else None

    @property
    def strengths(self) -> FloatArray:
        """Displacement by a magnetic field, relative to the first layer's, shape (n,)."""
        return relative_strengths(self.energies)

    @property
    def times_of_flight(self) -> FloatArray | None:
        """Time of flight to the object of each layer's protons, s; None without setups."""
        return np.array([setup.time_of_flight for setup in self.setups]) if self.setups else None

    @property
    def scales(self) -> FloatArray:
        """Magnification of each film relative to the first, shape (n,)."""
        magnifications = np.array([setup.magnification for setup in self.setups])
        if not magnifications.size:
            return np.ones(len(self.energies))
        return np.asarray(magnifications / magnifications[0])

    @property
    def headline(self) -> Headline:
        """Number of films, their energies and the warnings in one line."""
        texts = dict.fromkeys(caution.short for caution in self.cautions)
        level = Level.DOUBTFUL if texts else Level.SOUND
        return Headline(level, "; ".join([f"{len(self.energies)} films, {self._range}", *texts]))

    @property
    def facts(self) -> tuple[Fact, ...]:
        """The result in words, as every face shows it."""
        height, width = self.dose.shape[1:]
        pixels = [f"{height} × {width}"]
        if self.pixel_size is not None:
            pixels.append(f"{1e6 * self.pixel_size:.4g} µm on the film")
        pixels.append(f"{percent(self.usable.mean())} usable")
        facts = [
            *caution_facts(self.cautions),
            Fact("films", "Films", f"{len(self.energies)}, {self._range}"),
            Fact("pixels", "Pixels", ", ".join(pixels)),
            Fact("seen_from", "Seen from", self.pack.seen_from_text),
        ]
        excluded = np.flatnonzero(~self.usable.any(axis=(1, 2))) + 1
        if excluded.size:
            numbers = ", ".join(map(str, excluded))
            facts.append(Fact("excluded", "Excluded", f"film {numbers}"))
        for number, cells in enumerate(self.film_texts(), 1):
            text = ", ".join(
                cell if name in ("film", "energy", "flight") else f"{name} {cell}"
                for name, cell in cells.items()
                if cell
            )
            facts.append(Fact(f"film_{number}", f"Film {number}", text, is_detail=True))
        return tuple(facts)

    def film_texts(self) -> list[dict[str, str]]:
        """Return film type, energy, dose and alignment of each film in words, by their names."""
        return [self._film_text(k) for k in range(len(self.energies))]

    def film_label(self, index: int) -> str:
        """Return number, energy and time of flight of a film in words."""
        cells = self._film_text(index)
        parts = [cells[name] for name in ("energy", "flight") if name in cells]
        if not self.usable[index].any():
            parts.append("excluded")
        return f"film {index + 1}: {', '.join(parts)}"

    def spectrum(self, region: BoolArray | None = None) -> Spectrum:
        """Return the mean fluence of each film over the usable pixels of a region; None is all."""
        inside = self.usable if region is None else self.usable & region

        def reduce(planes: FloatArray, statistic: Callable[[AnyArray], Any]) -> FloatArray:
            films = zip(planes, inside, strict=True)
            values = [statistic(plane[used]) if used.any() else np.nan for plane, used in films]
            return np.array(values, float)

        fluence = reduce(self.fluence, partial(np.mean, dtype=np.float64))
        error = reduce(self.fluence_error, np.median)
        is_measured = fluence > _MIN_SIGNIFICANCE * error  # False for NaN
        is_measured[-1] = False
        dose = reduce(self.dose, partial(np.mean, dtype=np.float64))
        background = dose[-1]
        is_faint = dose < _MAX_BACKGROUND_SHARE * np.nanmax(dose, initial=0.0)
        is_measured &= ~(is_faint & (dose - background < _MIN_SIGNIFICANCE * background))
        return Spectrum(self.energies, fluence, error, self.bands[:, 1:], is_measured)

    @property
    def _range(self) -> str:
        return f"{self.energies[0]:.3g} to {self.energies[-1]:.3g} MeV"

    def _film_text(self, k: int) -> dict[str, str]:
        cells = {"film": self.pack.layers[k].film, "energy": f"{self.energies[k]:.3g} MeV"}
        if self.setups:
            time = self.setups[k].time_of_flight
            cells["flight"] = f"{1e12 * time:.3g} ps" if time < 1e-9 else f"{1e9 * time:.3g} ns"
        usable = self.usable[k]
        if not usable.any():
            return {**cells, "median dose": "", "usable": "0%", "shift": ""}
        dy, dx = self.shifts[k]
        return {
            **cells,
            "median dose": f"{np.median(self.dose[k][usable]):.3g} Gy",
            "usable": f"{percent(usable.mean())}",
            "shift": f"y {dy:+.1f}, x {dx:+.1f} px (± {self.shift_errors[k]:.1f})",
        }

    def to_dataset(self) -> xarray.Dataset:
        """Return everything as one labelled dataset, with units and dimensions layer, y and x.

        Pack, warnings and setups are JSON texts in the attributes.
        """
        import xarray as xr

        variables: dict[str, Any] = {
            name: (dims, getattr(self, attribute), label(units, text))
            for name, (attribute, dims, units, text) in _VARIABLES.items()
        }
        mega = {"units": "MeV"}
        coordinates: dict[str, Any] = {
            "layer": np.arange(1, len(self.energies) + 1),
            "film": ("layer", [layer.film for layer in self.pack.layers]),
            "energy": ("layer", self.energies, mega),
            **{name: ("layer", self.bands[:, k], mega) for k, name in enumerate(_BANDS)},
            "strength": ("layer", self.strengths, {"units": "1"}),
            **place_coordinates(self.dose.shape[1:], self.pixel_size, "film's plane"),
        }
        history: dict[str, Any] = {
            "format": self.kind.value,
            "package_version": self.provenance.version,
            "created": self.created,
            "provenance": self.provenance.to_json(),
            "cautions": json.dumps([asdict(caution) for caution in self.cautions]),
            "seen_from": self.pack.seen_from_text,
        }
        if self.pixel_size is not None:
            history["scan_pixel_size"] = self.pixel_size
        if self.setups:
            coordinates["time_of_flight"] = ("layer", self.times_of_flight, {"units": "s"})
            history["setups"] = json.dumps([setup.model_dump(mode="json") for setup in self.setups])
        return xr.Dataset(variables, coordinates, history)

    @classmethod
    def from_dataset(cls, dataset: xarray.Dataset) -> FilmDoses:
        """Rebuild the doses; an `InputError` if a variable or attribute is missing or damaged."""
        refuse_missing(dataset, "result of a film pack", (*_VARIABLES, "energy", *_BANDS))
        with as_input_errors("the film pack"):
            return cls._from_parts(dataset)

    @classmethod
    def _from_parts(cls, dataset: xarray.Dataset) -> FilmDoses:
        attributes = dataset.attrs
        provenance = Provenance.of(attributes)
        if provenance is None or provenance.pack is None:
            raise InputError("the result has no readable film pack: convert its scans again")
        arrays: dict[str, Any] = {
            attribute: numbers_of(dataset, name) for name, (attribute, *_) in _VARIABLES.items()
        }
        if len({arrays[name].shape for name in _VARIABLES if _VARIABLES[name][1] == _PLANES}) > 1:
            raise ValueError("its planes differ in shape")
        for name in ("usable", "by_images"):
            arrays[name] = arrays[name].astype(bool)
        bands = [numbers_of(dataset, name) for name in _BANDS]
        setups = json.loads(attributes.get("setups", "[]"))
        size = attributes.get("scan_pixel_size")
        return cls(
            **arrays,
            energies=numbers_of(dataset, "energy"),
            bands=np.stack(bands, axis=1),
            provenance=provenance,
            cautions=tuple(map(Caution.from_json, json.loads(attributes.get("cautions", "[]")))),
            pixel_size=None if size is None else float(size),
            setups=tuple(validate(ProtonSetup, entry, "the pack's setup") for entry in setups),
            created=str(attributes.get("created", "")),
        )
