"""Films, CR-39 and image plates: from their scans to doses, counts and luminescence.

- films on a scan: `find_films`, `straighten_film`, `read_corners`, `write_corners`
- pixels without marks and burns: `usable_pixels`, `burnt_edges`
- doses: `Calibration`, `dose`, `combined_dose`, `net_optical_density`
- packs, and the response of each film to protons of each energy: `Pack`, `ResponseMatrix`
- alignment of the films of a pack: `register`, `poses_by_fiducials`, `move_corners`,
  `check_orientation`
- fluences at each energy from the doses of all films: `unfold`
- CR-39: `Tracks`, `TrackImage`
- image plates: `fuji_luminescence`, `ge_luminescence`, `fading`
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
