from .field_grid import FieldGrid, field_grid
from .forward import jacobian_determinant, synthetic_image
from .particle_flight import TracedParticles, trace_particles
from .phantoms import Phantom, ellipse_pair, gaussian_blob, toroid
from .poisson import poisson_invert
from .projection import predict_image, transferred_displacement
from .setup import OpticalSetup, ProtonSetup, Setup, setup_from_dict
from .trace_options import TraceOptions
from .tracing import TracedImage, trace

__all__ = [
    "FieldGrid",
    "OpticalSetup",
    "Phantom",
    "ProtonSetup",
    "Setup",
    "TraceOptions",
    "TracedImage",
    "TracedParticles",
    "ellipse_pair",
    "field_grid",
    "gaussian_blob",
    "jacobian_determinant",
    "poisson_invert",
    "predict_image",
    "setup_from_dict",
    "synthetic_image",
    "toroid",
    "trace",
    "trace_particles",
    "transferred_displacement",
]
