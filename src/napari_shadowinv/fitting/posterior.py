"""Uncertainty of the best unknowns by the Gauss-Newton Hessian: `Posterior`, `Sample`.

References
----------
D. J. C. MacKay, Neural Comput. 4, 415 (1992); S. Ubaru, J. Chen and Y. Saad, SIAM J. Matrix Anal.
Appl. 38, 1075 (2017).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import dctn, idctn
from scipy.linalg import eigh_tridiagonal

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting.descent import Preconditioner
from napari_shadowinv.fitting.forward import Scene
from napari_shadowinv.fitting.minimise import product, solve
from napari_shadowinv.fitting.unknowns import Unknowns

__all__ = ["Posterior", "Sample"]

_ROUGHLY, _CLOSELY = 0.05, 0.002  # the longest waves, which noise moves most, are found last
# It makes the error 1 to 2 % smaller, 0.1 would 1 to 6 %; two sets of samples differ by 10 %.
_OPEN_BEAMS = 0.05
_MOVED_BY_BEAMS = 0.01
_BEAM_MODES = 8
_MOST_STEPS = 600
_PROBES, _LANCZOS = 8, 25
_LEAST_DETERMINED = 1e-3  # coefficients
_OVERSHOOT, _MOST_CHANGE = 1.7, 15.0  # of λ in a step; it would approach its end too slowly


@dataclass(frozen=True)
class Sample:
    """A random change of the unknowns, and the noise that causes it.

    `noise` (L, H, W) are random changes of the data over their standard deviations.
    """

    change: Unknowns
    noise: FloatArray


class Posterior:
    """The Gaussian around unknowns at which a scene's objective is least.

    Parameters
    ----------
    scene, unknowns
        The scene and its best unknowns.
    rng : numpy.random.Generator
        For all random choices.
    after_step : callable, optional
        Called after each step, to report progress and to stop.
    """

    def __init__(
        self,
        scene: Scene,
        unknowns: Unknowns,
        rng: np.random.Generator,
        after_step: Callable[[], None] | None = None,
    ) -> None:
        self._scene, self._unknowns, self._rng = scene, unknowns, rng
        self._counts = scene.ray_counts(unknowns)
        self._linear = scene.linear(unknowns, self._counts)
        self._scales = Preconditioner(scene)
        self._after_step = after_step or (lambda: None)

    @property
    def scene(self) -> Scene:
        """The scene that is explained."""
        return self._scene

    def likely_smoothness(self) -> tuple[FloatArray, float]:
        """Return λ and κ nearer to the likeliest, shape (M, 2), and by how much they have changed.

        Each holds as much against the field as there are coefficients that the data determine and
        it would. The change is the logarithm's, weighted with that number.
        """
        prior, smoothness = self._scene.prior, self._scene.smoothness
        determined, energy = np.empty(smoothness.shape), np.empty(smoothness.shape)
        for m in range(len(smoothness)):
            each, roughness = prior.of_rough[m], prior.of_rough[m].sum(axis=0)
            signs = self._rng.choice([-1.0, 1.0], roughness.shape)
            slope = self._unknowns.zeros()
            slope.potentials[m] = prior.root_of_smoothness(m, signs)
            solved = self._change(slope, _ROUGHLY)
            open_part = np.sqrt(roughness) * signs * dctn(solved.potentials[m], norm="ortho")
            shares = np.divide(each, roughness, out=np.zeros_like(each), where=roughness > 0)
            determined[m] = np.maximum(
                (shares * (1 - open_part)).sum(axis=(1, 2)), _LEAST_DETERMINED
            )
            waves = dctn(self._unknowns.potentials[m], norm="ortho")
            energy[m] = (each * waves**2).sum(axis=(1, 2))
        ratio = np.clip(determined / np.maximum(energy, 1e-300), 1 / _MOST_CHANGE, _MOST_CHANGE)
        change = np.log(ratio) * _OVERSHOOT
        weights = determined / determined.sum(axis=1, keepdims=True)
        return smoothness * np.exp(change), float((np.abs(change) * weights).sum(axis=1).max())

    def draw_sample(self, tolerance: float = _CLOSELY) -> Sample:
        """Return a random change of the unknowns, as large as the data leave possible."""
        noise = self._rng.normal(size=self._scene.images.shape)
        slope = self._linear.pulled(noise)
        slope = slope.plus(self._scene.prior.drawn(self._unknowns, self._rng))
        return Sample(self._change(slope, tolerance), noise)

    def count_determined(self, rng: np.random.Generator) -> float:
        """Estimate how many numbers the data determine: so much of Σχ² the fit absorbs of noise."""
        slope = self._linear.pulled(rng.normal(size=self._scene.images.shape))
        return product(slope.flat(), self._change(slope, _ROUGHLY).flat())

    def moved_by_beams(self, variations: FloatArray) -> Unknowns:
        """Return the change of the unknowns if the beams differ from their sources.

        Parameters
        ----------
        variations : ndarray, shape (L, …)
            Differences as shares of the beams, of the shape of the scene's beams.
        """
        changes = self._scene.changed_by_beams(self._unknowns, self._counts, variations)
        return self._change(self._linear.pulled(changes), _MOVED_BY_BEAMS)

    def open_beams(
        self, variation: float, samples: Sequence[Sample], rng: np.random.Generator
    ) -> list[Unknowns]:
        """Return random differences of a common beam that the images leave possible.

        Parameters
        ----------
        variation : float
            R.m.s. difference that is possible before the images are looked at.
        samples : sequence of Sample
            For the beam as it is; each makes one of the differences.
        rng : numpy.random.Generator
            For the beam's prior.

        Returns
        -------
        list of Unknowns
            The beam's difference, `Scene.with_free_beam`'s, with the change of the other unknowns
            that it causes.

        Notes
        -----
        With J and B the derivatives of the residuals by the unknowns and by the beam's cosines, H
        and P the Hessian and the beam's prior, a sample x = H⁻¹ (Jᵀη + ξ) becomes one of both,
        (x + δ, θ), by

            [H  JᵀB; BᵀJ  BᵀB + P] (δ, θ) = (0, Bᵀ(η - Jx) + P^½ζ),

        which is the response δ = -H⁻¹JᵀBθ to the sampled beam θ.
        """
        freed = self._scene.with_free_beam(_BEAM_MODES, variation)
        weights = freed.prior.beam_weights
        unknowns = self._unknowns._replace(beam=np.zeros(weights.shape))
        posterior = Posterior(freed, unknowns, rng, self._after_step)
        changes = []
        for sample in samples:
            residuals = sample.noise - self._linear.pushed(sample.change)
            pull = posterior._linear.pulled(residuals).beam
            pull += np.sqrt(weights) * rng.normal(size=weights.shape)
            slope = unknowns.zeros()._replace(beam=pull)
            changes.append(posterior._change(slope, _OPEN_BEAMS))
        return changes

    def log_volume(self, chances: Sequence[np.random.Generator]) -> float:
        """Return half the log-determinant of the Hessian relative to the prior of potentials.

        By stochastic Lanczos quadrature, with the same probes for both, and for each field those
        of its own generator: a field that the data do not show adds nothing to others.
        """
        # What is fixed has no scale, and no part in the volume; nor what nothing holds.
        ones = self._unknowns.like(np.ones(self._unknowns.flat().size))
        moved = self._scales.times(ones)._replace(potentials=ones.potentials)
        if np.isinf(self._scene.decay):
            moved.potentials[:, 0, 0] = 0
        free = moved.flat() != 0
        is_potential = np.arange(free.size) < ones.potentials.size
        total = 0.0
        for _ in range(_PROBES):
            of_fields = [chance.choice([-1.0, 1.0], free.size) for chance in chances]
            signs = free * self._signs(of_fields)
            total += self._log_determinant(self._times, signs)
            total -= self._log_determinant(self._prior_times, is_potential * signs)
        return total / _PROBES / 2 - self._scales.log_size()

    def _signs(self, of_fields: Sequence[FloatArray]) -> FloatArray:
        """A probe: each field's from its own, the rest from the first."""
        probe = self._unknowns.like(of_fields[0])
        for m, signs in enumerate(of_fields):
            probe.potentials[m] = self._unknowns.like(signs).potentials[0]
        return probe.flat()

    def log_evidence(self, chances: Sequence[np.random.Generator]) -> float:
        """Return the logarithm of how likely the model makes the data, but for a constant.

        `chances` are the random generators of the fields.
        """
        value, _ = self._scene.value_and_gradient(self._unknowns, self._counts)
        return -value - self.log_volume(chances)

    def _times(self, flat: FloatArray) -> FloatArray:
        self._after_step()
        change = self._scales.times(self._unknowns.like(flat))
        turned = self._linear.hessian_times(change)
        return self._scales.turned(turned).flat()

    def _change(self, slope: Unknowns, tolerance: float) -> Unknowns:
        """The change of the unknowns that undoes a slope."""
        right = self._scales.turned(slope).flat()
        scaled = solve(self._times, right, tolerance=tolerance, iterations=_MOST_STEPS)
        return self._scales.times(self._unknowns.like(scaled))

    def _prior_times(self, flat: FloatArray) -> FloatArray:
        """The potentials' prior in scales in which it is about the identity."""
        like, prior = self._unknowns, self._scene.prior
        scale = 1 / np.sqrt(prior.of_potentials())
        waves = scale * like.like(flat).potentials
        change = like.zeros()._replace(potentials=idctn(waves, axes=(1, 2), norm="ortho"))
        turned = scale * dctn(prior.times(change).potentials, axes=(1, 2), norm="ortho")
        return like.zeros()._replace(potentials=turned).flat()

    def _log_determinant(
        self, times: Callable[[FloatArray], FloatArray], signs: FloatArray
    ) -> float:
        """Estimate the trace of a matrix's logarithm from a probe."""
        size = float(np.abs(signs).sum())
        diagonal, beside = self._lanczos(times, signs / np.sqrt(size))
        values, vectors = eigh_tridiagonal(diagonal, beside)
        return size * float((vectors[0] ** 2 * np.log(np.maximum(values, 1e-12))).sum())

    def _lanczos(
        self, times: Callable[[FloatArray], FloatArray], start: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Diagonal and off-diagonal of a matrix in the space of its first powers."""
        vectors, diagonal, beside = [start], [], []
        for k in range(_LANCZOS):
            image = times(vectors[-1])
            diagonal.append(product(image, vectors[-1]))
            for vector in vectors:
                image -= product(image, vector) * vector
            length = float(np.sqrt(product(image, image)))
            if length < 1e-10 or k == _LANCZOS - 1:
                break
            beside.append(length)
            vectors.append(image / length)
        return np.array(diagonal), np.array(beside[: len(diagonal) - 1])
