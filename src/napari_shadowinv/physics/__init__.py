"""Deflections in SI units, and the formation of an image.

- images as users hold them, with axes and units: `arrays`
- the experiment and unit conversions: `setup`; units that are handy to read: `units`
- the image that a displacement makes: `forward`
- particles traced through a field on a 3-D grid: `tracing`, `field_grid`
- the same object in another experiment: `projection`
- the linear inversion, for comparison: `poisson`
- test objects with exact fields: `phantoms`
"""

import lazy_loader

# Setups and units must not wait for the import of numba and scipy.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
