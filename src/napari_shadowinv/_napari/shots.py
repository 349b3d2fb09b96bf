"""Radiographs as layers: one, or a run of them as a lazy stack.

- one image, with what its file tells: `radiograph_layers`
- any image or stack of images: `shot_layer`
- many files along an axis of shots, each read when it is shown: `stack_layers`
- the images in a folder, shot 2 before shot 10: `images_in`
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._napari.frame import Frame, frame_for
from napari_shadowinv._napari.layer_metadata import CAME_WITH, MASK, SHOT, SOURCE, mark
from napari_shadowinv._napari.layers import FullLayerData, intensity_limits
from napari_shadowinv._napari.lazy import lazy_stack
from napari_shadowinv._napari.notifications import show_caution
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.files import in_counting_order
from napari_shadowinv.io.formats import RADIOGRAPH_SUFFIXES

if TYPE_CHECKING:
    from napari_shadowinv.io import Radiograph
    from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup

    Setup = ProtonSetup | OpticalSetup

__all__ = [
    "images_in",
    "radiograph_layers",
    "shot_layer",
    "stack_layers",
]


def radiograph_layers(shot: Radiograph, name: str = "") -> list[FullLayerData]:
    """Describe an image, and its undisturbed beam and mask where the file holds them.

    Parameters
    ----------
    shot : Radiograph
        What was read.
    name : str
        Name of the layer. Default: the file's.

    Returns
    -------
    list of (data, keywords, layer type)
        The source and the mask, if any, and the image above them. Painted pixels of the mask
        cannot be used.
    """
    name = name or ("shot" if shot.path is None else shot.path.stem)
    limits = intensity_limits(shot.image)
    frame = _frame(shot)
    facts = _facts(shot, f"the sample '{name}'" if shot.path is None else shot.path.name)
    image = shot_layer(
        shot.image, name, shot.setup, limits, frame=frame, source=shot.source, **facts
    )
    layers: list[FullLayerData] = []
    if shot.source is not None:
        data, keywords, kind = shot_layer(
            shot.source, f"{name} source", shot.setup, limits, SOURCE, frame=frame, **facts
        )
        layers.append((data, {**keywords, "visible": False}, kind))
    if shot.mask is not None:
        keywords = {
            "name": f"{name} mask",
            "visible": False,
            "metadata": mark(MASK, "", shot.setup, **facts),
            **frame.keywords(stacked=False),
        }
        layers.append(((~shot.mask).astype(np.uint8), keywords, "labels"))
    return [*layers, image]


def shot_layer(
    data: Any,
    name: str,
    setup: Setup | None,
    limits: tuple[float, float],
    role: str | None = SHOT,
    *,
    frame: Frame | None = None,
    **more: Any,
) -> FullLayerData:
    """Describe an image or a stack of images.

    Parameters
    ----------
    data : ndarray or dask array, shape (H, W) or (shots, H, W)
        The image.
    name : str
        Name of the layer.
    setup : ProtonSetup or OpticalSetup or None
        The experiment.
    limits : tuple of float
        Contrast limits; napari would read two shots of a stack to find some.
    role : {"shot", "source"} or None
        What it is, None if that is not known.
    frame : Frame, optional
        Where it lies. Default: as the setup tells.
    **more
        Facts to keep with it; those that are None are left out.

    Returns
    -------
    (data, keywords, layer type)
        The layer.
    """
    frame = frame or frame_for(data.shape, setup)
    known = {key: value for key, value in more.items() if value is not None}
    keywords = {
        "name": name,
        "colormap": "gray",
        "contrast_limits": limits,
        "metadata": mark(role, "intensity", setup, **known),
        **frame.keywords(stacked=data.ndim > 2),
    }
    return data, keywords, "image"


def _facts(shot: Radiograph, origin: str) -> dict[str, Any]:
    """What is known of a file; a layer keeps no more than this of it."""
    return {
        "setup_origin": None if shot.setup is None else f"{CAME_WITH} {origin}",
        "file": dict(shot.metadata) or None,
        "warnings": list(shot.warnings) or None,
        "path": None if shot.path is None else str(shot.path),
    }


def _frame(shot: Radiograph) -> Frame:
    """Pixels of the object plane, if the file tells their size, even where it tells no more."""
    side = dict(shot.metadata.get("geometry") or {}).get("pixel_size")
    if shot.setup is not None or side is None:
        return frame_for(shot.image.shape, shot.setup)
    return Frame(scale=(side * 1e6, side * 1e6), units=("um", "um"))


def images_in(folder: Path) -> list[Path]:
    """List the images in a folder, in the order in which people count.

    Parameters
    ----------
    folder : Path
        A folder; those within it are left alone.

    Returns
    -------
    list of Path
        Files of the most frequent ending that names an image: a table of settings beside a
        run of TIFFs is not a shot.
    """
    files = [
        path
        for path in folder.iterdir()
        if path.suffix.lower() in RADIOGRAPH_SUFFIXES and path.is_file() and path.name[0] != "."
    ]
    counts = Counter(path.suffix.lower() for path in files)
    if not counts:
        return []
    chosen = max(sorted(counts), key=lambda suffix: counts[suffix])
    return in_counting_order(path for path in files if path.suffix.lower() == chosen)


def stack_layers(paths: Sequence[Path], name: str = "") -> list[FullLayerData]:
    """Describe a run of shots as one lazy stack; only the first that can be read is read now.

    Parameters
    ----------
    paths : sequence of Path
        Images of one shape.
    name : str
        Name of the layer. Default: the folder's.

    Returns
    -------
    list of (data, keywords, layer type)
        One image layer over a dask array of shape (shots, H, W). A shot that cannot be read,
        or of another shape, is dark and gives a warning when it is shown.

    Raises
    ------
    FileFormatError
        If none of the files can be read.
    """
    first, at = _first_readable(paths)
    for text in first.warnings:
        show_caution(f"{paths[at].name}: {text}")
    height, width = first.image.shape
    plane_of = partial(_plane_of, shape=(height, width))
    stack = lazy_stack(plane_of, paths, (height, width), ready=first.image, at=at)
    origin = paths[at].name + (f", one of {len(paths)} shots" if len(paths) > 1 else "")
    layer = shot_layer(
        stack,
        name or paths[0].parent.name or "shots",
        first.setup,
        intensity_limits(first.image),
        frame=_frame(first),
        paths=[str(path) for path in paths],
        **_facts(first, origin),
    )
    return [layer]


def _first_readable(paths: Sequence[Path]) -> tuple[Radiograph, int]:
    from napari_shadowinv.io import read_radiograph

    mistakes: list[str] = []
    for index, path in enumerate(paths):
        try:
            return read_radiograph(path), index
        except (FileFormatError, InputError) as error:
            mistakes.append(str(error))
    raise FileFormatError(f"none of {len(paths)} files can be read as a shot: {mistakes[0]}")


def _plane_of(path: Path, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Read one shot of a stack; a stray file does not end the show."""
    from napari_shadowinv.io import read_radiograph

    try:
        image = read_radiograph(path).image
        if image.shape != shape:
            raise InputError(
                f"{path} has {image.shape[0]}×{image.shape[1]} pixels, but the first shot has "
                f"{shape[0]}×{shape[1]}: open it separately"
            )
    except (FileFormatError, InputError) as error:
        warnings.warn(f"this shot is shown as zeros: {error}", stacklevel=2)
        return np.zeros(shape)
    return image
