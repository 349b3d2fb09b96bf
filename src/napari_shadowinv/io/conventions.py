"""Conventions of HDF5 files for the values of images.

- values without packing: `decode_values`; an image with its mask, notes and pixel size:
  `read_meaning`

Each convention is applied where a file uses it: packed and missing values of CF (NetCDF); factors,
pixel masks, limits and pixel sizes of NeXus; the order of axes of MATLAB 7.3.

References
----------
NetCDF Climate and Forecast Metadata Conventions, section 8.1 and 2.5.1, https://cfconventions.org

NeXus definitions of NXdata, NXdetector and NXmx, https://manual.nexusformat.org
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.arrays import METRES
from napari_shadowinv._typing import AnyArray, BoolArray
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.hdf5 import load_dataset, member, plain_value

_PACKED = ("scale_factor", "add_offset", "_FillValue", "missing_value", "_Unsigned")
_LIMITS = ("valid_range", "valid_min", "valid_max")


def decode_values(path: Path, dataset: Any, values: AnyArray, number: int | None) -> AnyArray:
    """Return the values that an array stands for, NaN where it has none.

    `number` is that of a frame over all leading axes; None for the whole array.
    """
    if is_of_matlab(dataset):  # what is beside it is other variables
        return values
    attributes = _attributes(dataset, (*_PACKED, *_LIMITS))
    stored = values
    if attributes.keys() & set(_PACKED):
        values = _unpack(values, attributes)
    if attributes.keys() & set(_LIMITS):
        low, high = np.ravel(attributes.get("valid_range", (-math.inf, math.inf)))
        low, high = attributes.get("valid_min", low), attributes.get("valid_max", high)
        values = np.where((stored >= low) & (stored <= high), values, np.nan)
    offset, factor = (
        _nexus_number(path, dataset, name, number) for name in ("offset", "scaling_factor")
    )
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


def _nexus_number(path: Path, dataset: Any, name: str, number: int | None) -> float | None:
    """Return a number next to an array, for the array alone or for its group."""
    title = dataset.name.rpartition("/")[2]
    for key in (f"{title}_{name}", name):
        item = member(path, dataset.parent, key)
        if item is None or not hasattr(item, "dtype") or item.dtype.kind not in "iuf":
            continue
        numbers = np.ravel(load_dataset(path, item)).astype(float)
        if numbers.size == 1:
            return float(numbers[0])
        if number is not None and numbers.size == math.prod(dataset.shape[:-2]):
            return float(numbers[number])
        raise FileFormatError(
            f"{path} holds {numbers.size} numbers in {key!r} for {dataset.name!r}: expected one, "
            "or one for each frame; save the array with the factors applied"
        )
    return None


def read_meaning(
    path: Path, dataset: Any, stored: AnyArray, number: int | None
) -> tuple[AnyArray, dict[str, Any]]:
    """Return an image, NaN at pixels that do not count, and its ``mask``, ``notes``, ``geometry``.

    `stored` are its values as the file has them, `number` is as for `decode_values`.
    """
    image, notes = decode_values(path, dataset, stored, number), []
    if image is not stored:
        notes.append("values converted as the file says (scale, offset, missing values)")
    usable: BoolArray = np.isfinite(image)
    for detector in _detectors(path, dataset):
        unusable = _unusable_pixels(path, detector, dataset, stored, number)
        for name, pixels in unusable.items():
            if pixels.any():
                usable &= ~pixels
                notes.append(f"{int(pixels.sum())} pixels left out, {name} of the file")
    if not usable.all():
        image = np.where(usable, image, np.nan)
    metadata: dict[str, Any] = {"dtype": str(stored.dtype), "bits": 8 * stored.dtype.itemsize}
    if notes:
        metadata["notes"] = tuple(notes)
    if not usable.all():
        metadata["mask"] = usable
    sizes = [size for each in _detectors(path, dataset) if (size := _pixel_size(path, each))]
    return image, metadata | ({"geometry": {"detector_pixel_size": sizes[0]}} if sizes else {})


def _detectors(path: Path, dataset: Any) -> Iterator[Any]:
    """Yield the group of an array, and the detector of its entry if there is only one."""
    if is_of_matlab(dataset):
        return
    yield dataset.parent
    instrument = member(path, dataset.parent.parent, "instrument")
    groups: list[Any] = (
        [] if instrument is None else [member(path, instrument, name) for name in instrument]
    )
    detectors = [
        group
        for group in groups
        if hasattr(group, "keys")
        and (plain_value(group.attrs.get("NX_class", "")) == "NXdetector" or "pixel_mask" in group)
    ]
    if len(detectors) == 1 and detectors[0] != dataset.parent:
        yield detectors[0]


def _unusable_pixels(
    path: Path, detector: Any, dataset: Any, stored: AnyArray, number: int | None
) -> dict[str, BoolArray]:
    """Return the pixels that a detector rejects, by the names of the reasons."""
    unusable: dict[str, BoolArray] = {}
    for name in ("pixel_mask", "detectorSpecific/pixel_mask"):
        item = member(path, detector, name)
        if item is None or item.shape[-2:] != stored.shape or item == dataset:
            continue
        flags = load_dataset(path, item)
        flags = flags.reshape(-1, *stored.shape)
        flags = flags[number if number is not None and len(flags) > 1 else 0]
        # These bits reject a pixel, higher ones only describe it.
        unusable["pixel_mask"] = (flags.astype(np.int64) & 0xFFFF) != 0
        break
    for name, is_beyond in (("saturation_value", np.greater), ("underload_value", np.less)):
        item = member(path, detector, name)
        if item is not None and item.size == 1 and item.dtype.kind in "iuf":
            unusable[name] = is_beyond(stored, np.ravel(load_dataset(path, item))[0])
    return unusable


def _pixel_size(path: Path, detector: Any) -> float | None:
    """Return the side of a detector's square pixels in m, or None."""
    sizes = []
    for name in ("x_pixel_size", "y_pixel_size"):
        item = member(path, detector, name)
        if item is None or item.size != 1 or item.dtype.kind not in "iuf":
            return None
        unit = METRES.get(str(plain_value(item.attrs.get("units", ""))))
        if unit is None:
            return None
        sizes.append(float(np.ravel(load_dataset(path, item))[0]) * unit)
    is_square = sizes[0] > 0 and math.isclose(*sizes, rel_tol=1e-6)
    return sizes[0] if is_square else None


def _attributes(dataset: Any, names: tuple[str, ...]) -> dict[str, Any]:
    # By name: walking all attributes of a damaged file may never end.
    return {name: dataset.attrs[name] for name in names if name in dataset.attrs}
