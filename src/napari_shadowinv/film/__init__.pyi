from .calibration import (
    Calibration,
    CombinedDose,
    DoseMap,
    combined_dose,
    dose,
    net_optical_density,
)
from .pack import FilmType, Material, Pack, PackLayer, Slab, Stopping
from .scans import read_corners, write_corners
from .tracks import TrackImage, Tracks

__all__ = [
    "Calibration",
    "CombinedDose",
    "DoseMap",
    "FilmType",
    "Material",
    "Pack",
    "PackLayer",
    "Slab",
    "Stopping",
    "TrackImage",
    "Tracks",
    "combined_dose",
    "dose",
    "net_optical_density",
    "read_corners",
    "write_corners",
]
