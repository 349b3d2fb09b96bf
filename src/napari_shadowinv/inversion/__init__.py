"""Inversion of an image to its deflection potential.

- invert an image: `invert`
- prepare the sites once for many images with one source: `plan_sites`
- results: `Inversion`, with a `Report`, and the `Cells` that the solver found
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
