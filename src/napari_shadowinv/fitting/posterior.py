"""What the data leave open around the best unknowns, by the Gauss-Newton Hessian: `Posterior`.

References
----------
D. J. C. MacKay, Neural Comput. 4, 415 (1992); S. Ubaru, J. Chen and Y. Saad, SIAM J. Matrix Anal.
Appl. 38, 1075 (2017).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.fft import dctn
from scipy.linalg import eigh_tridiagonal

from napari_shadowinv._typing import FloatArray, IntArray
from napari_shadowinv.fitting.descent import Preconditioner
from napari_shadowinv.fitting.forward import Scene
from napari_shadowinv.fitting.minimise import product, solve
from napari_shadowinv.fitting.unknowns import Unknowns

__all__ = ["Posterior"]

_ROUGHLY, _CLOSELY, _MOST_STEPS = 0.05, 0.02, 150
_BESIDE_BEAM, _MOST_BESIDE_BEAM = 0.002, 600  # what beam and field can trade is found last
_PROBES, _LANCZOS = 4, 25
_LEAST_DETERMINED = 1e-3  # coefficients
_OVERSHOOT, _MOST_CHANGE = 1.7, 15.0  # of λ in a step; it would approach its end too slowly


class Posterior:
    """The Gaussian around unknowns at which a scene's objective is least.

    Parameters
    ----------
    scene, unknowns
        What is explained, and how.
    rng : numpy.random.Generator
        For all random choices.
    after_step : callable, optional
        Called often, to tell of progress and to be stopped.
    """

    def __init__(
        self,
        scene: Scene,
        unknowns: Unknowns,
        rng: np.random.Generator,
        after_step: Callable[[], None] | None = None,
    ) -> None:
        self._scene, self._unknowns, self._rng = scene, unknowns, rng
        self._counts: list[IntArray] = scene.ray_counts(unknowns)
        self._scales = Preconditioner(scene)
        self._after_step = after_step or (lambda: None)

    def likely_smoothness(self) -> tuple[FloatArray, float]:
        """Return λ and κ nearer to the likeliest, shape (M, 2), and by how much they have changed.

        Each holds as much against the field as there are coefficients that the data determine and
        it would. The change is the logarithm's, weighted with that number.
        """
        prior, smoothness = self._scene.prior, self._scene.smoothness
        determined, energy = np.empty(smoothness.shape), np.empty(smoothness.shape)
        for m in range(len(smoothness)):
            each, whole = prior.of_rough[m], prior.of_rough[m].sum(axis=0)
            signs = self._rng.choice([-1.0, 1.0], whole.shape)
            slope = self._unknowns.zeros()
            slope.potentials[m] = prior.root_of_smoothness(m, signs)
            solved = self._scales.times(self._unknowns.like(self._solved(slope, _ROUGHLY)))
            left = np.sqrt(whole) * signs * dctn(solved.potentials[m], norm="ortho")
            shares = np.divide(each, whole, out=np.zeros_like(each), where=whole > 0)
            determined[m] = np.maximum((shares * (1 - left)).sum(axis=(1, 2)), _LEAST_DETERMINED)
            waves = dctn(self._unknowns.potentials[m], norm="ortho")
            energy[m] = (each * waves**2).sum(axis=(1, 2))
        ratio = np.clip(determined / np.maximum(energy, 1e-300), 1 / _MOST_CHANGE, _MOST_CHANGE)
        change = np.log(ratio) * _OVERSHOOT
        weights = determined / determined.sum(axis=1, keepdims=True)
        return smoothness * np.exp(change), float((np.abs(change) * weights).sum(axis=1).max())

    def drawn(self) -> Unknowns:
        """Return a random change of the unknowns, as large as the data leave possible."""
        noise = self._rng.normal(size=self._scene.images.shape)
        slope = self._scene.pulled(self._unknowns, self._counts, noise)
        slope = slope.plus(self._scene.prior.drawn(self._unknowns, self._rng))
        # The longest waves, which the noise moves most, are the last to be found.
        tolerance = _BESIDE_BEAM if self._scene.beam_modes else _CLOSELY
        return self._scales.times(self._unknowns.like(self._solved(slope, tolerance)))

    def log_volume(self) -> float:
        """Return half the logarithm of the Hessian's determinant in the cosines' scales.

        By stochastic Lanczos quadrature.
        """
        # What is fixed has no scale, and no part in the volume; nor what nothing holds.
        ones = self._unknowns.like(np.ones(self._unknowns.flat().size))
        moved = self._scales.times(ones)._replace(potentials=ones.potentials)
        if np.isinf(self._scene.decay):
            moved.potentials[:, 0, 0] = 0
        free = moved.flat() != 0
        size = int(free.sum())
        total = 0.0
        for _ in range(_PROBES):
            signs = free * self._rng.choice([-1.0, 1.0], free.size)
            diagonal, beside = self._lanczos(signs / np.sqrt(size))
            values, vectors = eigh_tridiagonal(diagonal, beside)
            total += size * float((vectors[0] ** 2 * np.log(np.maximum(values, 1e-12))).sum())
        return total / _PROBES / 2 - self._scales.log_size()

    def log_evidence(self) -> float:
        """Return the logarithm of how likely the model makes the data, but for a constant."""
        value, _ = self._scene.value_and_gradient(self._unknowns, self._counts)
        return -value - self.log_volume()

    def _times(self, flat: FloatArray) -> FloatArray:
        self._after_step()
        change = self._scales.times(self._unknowns.like(flat))
        turned = self._scene.hessian_times(self._unknowns, self._counts, change)
        return self._scales.turned(turned).flat()

    def _solved(self, slope: Unknowns, tolerance: float) -> FloatArray:
        """The scaled change of the unknowns that undoes a slope."""
        right = self._scales.turned(slope).flat()
        most = _MOST_BESIDE_BEAM if tolerance == _BESIDE_BEAM else _MOST_STEPS
        return solve(self._times, right, tolerance=tolerance, iterations=most)

    def _lanczos(self, start: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Diagonal and off-diagonal of the Hessian in the space of its first powers."""
        vectors, diagonal, beside = [start], [], []
        for k in range(_LANCZOS):
            image = self._times(vectors[-1])
            diagonal.append(product(image, vectors[-1]))
            for vector in vectors:
                image -= product(image, vector) * vector
            length = float(np.sqrt(product(image, image)))
            if length < 1e-10 or k == _LANCZOS - 1:
                break
            beside.append(length)
            vectors.append(image / length)
        return np.array(diagonal), np.array(beside[: len(diagonal) - 1])
