"""Objects whose potential and displacement are known exactly.

- the paper's experiment and its toroidal magnetic field: `paper_setup`, `toroid`
- the structures of its Fig. 6: `four_toroids`, `cosine_ellipses`, `focusing_pair`,
  `opposite_pair`, `coaxial_line`
- a plasma wave, probed by light: `wakefield`, `wakefield_setup`, `plasma_wavelength`
- building blocks, round or elliptical: `gaussian_blob`, `cosine_toroid`; phantoms are
  added with ``+``
- an object that every flip, shift or swap of axes changes: `ellipse_pair`
- the class of all of them: `Phantom`

All take `shape`, the image's height and width; magnetic fields also `setup`, the beam. `center`
is (y, x) in px, may be fractional, and is the image's centre by default. `angle`, in rad, turns
an ellipse's u axis from y towards x. A positive `peak`, in MG µm, deflects positive charges
outwards: the field runs counter-clockwise. An `InputError` refuses a shape or length that is not
positive and a number that is not finite.

The paper is Kasim et al., arXiv:1607.04179.
"""

from napari_shadowinv.physics.phantoms._scenes import (
    coaxial_line,
    cosine_ellipses,
    ellipse_pair,
    focusing_pair,
    four_toroids,
    opposite_pair,
    paper_setup,
)
from napari_shadowinv.physics.phantoms._shapes import Phantom, cosine_toroid, gaussian_blob, toroid
from napari_shadowinv.physics.phantoms._wakefield import (
    plasma_wavelength,
    wakefield,
    wakefield_setup,
)

__all__ = [
    "Phantom",
    "coaxial_line",
    "cosine_ellipses",
    "cosine_toroid",
    "ellipse_pair",
    "focusing_pair",
    "four_toroids",
    "gaussian_blob",
    "opposite_pair",
    "paper_setup",
    "plasma_wavelength",
    "toroid",
    "wakefield",
    "wakefield_setup",
]
