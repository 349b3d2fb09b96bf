"""From the doses of a pack's films to the fluence of protons at each energy.

- the response of the films to protons of each energy: `ResponseMatrix`
- the spectrum in each pixel: `unfold`

Protons that stop in a film have left dose in all films before it. The doses of a pixel in all
films together determine the spectrum there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import constants
from scipy.optimize import nnls

from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.film.pack import PROTON_MASS, Pack, Slab, Stopping


@dataclass(frozen=True)
class Band:
    """Energies in MeV to which a film is most sensitive."""

    peak: float  # of the protons that lose most energy in the film: they stop there
    low: float  # energies around the peak at which they lose half as much
    high: float


@dataclass(frozen=True, eq=False)
class ResponseMatrix:
    """Energy that one proton loses in the active layer of each film."""

    energies: FloatArray  # (n,), of protons in front of the pack, in MeV, increasing
    deposits: FloatArray  # (layers, n), energy that they lose in each active layer, in MeV
    doses: FloatArray  # (layers, n), dose in Gy by one proton per m²

    @classmethod
    def of(
        cls, pack: Pack, energies: ArrayLike | None = None, *, ends: Sequence[float] = (0.5, 200.0)
    ) -> ResponseMatrix:
        """Compute the response of a pack.

        Energies in MeV are by default so close together that each film's peak is well resolved,
        between the `ends`, or up to the end of a stopping table, above which an `InputError`
        refuses others.
        """
        stoppings = pack.stoppings()
        last = min(ends[1], *(stopping.energies[-1] for stopping in stoppings.values()))
        if energies is None:
            energies = np.geomspace(ends[0], last, 6000)
        first = np.array(energies, dtype=np.float64)
        deposits, doses, joules_per_mev = [], [], constants.e / constants.micro
        now = first
        for layer in pack.layers:
            film = pack.film(layer)
            before = _behind(stoppings, (*layer.filters, *film.before), now)
            after = _behind(stoppings, (film.active,), before)
            mass = stoppings[film.active.material].density * film.active.thickness  # kg/m²
            deposits.append(before - after)
            doses.append((before - after) * joules_per_mev / mass)
            now = _behind(stoppings, film.behind, after)
        return cls(first, np.stack(deposits), np.stack(doses))

    @property
    def bands(self) -> tuple[Band, ...]:
        """Band of each film; an `InputError` if no proton of these energies reaches one."""
        bands = []
        for number, deposit in enumerate(self.deposits, 1):
            top = int(np.argmax(deposit))
            if not deposit[top] > 0:
                raise InputError(
                    f"no proton of up to {self.energies[-1]:.4g} MeV reaches film {number}: check "
                    "the thicknesses of the pack, which are in m"
                )
            above = np.flatnonzero(deposit >= 0.5 * deposit[top])
            # The first gap ends it; protons that are much faster cross all films.
            gaps = np.flatnonzero(np.diff(above[above >= top]) > 1)
            last = above[above >= top][gaps[0]] if gaps.size else above[-1]
            low, peak, high = (float(self.energies[k]) for k in (above[0], top, last))
            bands.append(Band(peak, low, high))
        return tuple(bands)


def _behind(
    stoppings: dict[str, Stopping], slabs: Sequence[Slab], energies: FloatArray
) -> FloatArray:
    for slab in slabs:
        energies = stoppings[slab.material].behind(energies, slab.thickness)
    return energies


def check_increasing(bands: Sequence[Band]) -> None:
    """Refuse a pack whose films do not see faster and faster protons."""
    for number, (slower, faster) in enumerate(pairwise(bands), 1):
        if faster.peak <= slower.peak:
            raise InputError(
                f"film {number + 1} sees {faster.peak:.3g} MeV, film {number} {slower.peak:.3g} "
                "MeV: expected films in the order in which protons reach them"
            )


def relative_strengths(energies: ArrayLike) -> FloatArray:
    """Return the displacement by a magnetic field at each energy (MeV) over that at the first."""
    in_mev = np.asarray(energies, np.float64)
    momenta = np.sqrt(in_mev * (in_mev + 2 * PROTON_MASS))
    return np.asarray(momenta[0] / momenta)


_DISPLACEMENT_POWER = 0.75  # displacement falls with this power of the energy: 0.5 by B, 1 by E


class Spectra(NamedTuple):
    """Fluence per energy in every pixel."""

    # (n,), in MeV, of the protons in a layer's fluence image: fields displace them by the mean
    # displacement of all protons that contribute
    energies: FloatArray
    fluence: FloatArray  # (n, H, W), protons per m² and MeV at energies that stop in each film
    error: FloatArray  # (n, H, W), its standard deviation


class _Basis(NamedTuple):
    """Basis spectra, as shares of the usual one at the films' energies, and their doses.

    Shares are linear in the displacement of the protons by fields. So each unfolded image belongs
    to one energy, to the first order of the displacement.
    """

    usual: FloatArray  # (n,), at the peaks
    kernel: FloatArray  # (n, m), dose in each film by the usual spectrum in each step of energy
    energies: FloatArray  # (m,)
    matrix: FloatArray  # (n, n), dose in film k by share j
    bends: FloatArray  # (n - 2, n), deviation of shares from linear

    @classmethod
    def of(cls, response: ResponseMatrix, usual: FloatArray, slope: float) -> _Basis:
        """Return the basis of a usual spectrum at the films' energies; its tail is `slope` MeV."""
        peaks = np.array([band.peak for band in response.bands])
        energies = response.energies
        logarithm = np.interp(energies, peaks, np.log(usual))
        logarithm -= np.maximum(energies - peaks[-1], 0) / slope
        steps = np.gradient(energies)
        steps[[0, -1]] /= 2
        kernel = response.doses * np.exp(logarithm) * steps
        places = _displacement(peaks)
        shares = [
            np.interp(-_displacement(energies), -places, share) for share in np.eye(len(peaks))
        ]
        apart = -np.diff(places)
        bends = np.diff(np.eye(len(peaks)), 2, axis=0)
        both = apart[1:] + apart[:-1]
        rows = np.arange(len(bends))
        bends[rows, rows] = 2 * apart[1:] / both
        bends[rows, rows + 2] = 2 * apart[:-1] / both
        return cls(usual, kernel, energies, kernel @ np.array(shares).T, bends)

    def seen_energies(self, per_error: FloatArray, curvature: float) -> FloatArray:
        """Return energies with the mean displacement of the protons in each unfolded share."""
        weighed = per_error[:, None] * self.matrix
        normal = weighed.T @ weighed + self.bends.T @ self.bends / curvature**2
        unfolded = np.linalg.solve(normal, weighed.T * per_error) @ self.kernel
        displaced = unfolded @ _displacement(self.energies) / unfolded.sum(axis=1)
        return np.asarray(displaced ** (-1 / _DISPLACEMENT_POWER))


def _displacement(energies: FloatArray) -> FloatArray:
    """Return the displacement of protons by fields, up to a factor."""
    return np.asarray(energies**-_DISPLACEMENT_POWER)


def unfold(
    doses: ArrayLike,
    errors: ArrayLike,
    response: ResponseMatrix,
    *,
    curvature: float = 1.0,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> Spectra:
    """Return the spectrum in every pixel that explains the doses, (n, H, W) in Gy, of all films.

    The fluences minimise the squared errors of the doses without being negative; where doses are
    unknown, the spectrum relative to the usual one is as straight as its curvature allows: the
    usual bend from film to film, as a share of the mean spectrum. The usual spectrum, of the mean
    doses, falls exponentially from film to film and beyond the last.

    Films are in the order of the pack, on the same pixels. Errors, (n, H, W), are standard
    deviations as shares of the doses, infinite where a dose is unknown; a dose of exactly zero has
    no error to weight it by, and counts as unknown. An `InputError` if shapes do not fit, doses are
    negative, or the films are in another order.
    """
    film_doses, shares = np.asarray(doses, np.float64), np.asarray(errors, np.float64)
    count = len(response.doses)
    if film_doses.ndim != 3 or len(film_doses) != count or shares.shape != film_doses.shape:
        raise InputError(
            f"doses have shape {film_doses.shape}, errors {shares.shape}: expected both as "
            f"({count}, height, width), a plane for each film of the pack"
        )
    if not curvature > 0:
        raise InputError(f"curvature is {curvature:g}: expected a number above 0")
    is_known = np.isfinite(shares) & np.isfinite(film_doses)
    if (film_doses[is_known] < 0).any():
        raise InputError("doses are negative: expected those of films against unexposed film")
    report = Reporter(on_progress, should_stop)
    flat = np.where(is_known, film_doses, 0.0).reshape(count, -1).T
    absolute = np.where(is_known, shares * film_doses, 0.0).reshape(count, -1).T
    per_error = np.divide(1.0, absolute, out=np.zeros_like(absolute), where=absolute > 0)
    mean = flat.sum(axis=0) / np.maximum((per_error > 0).sum(axis=0), 1)
    basis = _usual_basis(mean, response)
    bends = basis.bends / curvature
    fluence, variance = np.zeros_like(flat), np.zeros_like(flat)
    for first in range(0, len(flat), 4096):
        report("unfold", first, len(flat))
        part = slice(first, first + 4096)
        spectra = _unfold_pixels(flat[part], per_error[part], basis.matrix, bends)
        fluence[part], variance[part] = spectra
    planes = (count, *film_doses.shape[1:])
    scaled = [(values * basis.usual).T.reshape(planes) for values in (fluence, np.sqrt(variance))]
    typical = np.sqrt((per_error**2).mean(axis=0))
    return Spectra(basis.seen_energies(typical, curvature), *scaled)


def _usual_basis(
    mean: FloatArray, response: ResponseMatrix, *, falls: tuple[float, float] = (0.02, 2.0)
) -> _Basis:
    """Return the basis of the spectrum of the mean doses, extrapolated by its fall at the end.

    There it falls to 1/e within a share of the last energy that is between `falls`.
    """
    check_increasing(response.bands)
    peaks = np.array([band.peak for band in response.bands])
    slope = 0.15 * peaks[-1]  # to start from
    basis = _Basis.of(response, np.exp(-peaks / slope), slope)
    for _ in range(100):
        usual = _peel_spectrum(mean, basis.matrix / basis.usual)
        if len(usual) > 1:
            fall = max(np.log(usual[-2] / usual[-1]), 1e-9)
            shortest, longest = (share * peaks[-1] for share in falls)
            measured_slope = np.clip((peaks[-1] - peaks[-2]) / fall, shortest, longest)
            # Half way, because a slower fall beyond the last film makes the next one faster.
            slope = float(np.sqrt(slope * measured_slope))
        before, basis = basis.usual, _Basis.of(response, usual, slope)
        if (np.abs(usual / before - 1) < 1e-4).all():
            break
    return basis


def _peel_spectrum(mean: FloatArray, matrix: FloatArray) -> FloatArray:
    """Unfold the spectrum from the last film to the first; it is positive."""
    spectrum = np.zeros(len(mean))
    dosed = np.flatnonzero(mean > 0)
    for k in dosed[::-1]:
        remaining = mean[k] - matrix[k, k + 1 :] @ spectrum[k + 1 :]
        # Each film contributes, even if the others explain all of its dose.
        spectrum[k] = max(remaining, 0.05 * mean[k]) / matrix[k, k]
    if not dosed.size:
        return np.ones(len(mean))
    # A film without dose is interpolated from its neighbours.
    return np.exp(np.interp(np.arange(len(mean)), dosed, np.log(spectrum[dosed])))


def _unfold_pixels(
    doses: FloatArray, per_error: FloatArray, matrix: FloatArray, bends: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return spectra in units of the usual one, and their variances."""
    weighed = per_error[:, :, None] * matrix
    sides = per_error * doses
    # The bends refer to a spectrum as strong as the pixel's own.
    ratio = np.where(per_error > 0, doses / matrix.sum(axis=1), np.nan)
    strength = np.ones(len(doses))
    some = (per_error > 0).any(axis=1)
    strength[some] = np.nanmedian(ratio[some], axis=1)
    strength = np.where(np.isfinite(strength) & (strength > 0), strength, 1.0)
    ties = bends / strength[:, None, None]
    normal = weighed.transpose(0, 2, 1) @ weighed + ties.transpose(0, 2, 1) @ ties
    normal += 1e-12 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(matrix.shape[1])
    inverse = np.linalg.inv(normal)
    shares = (inverse @ (weighed.transpose(0, 2, 1) @ sides[:, :, None]))[:, :, 0]
    nothing = np.zeros(len(bends))
    for k in np.flatnonzero((shares < 0).any(axis=1)):
        shares[k] = nnls(np.concatenate([weighed[k], ties[k]]), np.append(sides[k], nothing))[0]
    return shares, np.diagonal(inverse, axis1=1, axis2=2)
