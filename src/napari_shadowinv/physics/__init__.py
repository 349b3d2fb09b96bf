"""What a deflection means in SI units, and how an image comes about.

- the experiment and unit conversions: `setup`
- the image that a displacement makes: `forward`
- the same object in another experiment: `projection`
- the linear inversion, for comparison: `poisson`
- test objects with exact fields: `phantoms`
"""

from napari_shadowinv.physics.forward import jacobian_determinant, synthetic_image
from napari_shadowinv.physics.phantoms import (
    Phantom,
    ellipse_pair,
    gaussian_blob,
    paper_setup,
    toroid,
)
from napari_shadowinv.physics.poisson import border_mean, poisson_invert
from napari_shadowinv.physics.projection import (
    project,
    project_potential,
    transferred_displacement,
)
from napari_shadowinv.physics.setup import (
    OpticalSetup,
    ProtonSetup,
    Setup,
    setup_from_dict,
)

__all__ = [
    "OpticalSetup",
    "Phantom",
    "ProtonSetup",
    "Setup",
    "border_mean",
    "ellipse_pair",
    "gaussian_blob",
    "jacobian_determinant",
    "paper_setup",
    "poisson_invert",
    "project",
    "project_potential",
    "setup_from_dict",
    "synthetic_image",
    "toroid",
    "transferred_displacement",
]
