from .forward import jacobian_determinant, synthetic_image
from .phantoms import Phantom, ellipse_pair, gaussian_blob, paper_setup, toroid
from .poisson import border_mean, poisson_invert
from .projection import project, project_potential, transferred_displacement
from .setup import OpticalSetup, ProtonSetup, Setup, setup_from_dict

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
