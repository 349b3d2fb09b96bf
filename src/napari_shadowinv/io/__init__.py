"""Files: radiographs in, results out, a module for each family of formats.

- read an image or a result: `read`; only one of them: `read_radiograph`, `read_dataset`
- an image with what is known about it: `Radiograph`; sum its pixels: `Radiograph.binned`
- write a result or an image: `write`; check the path beforehand: `check_output`
- results of many shots in one store: `read_stack`; tell it from other folders: `is_stack`
- write a file of your own, whole or not at all: `replacing`
"""

from napari_shadowinv.io.files import check_output, replacing
from napari_shadowinv.io.reading import read, read_dataset, read_radiograph, read_toml
from napari_shadowinv.io.store import is_stack, read_stack
from napari_shadowinv.io.writing import write
from napari_shadowinv.preprocessing import Radiograph

__all__ = [
    "Radiograph",
    "check_output",
    "is_stack",
    "read",
    "read_dataset",
    "read_radiograph",
    "read_stack",
    "read_toml",
    "replacing",
    "write",
]
