from __future__ import annotations
import numpy as np
from scipy.fft import dctn, idctn
from napari_shadowinv.fitting.minimise import solve, product
from napari_shadowinv.fitting.rays import KNOT
from napari_shadowinv.fitting.stages import Preconditioner


def smoothness(scene, unknowns, counts, seed=0):
    """λ at which the field is as rough as the data's share of its coefficients lets it be."""
    rng = np.random.default_rng(seed)
    pre = Preconditioner(scene)
    nothing = unknowns.like(np.zeros(unknowns.flat().size))
    found = []
    def times(flat):
        change = pre.times(unknowns.like(flat))
        return pre.turned(scene.hessian_times(unknowns, counts, change)).flat()
    rough = scene.roughness(unknowns)
    for m, lam in enumerate(scene.smoothness):
        signs = rng.choice([-1.0, 1.0], scene.rays.shape)
        root = np.sqrt(lam) * KNOT * scene._wave_numbers**2 * signs
        right = nothing._replace(potentials=nothing.potentials.copy())
        right.potentials[m] = idctn(root, norm="ortho")
        b = pre.turned(right).flat()
        its=[0]
        x = solve(times, b, tolerance=0.03, iterations=60, after_step=lambda k: its.__setitem__(0,k))
        gamma = root.size - product(b, x)
        found.append((gamma, gamma / rough[m], its[0]))
    return found
