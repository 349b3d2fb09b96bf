"""Images of many shots as OME-Zarr: `write_ome_zarr`.

References
----------
OME-NGFF 0.5, https://ngff.openmicroscopy.org/0.5
"""

from __future__ import annotations

import itertools
import math
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from napari_shadowinv._system.hidden_files import hidden_name, sweep
from napari_shadowinv._system.machine import clear_up_when_terminated, defer_interrupts
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.files import check_folder_of

OME_ZARR_SUFFIX = ".ome.zarr"


def write_ome_zarr(
    path: Path,
    name: str,
    channels: Sequence[str],
    count: int,
    plane_of: Callable[[int, int], AnyArray],
    pixel_size: float | None,
) -> Path:
    """Write the planes of many shots as one image with the axes t, c, y and x.

    Parameters
    ----------
    path : Path
        A new folder, ``name.ome.zarr``; it appears completely or not at all.
    name : str
        Of the image.
    channels : sequence of str
        Names of the channels.
    count : int
        Number of shots.
    plane_of : callable
        Returns the plane of a shot and a channel, shape (H, W); it is called once for each.
    pixel_size : float or None
        Size of a pixel in m.

    Raises
    ------
    FileFormatError
        If the folder exists, or cannot be written.
    """
    import zarr

    if path.exists():
        raise FileFormatError(f"{path} exists: choose another name, or remove it")
    check_folder_of(path)
    sweep(path.parent)
    draft = hidden_name(path)
    with clear_up_when_terminated():
        try:
            group, array = zarr.create_group(draft, zarr_format=3), None
            limits = dict.fromkeys(channels, (math.inf, -math.inf))
            for shot, (channel, label) in itertools.product(range(count), enumerate(channels)):
                plane = plane_of(shot, channel)
                if array is None:
                    array = group.create_array(
                        "0",
                        shape=(count, len(channels), *plane.shape),
                        chunks=(1, 1, *plane.shape),
                        dtype="float32",
                        dimension_names=("t", "c", "y", "x"),
                    )
                array[shot, channel] = plane
                low, high = limits[label]
                limits[label] = min(low, float(plane.min())), max(high, float(plane.max()))
            group.attrs["ome"] = _metadata(name, limits, pixel_size)
            with defer_interrupts():
                os.replace(draft, path)
        finally:
            shutil.rmtree(draft, ignore_errors=True)
    return path


def _metadata(
    name: str, limits: Mapping[str, tuple[float, float]], pixel_size: float | None
) -> dict[str, Any]:
    """Return the metadata of an image of one resolution, with the limits of each channel."""
    unit = {} if pixel_size is None else {"unit": "micrometer"}
    side = 1.0 if pixel_size is None else 1e6 * pixel_size
    axes = [
        {"name": "t", "type": "time"},
        {"name": "c", "type": "channel"},
        {"name": "y", "type": "space", **unit},
        {"name": "x", "type": "space", **unit},
    ]
    scale = [{"type": "scale", "scale": [1.0, 1.0, side, side]}]
    channels = [
        {
            "label": label,
            "active": True,
            "color": "FFFFFF",
            "window": {"start": low, "end": high, "min": low, "max": high},
        }
        for label, (low, high) in limits.items()
    ]
    datasets = [{"path": "0", "coordinateTransformations": scale}]
    image = {"name": name, "axes": axes, "datasets": datasets}
    return {"version": "0.5", "multiscales": [image], "omero": {"channels": channels}}
