"""Conventions of HDF5 files for the values of images.

- values without packing: `decode_values`; an image with its mask and notes: `read_meaning`

Each convention is applied where a file uses it: packed and missing values of CF (NetCDF); factors
and pixel masks of NeXus; the order of axes of MATLAB 7.3.

References
----------
NetCDF Climate and Forecast Metadata Conventions, section 8.1 and 2.5.1, https://cfconventions.org

NeXus definitions of NXdata, NXdetector and NXmx, https://manual.nexusformat.org
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._typing import AnyArray, BoolArray
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.hdf5 import load_dataset, member

_PACKED = ("scale_factor", "add_offset", "_FillValue", "missing_value", "_Unsigned")


def decode_values(path: Path, dataset: Any, values: AnyArray) -> AnyArray:
    """Return the values that an array, or a frame of it, stands for, NaN where it has none."""
    if is_of_matlab(dataset):  # what is beside it is other variables
        return values
    # By name: walking all attributes of a damaged file may never end.
    attributes = {name: dataset.attrs[name] for name in _PACKED if name in dataset.attrs}
    if attributes:
        values = _unpack(values, attributes)
    offset = _nexus_number(path, dataset, "offset")
    factor = _nexus_number(path, dataset, "scaling_factor")
    if offset is not None or factor is not None:
        values = (values + np.float64(offset or 0.0)) * (1.0 if factor is None else factor)
    return values


def is_of_matlab(dataset: Any) -> bool:
    """Return whether MATLAB 7.3 wrote an array: with its axes turned round, columns first."""
    return "MATLAB_class" in dataset.attrs


def _unpack(values: AnyArray, attributes: dict[str, Any]) -> AnyArray:
    import xarray as xr

    variable = xr.Variable([f"axis_{k}" for k in range(values.ndim)], values, attributes)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of two values that both mean missing
        unpacked = xr.conventions.decode_cf_variable("array", variable, decode_times=False)
        return np.asarray(unpacked.values)


def _nexus_number(path: Path, dataset: Any, name: str) -> float | None:
    """Return a number next to an array, for the array alone or for its group."""
    title = dataset.name.rpartition("/")[2]
    for key in (f"{title}_{name}", name):
        item = member(dataset.parent, key)
        if getattr(getattr(item, "dtype", None), "kind", "") not in tuple("iuf"):
            continue
        numbers = np.ravel(load_dataset(path, item))
        if numbers.size != 1:
            raise FileFormatError(
                f"{path} holds {numbers.size} numbers in {key!r} for {dataset.name!r}: expected "
                "one; save the array with the factors applied"
            )
        return float(numbers[0])
    return None


def read_meaning(
    path: Path, dataset: Any, stored: AnyArray, number: int | None
) -> tuple[AnyArray, dict[str, Any]]:
    """Return an image, NaN at pixels that do not count, and its ``mask`` and ``notes``.

    `stored` are its values as the file has them, `number` that of the frame.
    """
    image, notes = decode_values(path, dataset, stored), []
    if image is not stored:
        notes.append("values converted as the file says (scale, offset, missing values)")
    usable: BoolArray = np.isfinite(image)
    rejected = _rejected_pixels(path, dataset, stored.shape, number or 0)
    if rejected is not None and rejected.any():
        usable &= ~rejected
        notes.append(f"{int(rejected.sum())} pixels left out, pixel_mask of the file")
    metadata: dict[str, Any] = {"dtype": str(stored.dtype), "bits": 8 * stored.dtype.itemsize}
    if notes:
        metadata["notes"] = tuple(notes)
    if not usable.all():
        image, metadata["mask"] = np.where(usable, image, np.nan), usable
    return image, metadata


def _rejected_pixels(
    path: Path, dataset: Any, shape: tuple[int, ...], number: int
) -> BoolArray | None:
    """Return the pixels that the mask in the array's group, or of its only detector, rejects."""
    if is_of_matlab(dataset):
        return None
    instrument = member(dataset.parent.parent, "instrument")
    groups = [dataset.parent, *(member(instrument, name) for name in instrument or ())]
    masks = [member(group, "pixel_mask") for group in groups]
    fitting = [item for item in masks if item is not None and item.shape[-2:] == shape]
    if not fitting or (len(fitting) > 1 and fitting[0].parent != dataset.parent):
        return None
    if fitting[0] == dataset:
        return None
    flags = load_dataset(path, fitting[0]).reshape(-1, *shape)
    # The lower 16 bits reject a pixel, higher ones only describe it.
    rejected: BoolArray = (flags[number if len(flags) > 1 else 0].astype(np.int64) & 0xFFFF) != 0
    return rejected
