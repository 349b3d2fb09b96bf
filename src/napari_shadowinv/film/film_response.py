"""Response of the films of a pack to protons of each energy: `Response`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.film.pack import Pack, Slab
from napari_shadowinv.film.stopping import PROTON_MASS, Stopping

__all__ = ["Band", "Response", "relative_strengths"]

_MEV = 1.602176634e-13  # J
_MIN_ENERGY_MEV = 0.5
_MAX_ENERGY_MEV = 200.0
_ENERGIES = 6000
_BAND_SHARE = 0.5  # of the peak


@dataclass(frozen=True)
class Band:
    """Energies to which a film is most sensitive, in MeV.

    Attributes
    ----------
    peak : float
        Energy of the protons that lose most energy in the film: they stop there.
    low, high : float
        Energies around the peak at which they lose half as much.
    """

    peak: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Response:
    """Energy that one proton loses in the active layer of each film.

    Attributes
    ----------
    energies : ndarray, shape (n,)
        Of protons in front of the pack, in MeV, increasing.
    deposits : ndarray, shape (layers, n)
        Energy that they lose in each active layer, in MeV.
    doses : ndarray, shape (layers, n)
        Dose in Gy by one proton per m².
    """

    energies: FloatArray
    deposits: FloatArray
    doses: FloatArray

    @classmethod
    def of(cls, pack: Pack, energies: ArrayLike | None = None) -> Response:
        """Compute the response of a pack.

        Parameters
        ----------
        pack : Pack
        energies : array_like, shape (n,), optional
            In MeV. Default: so close together that each film's peak is well resolved.

        Raises
        ------
        InputError
            If an energy is above the range of a stopping table.
        """
        stoppings = pack.stoppings()
        last = min(_MAX_ENERGY_MEV, *(stopping.energies[-1] for stopping in stoppings.values()))
        inside = (
            np.geomspace(_MIN_ENERGY_MEV, last, _ENERGIES)
            if energies is None
            else np.asarray(energies)
        )
        first = np.array(inside, dtype=np.float64)
        deposits, doses = [], []
        now = first
        for layer in pack.layers:
            film = pack.film(layer)
            before = _behind(stoppings, (*layer.filters, *film.before), now)
            after = _behind(stoppings, (film.active,), before)
            mass = stoppings[film.active.material].density * film.active.thickness  # kg/m²
            deposits.append(before - after)
            doses.append((before - after) * _MEV / mass)
            now = _behind(stoppings, film.behind, after)
        return cls(first, np.stack(deposits), np.stack(doses))

    @property
    def bands(self) -> tuple[Band, ...]:
        """Band of each film.

        Raises
        ------
        InputError
            If no proton of these energies reaches a film.
        """
        bands = []
        for number, deposit in enumerate(self.deposits, 1):
            top = int(np.argmax(deposit))
            if not deposit[top] > 0:
                raise InputError(
                    f"no proton of up to {self.energies[-1]:.4g} MeV reaches film {number}: check "
                    "the thicknesses of the pack, which are in m"
                )
            above = np.flatnonzero(deposit >= _BAND_SHARE * deposit[top])
            first = above[0]
            # The first gap ends it; protons that are much faster cross all films.
            gaps = np.flatnonzero(np.diff(above[above >= top]) > 1)
            last = above[above >= top][gaps[0]] if gaps.size else above[-1]
            low, peak, high = (float(self.energies[k]) for k in (first, top, last))
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
