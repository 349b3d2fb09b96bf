"""Shadowgrams and proton radiographs to deflection potentials and line-integrated fields.

- invert an image: `invert`, with `InversionOptions`; the answer is an `Inversion`
- how well beam, detector and alignment are known, for its errors: `Instrument`
- currents, fluxes, profiles and maps of a result, with their bands: `analyse`
- an image and all that is known of it: `Shot`
- several images of one object, folds, an unknown beam: `fit`, with `FitOptions`; the answer is a
  `Fit` with a verdict
- deflections in SI units: `ProtonSetup`, `OpticalSetup`
- all steps from an image to its field, as one model: `Recipe`; apply it: `run`; to many shots, with
  dask: `run_stack`
- repeat a result from its provenance: `rerun`
- predict an image: `synthetic_image`; in another experiment: `predict_image`; invert it linearly:
  `poisson_invert`; trace particles through a 3-D field: `trace`
- plan an experiment by simulated shots: `plan_experiment`
- read and write files: `read`, `write`
- show a result in a napari viewer: `add_to_viewer`

Arrays are ``[y, x]``, vectors in axis order (y, x), a pixel's centre is at its integer
index, and lengths are object-plane pixels unless a setup makes them SI.
"""

import lazy_loader

__version__ = "0.1.0"

# Names are imported when they are first used: numba and scipy take a second to load.
__getattr__, __dir__, _names = lazy_loader.attach_stub(__name__, __file__)
__all__ = [*_names, "__version__"]
