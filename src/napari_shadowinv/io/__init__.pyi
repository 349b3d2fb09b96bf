from .cpsa import read_tracks
from .field_grids import is_field_grid, read_field_grid
from .files import check_output, replacing
from .read_write import read, read_dataset, read_shot, read_toml, write
from .store import is_stack, read_stack

__all__ = [
    "check_output",
    "is_field_grid",
    "is_stack",
    "read",
    "read_dataset",
    "read_field_grid",
    "read_shot",
    "read_stack",
    "read_toml",
    "read_tracks",
    "replacing",
    "write",
]
