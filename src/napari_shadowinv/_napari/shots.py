"""Radiographs as layers, single or as a lazy stack, and layers as radiographs."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv import io
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.layer_metadata import (
    Frame,
    frame_for,
    metadata_for,
    metadata_of,
    source_on,
)
from napari_shadowinv._napari.layers import FullLayerData, LayerData
from napari_shadowinv._napari.preferences import colour_map
from napari_shadowinv._napari.viewer_sync import show_caution
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.files import sha256
from napari_shadowinv.physics.units import intensity_limits
from napari_shadowinv.shot import Shot

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.setup import Setup


def layers_of_shot(shot: Shot, name: str = "") -> LayerData:
    """Describe an image or a stack, above its undisturbed beam and mask of unusable pixels."""
    name = name or ("shot" if shot.path is None else shot.path.stem)
    image = shot.image if shot.image.ndim == 2 else shot.image[len(shot.image) // 2]
    limits = intensity_limits(np.asarray(image))
    frame = _frame(shot)
    layers: LayerData = []
    facts = _facts(shot, f"the sample '{name}'" if shot.path is None else shot.path.name)
    if shot.source is not None:
        data, keywords, kind = shot_layer(
            shot.source, f"{name} source", shot.setup, limits, about.SOURCE, frame=frame, **facts
        )
        layers.append((data, {**keywords, "visible": False}, kind))
    if shot.mask is not None:
        layers.append(_mask_layer(shot.mask, name, frame, shot.setup, **facts))
    layers.append(
        shot_layer(shot.image, name, shot.setup, limits, frame=frame, source=shot.source, **facts)
    )
    return layers


def _mask_layer(
    usable: BoolArray, name: str, frame: Frame, setup: Setup | None = None, **facts: Any
) -> FullLayerData:
    keywords = {
        "name": f"{name} mask",
        "visible": False,
        "metadata": metadata_for(about.MASK, "", setup, **facts),
        **frame.keywords(stacked=False),
    }
    return (~usable).astype(np.uint8), keywords, "labels"


def shot_layer(
    data: Any,
    name: str,
    setup: Setup | None,
    limits: tuple[float, float],
    role: str | None = about.SHOT,
    *,
    frame: Frame | None = None,
    unit: str = "intensity",
    **more: Any,
) -> FullLayerData:
    """Describe an image or a stack of images; omit metadata that are None."""
    frame = frame or frame_for(data.shape, setup)
    metadata = {key: value for key, value in more.items() if value is not None}
    keywords = {
        "name": name,
        "colormap": colour_map("image"),
        "contrast_limits": limits,  # otherwise napari would read two shots of a stack
        "metadata": metadata_for(role, unit, setup, **metadata),
        **frame.keywords(stacked=data.ndim > 2),
    }
    return data, keywords, "image"


def _facts(shot: Shot, origin: str) -> dict[str, Any]:
    """Return the metadata of a file for its layers."""
    return {
        "setup_origin": None if shot.setup is None else f"{about.CAME_WITH} {origin}",
        "file": dict(shot.metadata) or None,
        "cautions": list(shot.cautions) or None,
        "path": None if shot.path is None else str(shot.path),
    }


def _frame(shot: Shot) -> Frame:
    """Return the frame of the object plane, also if a file contains only the pixel size."""
    side = dict(shot.metadata.get("geometry") or {}).get("pixel_size")
    return frame_for(shot.image.shape, shot.setup, pixel_size=side)


def shot_of_layer(layer: Any, image: Any) -> Shot:
    """Return a layer's image, perhaps lazy, as a radiograph with its file."""
    metadata = metadata_of(layer)
    path = metadata.get("path") or layer.source.path
    shot = Shot(image, cautions=tuple(metadata.get("cautions", ())))
    if metadata.get("result") is not None:
        return shot  # processed images differ from their file
    # A plane split off a stack keeps the path of the first file.
    if layer.ndim != 2 or len(metadata.get("paths", ())) > 1 or path is None:
        return shot
    return replace(shot, path=Path(path), metadata=metadata.get("file") or {})


def source_of_shot(layer: Any, data: Any, image: Any) -> Shot:
    """Return a layer's data as the source of an image layer, or of files (None).

    A file of another shot, or of more pixels than the image has, is not the source's.
    """
    beam = shot_of_layer(layer, data)
    if image is None:
        return beam
    on_image = source_on(layer, data, image)
    is_whole = tuple(on_image.shape) == tuple(data.shape)
    with_shot = shot_of_layer(image, image.data).path
    is_own_file = about.role_of(layer) != about.SOURCE or beam.path == with_shot
    if is_whole and is_own_file:
        return beam
    return replace(beam, image=on_image, path=None, metadata={})


def shot_in_memory(shot: Shot, name: str, source_name: str = "") -> Shot:
    """Return a shot with its image and source in memory, and the checksums of their files."""
    from napari_shadowinv.pipeline.inversion_run import plane_of

    metadata = dict(shot.metadata)
    if shot.path is not None and "sha256" not in metadata and shot.path.is_file():
        metadata["sha256"] = sha256(shot.path)
    source = shot.source
    if isinstance(source, Shot):
        source = shot_in_memory(source, source_name)
    return replace(shot, image=plane_of(shot.image, name), source=source, metadata=metadata)


def stack_layers(paths: Sequence[Path], name: str = "") -> LayerData:
    """Describe a run of shots as a lazy stack; only the first readable shot is read now."""
    # Unreadable shots, or shots of another shape, are zero and give a warning when shown.
    first = _first_readable(paths)
    file = "" if first.path is None else first.path.name
    for caution in first.cautions:
        show_caution(f"{file}: {caution.text}")
    height, width = first.image.shape
    origin = file + (f", one of {len(paths)} shots" if len(paths) > 1 else "")
    layer = shot_layer(
        lazy_stack(partial(_plane_of, shape=(height, width)), paths, (height, width)),
        name or paths[0].parent.name or "shots",
        first.setup,
        intensity_limits(first.image),
        frame=_frame(first),
        paths=[str(path) for path in paths],
        **_facts(first, origin),
    )
    return [layer]


def frame_layers(frames: xarray.Dataset, name: str) -> LayerData:
    """Describe the frames of one file as a lazy stack."""
    images = frames["image"].data
    layers = [shot_layer(images, name, None, intensity_limits(np.asarray(images[0])))]
    if "mask" in frames:
        layers.insert(0, _mask_layer(frames["mask"].values, name, frame_for(images.shape, None)))
    return layers


def lazy_stack(
    make: Callable[..., FloatArray], items: Sequence[Any], shape: tuple[int, int]
) -> Any:
    """Stack the planes that `make` returns for items, a chunk each."""
    from dask import array
    from dask.delayed import delayed

    delayed_make = delayed(make, pure=True)
    planes = [
        array.from_delayed(delayed_make(item), shape=shape, dtype=np.float64)  # type: ignore[no-untyped-call]
        for item in items
    ]
    return array.stack(planes)  # type: ignore[no-untyped-call]


def _first_readable(paths: Sequence[Path]) -> Shot:
    messages: list[str] = []
    for path in paths:
        try:
            return io.read_shot(path)
        except (FileFormatError, InputError) as error:
            messages.append(str(error))
    raise FileFormatError(f"none of {len(paths)} files can be read as a shot: {messages[0]}")


def _plane_of(path: Path, shape: tuple[int, int]) -> FloatArray:
    """Read a shot of a stack; return zeros for a stray file."""
    try:
        image = io.read_shot(path).image
        if image.shape != shape:
            raise InputError(
                f"{path} has {image.shape[0]}×{image.shape[1]} pixels, but the first shot has "
                f"{shape[0]}×{shape[1]}: open it separately"
            )
    except (FileFormatError, InputError) as error:
        warnings.warn(f"this shot is shown as zeros: {error}", stacklevel=2)
        return np.zeros(shape)
    return image
