"""Shadowgrams and proton radiographs to deflection potentials and line-integrated fields.

- invert an image: `invert`, with `InversionOptions`; the answer is an `Inversion`
- how well beam, detector and alignment are known, for its errors: `Instrument`, `BeamPrior`
- share sites between shots with one source: `plan_sites`
- how far the image's noise moves its field: `uncertainty`
- currents, fluxes, profiles and maps of a result, with their bands: `analyse`; all products are in
  `napari_shadowinv.analysis`
- an image and all that is known of it: `Shot`
- several images of one object, folds, an unknown beam: `fit`, with `FitOptions`;
  the answer is a `Fit` with a verdict
- deflections in SI units: `ProtonSetup`, `OpticalSetup`
- many shots, with dask: `invert_stack`, `run_stack`, `stack_statistics`; as they arrive in a
  folder: `watch_stack`
- everything that is done to a shot, as one model: `Recipe`; apply it: `run`; its parts, and
  further filters of images and estimates of beams: `napari_shadowinv.preprocessing`
- repeat a result from its provenance: `rerun`; the answer is a `Rerun`
- predict an image, or invert it linearly: `synthetic_image`, `poisson_invert`
- trace particles through a 3-D field: `trace`, with `TraceOptions`, of a `FieldGrid`; the answer
  is a `TracedImage`
- predict the image of the same object in another experiment: `project`, `project_potential`
- read and write files: `read`, `write`
- show a result in a napari viewer: `add_inversion`

Arrays are ``[y, x]``, vectors in axis order (y, x), a pixel's centre is at its integer
index, and lengths are object-plane pixels unless a setup makes them SI.
"""

import lazy_loader

__version__ = "0.1.0"

# Names are imported when they are first used: numba and scipy take a second to load.
__getattr__, __dir__, _names = lazy_loader.attach_stub(__name__, __file__)
__all__ = [*_names, "__version__"]
