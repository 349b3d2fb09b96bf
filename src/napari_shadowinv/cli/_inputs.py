"""What a command reads: options, the setup, images and fields."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_shadowinv.errors import FileFormatError, InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from napari_shadowinv.cli._choices import Choices
    from napari_shadowinv.io import Radiograph
    from napari_shadowinv.options import InversionOptions
    from napari_shadowinv.physics.setup import Setup


@dataclass(frozen=True)
class Experiment:
    """A shot with what it takes to understand it; without a source, the beam is uniform."""

    shot: Radiograph
    source: Radiograph | None = None
    setup: Setup | None = None
    doubts: tuple[str, ...] = ()
    """Of a source that was not measured."""


def options_from(
    path: Path | None,
    flags: Mapping[str, Any],
    clip_negative: bool,
    *,
    other_tables: Collection[str] = (),
) -> InversionOptions:
    """Options from a file, with flags on top; `other_tables` of the file are for others to read."""
    from napari_shadowinv._system.validation import validated
    from napari_shadowinv.io import read_toml
    from napari_shadowinv.options import InversionOptions

    content = {} if path is None else read_toml(path)
    chosen = {name: value for name, value in content.items() if name not in other_tables}
    chosen |= flags
    if clip_negative:
        chosen["negative"] = "clip"
    return validated(InversionOptions, chosen, "options" if path is None else str(path))


def check_margin(margin: int | None, options: InversionOptions) -> None:
    """Refuse --margin where the boundary is closed: it would do nothing."""
    if margin is not None and options.boundary != "free":
        raise InputError("received --margin: it needs --boundary free")


def experiment_from(
    image: Path,
    source: Path | None,
    setup: Path | None,
    channel: str | None,
    factor: int,
    mask: Path | None = None,
    *,
    variable: str | None = None,
    source_variable: str | None = None,
    choices: Choices | None = None,
    source_mask: Path | None = None,
) -> Experiment:
    """Read what is to be inverted, binned alike and prepared as asked for."""
    from napari_shadowinv.cli._choices import Choices
    from napari_shadowinv.io import read_radiograph, read_toml
    from napari_shadowinv.physics.setup import binned_setup

    entries = None if setup is None else read_toml(setup)
    shot = read_radiograph(image, channel=channel, variable=variable)
    if mask is not None:
        shot = replace(shot, mask=_mask_of(mask, shot, "mask"))
    geometry = shot.setup
    if entries is not None:
        geometry = _setup(entries, shot.metadata.get("geometry", {}), str(setup))
    if geometry is not None:
        geometry = binned_setup(geometry, factor)
    beam: Radiograph | None
    if source is not None or source_variable is not None:
        beam = read_radiograph(source or image, channel=channel, variable=source_variable)
    else:
        beam = _own_source(image, shot, choices)
    bare = None if source_mask is None else _mask_of(source_mask, shot, "source mask")
    shot, beam, doubts = _prepared(shot, beam, factor, choices or Choices(), bare, geometry)
    return Experiment(shot, beam, geometry, doubts)


def _own_source(path: Path, shot: Radiograph, choices: Choices | None) -> Radiograph | None:
    """Source from the shot's own file: some hold the image with and without the object."""
    if shot.source is None or (choices is not None and choices.source_from is not None):
        return None
    if choices is not None and choices.flattens:
        raise InputError(
            f"{path} contains its own source, but a filter would flatten the image: leave the "
            "filter out, or replace the source with --source-from uniform"
        )
    return replace(shot, image=shot.source, source=None, mask=None)


def _prepared(
    shot: Radiograph,
    beam: Radiograph | None,
    factor: int,
    choices: Choices,
    bare: NDArray[np.bool_] | None,
    setup: Setup | None,
) -> tuple[Radiograph, Radiograph | None, tuple[str, ...]]:
    """Filter a shot and its source, broken pixels before they are summed and the rest after."""
    from napari_shadowinv.cli._preparing import estimated, filtered, repaired

    whole = bare
    if bare is not None:
        whole = replace(shot, mask=bare).binned(factor).mask
    if beam is not None and beam.mask is None and beam.image.shape == shot.image.shape:
        # A broken pixel is broken in both.
        beam = replace(beam, mask=shot.mask)
    shot = filtered(repaired(shot, choices).binned(factor), choices)
    if beam is None:
        return shot, *estimated(shot, choices, whole, setup)
    return shot, filtered(repaired(beam, choices).binned(factor), choices), ()


def picture_mask(path: Path) -> NDArray[np.bool_]:
    """Mask from a picture, in which what must not be looked at is 0."""
    from napari_shadowinv.io import read_radiograph

    mask: NDArray[np.bool_] = read_radiograph(path, channel="mean").image != 0
    return mask


def _mask_of(path: Path, shot: Radiograph, name: str) -> NDArray[np.bool_]:
    """Mask from a picture that must be of the shot's size."""
    usable = picture_mask(path)
    if usable.shape != shot.image.shape:
        raise InputError(
            f"{path}: {name} has shape {usable.shape}, image {shot.image.shape}: they must match"
        )
    return usable


def setup_from(path: Path) -> Setup:
    """Setup from a file that tells all of it."""
    from napari_shadowinv.io import read_toml

    return _setup(read_toml(path), {}, str(path))


def _setup(entries: Mapping[str, Any], known: Mapping[str, Any], where: str) -> Setup:
    """Setup from a file's entries; what they leave out comes from the image's own file."""
    from napari_shadowinv.physics.setup import setup_from_dict

    if "kind" in known and entries.get("kind", known["kind"]) != known["kind"]:
        known = {}
    elif known and "kind" not in known:
        # A text image tells distances, and of particles the energy, but not what flew.
        kind = "optical" if "wavelength" in entries else "proton"
        known = {**known, "kind": entries.get("kind", kind)}
        if known["kind"] == "optical":
            known.pop("energy", None)
    pixel_sizes = {"pixel_size", "detector_pixel_size"}
    if pixel_sizes & entries.keys():
        known = {name: value for name, value in known.items() if name not in pixel_sizes}
    return setup_from_dict({**known, **entries}, where)


@dataclass(frozen=True)
class Field:
    """A displacement in px, and where the file has them the source and setup that made it."""

    displacement: NDArray[np.float64]
    source: NDArray[np.float64] | None = None
    setup: Setup | None = None


def field_from(path: Path, variable: str | None = None) -> Field:
    """Displacement from a result, or from an array of px or px²."""
    from napari_shadowinv.inversion.labels import setup_from_dataset
    from napari_shadowinv.io import read_dataset
    from napari_shadowinv.io.formats import kind_of
    from napari_shadowinv.io.images import read_npy

    kind = kind_of(path)
    if variable is not None or kind == "mat":
        return Field(_displacement(path, _named_array(path, variable)))
    if kind in ("hdf5", "shadowinv"):
        dataset = read_dataset(path)
        source = dataset["source"].values if "source" in dataset else None
        return Field(dataset["displacement"].values, source, setup_from_dataset(dataset))
    if kind == "npy":
        return Field(_displacement(path, read_npy(path)))
    raise _no_field(path, f"a {kind.upper()} picture")


def _named_array(path: Path, variable: str | None) -> NDArray[Any]:
    """Plane of a MATLAB file, or array of any HDF5 file."""
    from napari_shadowinv.io import read_radiograph
    from napari_shadowinv.io.formats import kind_of
    from napari_shadowinv.io.hdf5 import read_hdf5

    if variable is not None and kind_of(path) in ("hdf5", "shadowinv"):
        return read_hdf5(path, variable)
    return read_radiograph(path, variable=variable).image


def _displacement(path: Path, array: NDArray[Any]) -> NDArray[np.float64]:
    from napari_shadowinv.inversion.labels import displacement_from_potential

    if array.ndim == 2:
        return displacement_from_potential(array)
    if array.ndim == 3 and array.shape[0] == 2:
        return array.astype(float)
    raise _no_field(path, f"an array of shape {array.shape}")


def _no_field(path: Path, found: str) -> FileFormatError:
    return FileFormatError(
        f"{path} is {found}: expected a .shadowinv result, or NPY with a displacement "
        "(2, height, width) in px or a potential (height, width) in px²"
    )
