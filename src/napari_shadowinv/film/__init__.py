"""Films and CR-39: from their scans to doses and counts.

- corners of films on a scan as tables: `read_corners`, `write_corners`
- doses: `Calibration`, `dose`, `combined_dose`, `net_optical_density`
- packs: `Pack`; `napari_shadowinv.pipeline.run_film` evaluates them by the modules `scans`,
  `registration` and `unfolding`
- CR-39: `Tracks`, `TrackImage`
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
