from .calibration import (
    Calibration,
    CombinedDose,
    DoseMap,
    combined_dose,
    dose,
    net_optical_density,
)
from .other_detectors import (
    Luminescence,
    TrackImage,
    Tracks,
    fading,
    fuji_luminescence,
    ge_luminescence,
)
from .pack import FilmType, Material, Pack, PackLayer, Slab, Stopping
from .scans import read_corners, write_corners

__all__ = [
    "Calibration",
    "CombinedDose",
    "DoseMap",
    "FilmType",
    "Luminescence",
    "Material",
    "Pack",
    "PackLayer",
    "Slab",
    "Stopping",
    "TrackImage",
    "Tracks",
    "combined_dose",
    "dose",
    "fading",
    "fuji_luminescence",
    "ge_luminescence",
    "net_optical_density",
    "read_corners",
    "write_corners",
]
