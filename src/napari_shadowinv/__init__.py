"""Shadowgrams and proton radiographs to deflection potentials and line-integrated fields.

- invert an image: `invert`, with `InversionOptions`; the answer is an `Inversion`
- share sites between shots with one source: `plan_sites`
- how far the image's noise moves its field: `uncertainty`
- what a deflection means in SI units: `ProtonSetup`, `OpticalSetup`
- many shots, with dask: `invert_stack`, `run_stack`, `stack_statistics`
- clean images, guess undisturbed beams: modules `filters`, `sources`; with all parameters, to be
  applied to each shot: `recipes`
- predict an image, or invert it linearly: `synthetic_image`, `poisson_invert`
- predict the image of the same object in another experiment: `project`, `project_potential`
- read and write files: `read`, `write`
- show a result in a napari viewer: `add_inversion`

Arrays are ``[y, x]``, vectors in axis order (y, x), a pixel's centre is at its integer
index, and lengths are object-plane pixels unless a setup makes them SI.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from napari_shadowinv._napari.layers import add_inversion
    from napari_shadowinv.error_bars import Uncertainty, uncertainty
    from napari_shadowinv.errors import FileFormatError, InputError, InversionCancelled
    from napari_shadowinv.inversion import Inversion, Report, invert, plan_sites
    from napari_shadowinv.io import Radiograph, read, write
    from napari_shadowinv.options import InversionOptions
    from napari_shadowinv.physics.forward import synthetic_image
    from napari_shadowinv.physics.poisson import poisson_invert
    from napari_shadowinv.physics.projection import project, project_potential
    from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup
    from napari_shadowinv.progress import Progress
    from napari_shadowinv.stack import invert_stack, run_stack, stack_statistics

__version__ = "0.1.0"

__all__ = [
    "FileFormatError",
    "InputError",
    "Inversion",
    "InversionCancelled",
    "InversionOptions",
    "OpticalSetup",
    "Progress",
    "ProtonSetup",
    "Radiograph",
    "Report",
    "Uncertainty",
    "__version__",
    "add_inversion",
    "invert",
    "invert_stack",
    "plan_sites",
    "poisson_invert",
    "project",
    "project_potential",
    "read",
    "run_stack",
    "stack_statistics",
    "synthetic_image",
    "uncertainty",
    "write",
]

_HOME = {
    "FileFormatError": "errors",
    "InputError": "errors",
    "Inversion": "inversion",
    "InversionCancelled": "errors",
    "InversionOptions": "options",
    "OpticalSetup": "physics.setup",
    "Progress": "progress",
    "ProtonSetup": "physics.setup",
    "Radiograph": "io",
    "Report": "inversion",
    "Uncertainty": "error_bars",
    "add_inversion": "_napari.layers",
    "invert": "inversion",
    "invert_stack": "stack",
    "plan_sites": "inversion",
    "poisson_invert": "physics.poisson",
    "project": "physics.projection",
    "project_potential": "physics.projection",
    "read": "io",
    "run_stack": "stack",
    "stack_statistics": "stack",
    "synthetic_image": "physics.forward",
    "uncertainty": "error_bars",
    "write": "io",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used: numba and scipy take a second to load."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
