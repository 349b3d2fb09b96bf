"""Preparation of a shot for its inversion, and the recipe of it.

- the shot: `Shot`; the recipe: `Recipe`
- whether image and source look right: `image_cautions`; a source in register with its image:
  `register_source`
- steps: `Dark`, `Rotate`, `Crop`, `Bin`, and filters by name in `FILTERS`
- estimates of the source by name in `ESTIMATES`
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
