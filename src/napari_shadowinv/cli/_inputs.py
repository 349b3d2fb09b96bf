"""What a command reads: options, the setup, images and fields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_shadowinv.errors import FileFormatError, InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from napari_shadowinv.io import Radiograph
    from napari_shadowinv.options import InversionOptions
    from napari_shadowinv.physics.setup import Setup


@dataclass(frozen=True)
class Experiment:
    """A shot with what it takes to understand it; without a source, the beam is uniform."""

    shot: Radiograph
    source: Radiograph | None = None
    setup: Setup | None = None


def options_from(
    path: Path | None, flags: Mapping[str, Any], clip_negative: bool
) -> InversionOptions:
    """Options from a file, with flags on top."""
    from napari_shadowinv.io import read_toml
    from napari_shadowinv.options import InversionOptions
    from napari_shadowinv.validation import validated

    chosen = {} if path is None else read_toml(path)
    chosen |= {name: value for name, value in flags.items() if value is not None}
    if clip_negative:
        chosen["negative"] = "clip"
    return validated(InversionOptions, chosen, "options" if path is None else str(path))


def experiment_from(
    image: Path,
    source: Path | None,
    setup: Path | None,
    channel: str | None,
    factor: int,
    mask: Path | None = None,
) -> Experiment:
    """Read what is to be inverted, binned alike."""
    from napari_shadowinv.io import binned_setup, read_radiograph, read_toml

    entries = None if setup is None else read_toml(setup)
    shot = read_radiograph(image, channel=channel)
    if mask is not None:
        shot = _masked(shot, mask)
    beam = None if source is None else read_radiograph(source, channel=channel)
    geometry = shot.setup
    if entries is not None:
        geometry = _setup(entries, shot.metadata.get("geometry", {}), str(setup))
    if geometry is not None:
        geometry = binned_setup(geometry, factor)
    return Experiment(shot.binned(factor), None if beam is None else beam.binned(factor), geometry)


def _masked(shot: Radiograph, path: Path) -> Radiograph:
    """Give a shot the mask from a picture in which unusable pixels are 0."""
    from napari_shadowinv.io import read_radiograph

    usable = read_radiograph(path, channel="mean").image != 0
    if usable.shape != shot.image.shape:
        raise InputError(
            f"{path}: mask has shape {usable.shape}, image {shot.image.shape}: they must match"
        )
    return replace(shot, mask=usable)


def setup_from(path: Path) -> Setup:
    """Setup from a file that tells all of it."""
    from napari_shadowinv.io import read_toml

    return _setup(read_toml(path), {}, str(path))


def _setup(entries: Mapping[str, Any], known: Mapping[str, Any], where: str) -> Setup:
    """Setup from a file's entries; what they leave out comes from the image's own file."""
    from napari_shadowinv.physics.setup import setup_from_dict

    if entries.get("kind", known.get("kind")) != known.get("kind"):
        known = {}
    pixel_sizes = {"pixel_size", "detector_pixel_size"}
    if pixel_sizes & entries.keys():
        known = {name: value for name, value in known.items() if name not in pixel_sizes}
    return setup_from_dict({**known, **entries}, where)


def field_from(
    path: Path,
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None, Setup | None]:
    """Displacement, and where the file has them its source and setup."""
    from napari_shadowinv.io import read_dataset, setup_from_dataset
    from napari_shadowinv.io.arrays import read_npy
    from napari_shadowinv.io.dataset import displacement_from_potential
    from napari_shadowinv.io.files import kind_of

    kind = kind_of(path)
    if kind == "hdf5":
        dataset = read_dataset(path)
        source = dataset["source"].values if "source" in dataset else None
        return dataset["displacement"].values, source, setup_from_dataset(dataset)
    array = read_npy(path) if kind == "npy" else None
    if array is not None and array.ndim == 2:
        return displacement_from_potential(array), None, None
    if array is not None and array.ndim == 3 and array.shape[0] == 2:
        return array.astype(float), None, None
    found = f"a {kind.upper()} picture" if array is None else f"an array of shape {array.shape}"
    raise FileFormatError(
        f"{path} is {found}: expected a .shadowinv result, or NPY with a displacement "
        "(2, height, width) in px or a potential (height, width) in px²"
    )
