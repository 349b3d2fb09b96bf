from .cpsa import read_tracks
from .files import check_output, replacing
from .reading import Radiograph, read, read_cpsa, read_dataset, read_radiograph, read_toml
from .store import is_stack, read_stack
from .writing import write

__all__ = [
    "Radiograph",
    "check_output",
    "is_stack",
    "read",
    "read_cpsa",
    "read_dataset",
    "read_radiograph",
    "read_stack",
    "read_toml",
    "read_tracks",
    "replacing",
    "write",
]
