"""Arrays as users hold them: numpy's, and xarray's labelled ones.

- values in the order of the axes: `unpack_array`; real numbers: `plain_array`
- values without numpy's masked ones: `refuse_masked`
- numbers as floats: `as_numbers`; a plane of them: `check_plane`; a mask: `check_mask`
- two masks together: `join_masks`; enough usable pixels: `check_usable`
- size of a pixel by the coordinates: `coordinate_spacing`
- blocks of a plane: `block_sums`, `block_means`, `complete_block_means`
- places of values in their order: `order_by_value`; a `checksum`

Everything else, dask arrays included, passes through untouched.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError

PLANE = ("y", "x")
VECTOR = ("component", *PLANE)
PIXELS, SQUARE_PIXELS = "px", "px²"

_UNNAMED = re.compile(r"dim_\d+")  # xarray's names for dimensions that got none
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "nm": 1e-9}
METRES |= {"metre": 1.0, "meter": 1.0, "micrometer": 1e-6, "micron": 1e-6, "millimeter": 1e-3}
_UNITS = {PIXELS: ("px", "pixel"), SQUARE_PIXELS: ("px²", "pixel**2")}  # the last of datasets


def unpack_array(values: Any, name: str, dims: Sequence[str] = PLANE, *, unit: str = "") -> Any:
    """Return the values in the order of `dims`.

    `name` is for messages. Raises an `InputError` if values are masked or in another unit than
    `unit`, dimensions have other names, or pixels are not square.
    """
    if isinstance(values, (str, PurePath)):
        raise InputError(
            f"{name} is the file {values}, expected an array: read it first, as in "
            f'read("{values}").image'
        )
    if hasattr(values, "image"):
        raise InputError(f"{name} is a {type(values).__name__}, expected an array: give its .image")
    if _is_labelled(values):
        values = _order_axes(values, name, dims, unit)
    if isinstance(values, (list, tuple)):
        try:
            return np.asarray(values)
        except ValueError:
            raise InputError(
                f"{name} is a list whose parts have different lengths: expected an array"
            ) from None
    return refuse_masked(values, name)


def plain_array(values: Any, name: str, dims: Sequence[str] = PLANE, *, unit: str = "") -> AnyArray:
    """Return real numbers in the order of `dims`."""
    plain: AnyArray = np.asarray(unpack_array(values, name, dims, unit=unit))
    if plain.dtype.kind not in "buif":
        raise InputError(f"{name} has values of type {plain.dtype}, expected real numbers")
    return plain


def refuse_masked(values: Any, name: str) -> Any:
    """Return the values, unless some are masked."""
    if not isinstance(values, np.ma.MaskedArray):
        return values
    if count := int(np.ma.getmaskarray(values).sum()):
        raise InputError(
            f"{name} has {count} masked values, expected none: give {name}.data, and of an image "
            f"its mask as mask=~{name}.mask"
        )
    return values.data


def join_masks(*masks: Any) -> Any:
    """Return where all masks are true; None if there is none."""
    present = [mask for mask in masks if mask is not None]
    if len(present) < 2:
        return present[0] if present else None
    arrays = [np.asarray(mask) for mask in present]
    shapes = {array.shape for array in arrays}
    # Masks that cannot be used are refused by name later.
    if len(shapes) > 1 or any(array.dtype != np.bool_ for array in arrays):
        return present[0]
    return np.logical_and.reduce(arrays)


def check_plane(values: Any, name: str, least: int = 1) -> AnyArray:
    """Return real numbers in two dimensions, `least` or more each way, or raise an `InputError`."""
    array = np.asarray(values)
    if array.ndim != 2:
        raise InputError(
            f"{name} has shape {array.shape}, expected two dimensions (y, x): choose one channel "
            "or one shot"
        )
    if min(array.shape) < least:
        raise InputError(
            f"{name} has shape {array.shape}, expected at least {least} × {least} pixels"
        )
    if array.dtype.kind not in "buif":
        raise InputError(f"{name} has values of type {array.dtype}, expected real numbers")
    return array


def check_finite(name: str, values: FloatArray) -> None:
    """Raise an `InputError` if a value is NaN or infinite."""
    bad = values.size - np.count_nonzero(np.isfinite(values))
    if bad:
        raise InputError(f"{name} has {bad} values that are NaN or infinite: all must be finite")


def check_mask(mask: ArrayLike | None, shape: tuple[int, ...], name: str = "image") -> BoolArray:
    """Return a mask as booleans, all true by default, or raise an `InputError`."""
    if mask is None:
        return np.ones(shape, dtype=np.bool_)
    usable = np.asarray(mask)
    check_shape("mask", usable.shape, shape, name)
    if usable.dtype != np.bool_:
        raise InputError(
            f"mask has values of type {usable.dtype}, expected booleans, true where a pixel is "
            "usable: compare it with a number, as in mask > 0"
        )
    check_usable(usable)
    return usable


def check_usable(
    usable: BoolArray, name: str = "mask", *, share: float = 0.1, side: int = 4
) -> None:
    """Raise an `InputError` if a mask leaves neither a `share` usable nor a square of a `side`."""
    from scipy.ndimage import binary_erosion

    count = int(np.count_nonzero(usable))
    block = np.ones((side,) * usable.ndim)
    if count > share * usable.size or binary_erosion(usable, block).any():
        return
    raise InputError(
        f"{name} leaves {count:,} of {usable.size:,} pixels usable, expected at least "
        f"{side} × {side} next to each other: a mask is true, in a file not "
        "0, where a pixel is usable; in NeXus pixel masks 0 is usable, so invert such a mask"
    )


def check_shape(
    name: str, shape: tuple[int, ...], expected: tuple[int, ...], of: str = "image"
) -> None:
    """Raise an `InputError` if an array does not have the shape of the image, or of `of`."""
    if shape != expected:
        raise InputError(f"{name} has shape {shape}, {of} {expected}: they must match")


def as_numbers(name: str, values: ArrayLike) -> FloatArray:
    """Return a copy of values as floats, or raise an `InputError` that shows the values."""
    try:
        return np.array(refuse_masked(values, name), dtype=np.float64)
    except (TypeError, ValueError) as error:
        text = " ".join(repr(values).split())
        raise InputError(f"{name} is {text:.60}: expected numbers, as many in each row") from error


def coordinate_spacing(values: Any, name: str, *, uneven: float = 1e-2) -> float | None:
    """Return the size of a pixel in m by the coordinates y and x; None if they do not have it.

    Spacings may be `uneven` by this share of their mean.
    """
    if not _is_labelled(values):
        return None
    lengths = []
    for dim in PLANE:
        coordinate = values.coords.get(dim)
        places: AnyArray = np.asarray([] if coordinate is None else coordinate.values)
        if places.ndim != 1 or len(places) < 2 or places.dtype.kind not in "iuf":
            continue
        steps = np.diff(places.astype(np.float64))
        mean = float(steps.mean())
        if not np.isfinite(steps).all() or np.abs(steps - mean).max() > uneven * abs(mean):
            raise InputError(
                f"{name} has coordinates along {dim} that are not evenly spaced: expected pixels "
                "of one size; resample it, or drop the coordinates"
            )
        if metres := METRES.get(str(coordinate.attrs.get("units", "")).strip()):
            lengths.append(abs(mean) * metres)
    if len(lengths) == len(PLANE) and abs(lengths[0] - lengths[1]) > uneven * max(lengths):
        raise InputError(
            f"{name} has pixels of {lengths[0]:.4g} m along y and {lengths[1]:.4g} m along x by "
            "its coordinates: expected square ones; resample it"
        )
    return lengths[0] if lengths else None


def check_spacing(values: Any, name: str, sizes: Sequence[float], *, uneven: float = 1e-2) -> None:
    """Refuse an image whose coordinates contradict all pixel sizes (m) that a setup has."""
    spacing = coordinate_spacing(values, name, uneven=uneven)
    if spacing is None or any(abs(spacing - size) <= uneven * size for size in sizes):
        return
    raise InputError(
        f"{name} has pixels of {spacing:.4g} m by its coordinates, the setup "
        f"{' or '.join(f'{size:.4g} m' for size in sizes)}: correct the one that is wrong, or drop "
        "the coordinates"
    )


def _is_labelled(values: Any) -> bool:
    return all(hasattr(values, name) for name in ("dims", "coords", "transpose", "data"))


def _order_axes(array: Any, name: str, dims: Sequence[str], unit: str) -> Any:
    """Return the values of a labelled array in the order of the dimensions."""
    names = tuple(map(str, array.dims))
    received = str(array.attrs.get("units", unit)).replace(" ", "")
    if unit and received not in ("", *_UNITS[unit]):
        raise InputError(f"{name} has the unit {received!r}, expected {unit!r}: convert it first")
    coordinate_spacing(array, name)
    if all(map(_UNNAMED.fullmatch, names)):
        return array.data
    # Only the plane's axes have names that everybody uses.
    leading = [dim for dim in names if dim.lower() not in PLANE]
    plane = [dim for axis in PLANE for dim in names if dim.lower() == axis]
    if len(plane) != len(PLANE) or len(leading) != len(dims) - len(PLANE):
        step = "rename" if len(names) == len(dims) else "select one of what is too many, or rename"
        raise InputError(
            f"{name} has the dimensions {', '.join(map(repr, names))}, expected "
            f"{', '.join(map(repr, dims))}: {step} them"
        )
    return array.transpose(*leading, *plane).data


def block_sums(planes: FloatArray | BoolArray, side: int, few: int = 8) -> FloatArray:
    """Return sums over square blocks of a plane, or of each of several, without incomplete ones.

    Blocks with `few` pixels a side are summed as NumPy does, which is slow where they have fewer:
    it adds such pixels in turn, as slices do in a quarter of the time.
    """
    height, width = (length // side * side for length in planes.shape[-2:])
    if side < few:
        lines = (planes[..., first:height:side, :width] for first in range(side))
        sums = sum(sum(line[..., first::side] for first in range(side)) for line in lines)
    else:
        blocks = *planes.shape[:-2], height // side, side, width // side, side
        sums = planes[..., :height, :width].reshape(blocks).sum(axis=(-3, -1))
    return np.asarray(sums, dtype=None if planes.dtype.kind == "f" else np.float64)


def complete_block_means(planes: FloatArray | BoolArray, side: int) -> FloatArray:
    """Return means over square blocks, as `block_sums` returns sums."""
    return block_sums(planes, side) / side**2


def block_means(values: FloatArray, block: int) -> FloatArray:
    """Return means over square blocks; incomplete ones at the far edges are mirrored."""
    padding = [(0, -side % block) for side in values.shape]
    return complete_block_means(np.pad(values, padding, mode="symmetric"), block)


def order_by_value(values: FloatArray) -> AnyArray:
    """Return the places of finite values from the lowest to the highest, in single precision.

    Equal values stay in their sequence. NumPy counts integers of 16 bits instead of comparing
    them, so sorting by the two halves of the numbers is several times as fast as `argsort`.
    """
    heights = values - values.min()
    heights /= heights.max() or 1.0
    # The bits of numbers that are not negative are in the order of the numbers.
    bits = heights.astype(np.float32).view(np.uint32)
    order = np.argsort(bits.astype(np.uint16), kind="stable")
    highs = (bits >> 16).astype(np.uint16)
    return np.asarray(order[np.argsort(highs[order], kind="stable")])


def checksum(array: AnyArray) -> str:
    """Return the SHA-256 of an array's values, shape and type, in hexadecimal."""
    digest = hashlib.sha256(f"{array.dtype.str}{array.shape}".encode())
    digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
