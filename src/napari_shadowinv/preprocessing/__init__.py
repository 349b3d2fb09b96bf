"""Preparation of a shot for its inversion, and the recipe of it.

- the shot: `Shot`; the recipe: `Recipe`
- whether image and source look right: `image_cautions`, `ReferencePair`; a source in register with
  its image: `register_source`
- steps: `Dark`, `Rotate`, `Crop`, `Bin`, and filters by name in `FILTERS`; as functions `low_pass`,
  `high_pass`, `butterworth`, `remove_background`, `remove_hot_pixels`
- estimates of the source by name in `ESTIMATES`; as functions `uniform_source`,
  `isotropic_source`, `gaussian_source`, `polynomial_source`, `low_pass_source`,
  `total_variation_source`, `interpolated_source`, `kriged_source`
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
