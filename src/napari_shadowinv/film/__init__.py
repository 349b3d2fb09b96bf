"""Films, CR-39 and image plates: from their scans to doses, counts and luminescence.

- films on a scan: `find_films`, `straighten_film`, `read_corners`, `write_corners`
- pixels without marks and burns: `usable_pixels`, `burnt_edges`
- doses: `Calibration`, `dose`, `combined_dose`, `net_optical_density`
- packs, and the response of each film to protons of each energy: `Pack`, `Response`
- alignment of the films of a pack: `register`, `poses_by_fiducials`, `move_corners`,
  `check_orientation`
- fluences at each energy from the doses of all films: `unfold`
- CR-39: `Tracks`, `TrackImage`
- image plates: `fuji_luminescence`, `ge_luminescence`, `fading`
"""

from napari_shadowinv.film.calibration import (
    Calibration,
    CombinedDose,
    DoseMap,
    combined_dose,
    dose,
    net_optical_density,
    unexposed_pixel,
)
from napari_shadowinv.film.other_detectors import (
    Luminescence,
    TrackImage,
    Tracks,
    fading,
    fuji_luminescence,
    ge_luminescence,
)
from napari_shadowinv.film.pack import FilmType, Material, Pack, PackLayer, Slab, Stopping
from napari_shadowinv.film.registration import (
    Poses,
    check_orientation,
    move_corners,
    poses_by_fiducials,
    register,
)
from napari_shadowinv.film.scans import (
    burnt_edges,
    find_films,
    read_corners,
    straighten_film,
    usable_pixels,
    write_corners,
)
from napari_shadowinv.film.unfolding import Band, Response, Spectra, unfold

__all__ = [
    "Band",
    "Calibration",
    "CombinedDose",
    "DoseMap",
    "FilmType",
    "Luminescence",
    "Material",
    "Pack",
    "PackLayer",
    "Poses",
    "Response",
    "Slab",
    "Spectra",
    "Stopping",
    "TrackImage",
    "Tracks",
    "burnt_edges",
    "check_orientation",
    "combined_dose",
    "dose",
    "fading",
    "find_films",
    "fuji_luminescence",
    "ge_luminescence",
    "move_corners",
    "net_optical_density",
    "poses_by_fiducials",
    "read_corners",
    "register",
    "straighten_film",
    "unexposed_pixel",
    "unfold",
    "usable_pixels",
    "write_corners",
]
