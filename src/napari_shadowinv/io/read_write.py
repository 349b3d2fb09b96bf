"""Read any file, and write results and images.

- any file: `read`, whose content decides on the format, not its name; where only one kind makes
  sense: `read_shot`, `read_dataset`
- one frame of many: `read_frame`
- a file with options or a setup: `read_toml`
- a result or an image, whole or not at all: `write`; a result becomes one NetCDF4 file,
  ``.shadowinv``, or a table of its sites
"""

from __future__ import annotations

import re
import tomllib
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._system.safety import as_file_errors, small_text
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.facts import ResultKind
from napari_shadowinv.io.files import check_output, replacing, sha256, split_address
from napari_shadowinv.io.formats import (
    IMAGE_WRITERS,
    format_of,
    formats_for,
    function,
    suffixes_for,
)
from napari_shadowinv.io.frames import FileFrame, find_frames, lazy_frames
from napari_shadowinv.io.hdf5 import check_arrays, check_hdf5_seal, seal_hdf5
from napari_shadowinv.io.images import film_cautions, to_grey
from napari_shadowinv.io.store import is_stack, read_stack
from napari_shadowinv.shot import Shot

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.results import AnyResult

# The parser takes memory and time with the square of a key's parts.
_DEEPEST_KEY = 16
_KEY_PART = r"""(?:[A-Za-z0-9_-]+|"[^"\n]*"|'[^'\n]*')"""
_DEEP_KEY = re.compile(
    rf"(?<![A-Za-z0-9_.-]){_KEY_PART}(?:[ \t]*\.[ \t]*{_KEY_PART}){{{_DEEPEST_KEY}}}"
)
_DISTANCES = {"source_object_distance", "object_image_distance"}


def read(
    path: str | Path, *, channel: str | int | None = None, variable: str | None = None
) -> Shot | xarray.Dataset:
    """Read an image or a result, or many images lazily.

    Parameters
    ----------
    path : str or Path
        TIFF (8, 16 or 32 bits) and other pictures, NPY, MATLAB (version 5 to 7.3), frames
        of cameras, numbers as text, tracks in CR-39, a pradformat radiograph, an array
        of any HDF5 file as ``file.h5::/entry/data/data``, a ``.shadowinv`` result, or a
        ``.shadowinv.zarr`` store of many shots (read lazily). Of many images, a TIFF with several
        pages, an array with more than two axes, a folder, or a pattern such as ``"shots/*.tif"``.
    channel : {"red", "green", "blue", "mean"} or int, optional
        Channel to take from a colour image whose channels differ.
    variable : str, optional
        Name of the array to take from a MATLAB file that holds several, or from any HDF5 file,
        with its groups: ``"shots/3/image"``; ``"entry/data/data[3]"`` is one frame of many.

    Returns
    -------
    Shot or xarray.Dataset
        A dataset for a result; a dataset with the variable ``image``
        (shot, y, x) for many images, which dask reads one by one; a radiograph for all else.

    Raises
    ------
    FileFormatError
        If the file is missing, empty, damaged or of a kind that cannot be read.
    InputError
        If the channel or variable is needed and was not chosen, or does not exist.
    """
    split_address(path, variable)  # refuses what is no path
    return _read(path, channel, variable)


@as_file_errors
def _read(path: Path, channel: str | int | None, variable: str | None) -> Shot | xarray.Dataset:
    if is_stack(path):
        return read_stack(path)
    frames = find_frames(path, variable)
    if len(frames) > 1:
        return lazy_frames(frames, partial(read_frame, channel=channel))
    return _read_file(frames[0].path, channel, frames[0].variable)


def read_frame(frame: FileFrame, *, channel: str | int | None = None) -> Shot:
    """Read one of the frames that a path stands for, with the errors of `read_shot`."""
    if frame.number is None:
        return read_shot(frame.path, channel=channel, variable=frame.variable)
    content = _read_file(frame.path, channel, frame.variable, frame.number)
    assert isinstance(content, Shot)
    return content


@as_file_errors
def _read_file(
    path: Path, channel: str | int | None, variable: str | None, number: int | None = None
) -> Shot | xarray.Dataset:
    file_format = format_of(path)
    if variable is not None and not file_format.named_reader:
        raise InputError(
            f"{path} is neither a MATLAB nor an HDF5 file (its kind is {file_format.name!r}): "
            f"variable {variable!r} does not apply; leave it out"
        )
    content: xarray.Dataset | tuple[AnyArray, dict[str, Any]] = file_format.read(
        path, variable, number
    )
    if not isinstance(content, tuple):
        return content
    array, metadata = content
    facts: dict[str, Any] = {
        "kind": file_format.name,
        "dtype": str(array.dtype),
        "bits": 8 * array.dtype.itemsize,
        # All frames share their file, and are too many to read it for each.
        **({"sha256": sha256(path)} if number is None else {}),
        **metadata,
    }
    if array.dtype.kind not in "buif":
        raise FileFormatError(
            f"{path} holds {array.dtype} pixels: expected whole or real numbers; convert them"
        )
    image = to_grey(array, channel, path)
    if not np.isfinite(image).any():
        raise FileFormatError(
            f"{path} holds no finite pixel: expected an image; check how the file was saved"
        )
    if channel is not None:
        facts["channel"] = channel
    mask = facts.pop("mask", None)
    setup = _complete_setup(path, metadata.get("geometry", {}))
    doubts = film_cautions(array, channel) if file_format.is_scan else ()
    return Shot(
        image=image,
        metadata=facts,
        mask=mask,
        setup=setup,
        setup_in_file=setup,
        path=path,
        cautions=(*doubts, *facts.pop("cautions", ())),
    )


def _complete_setup(path: Path, geometry: dict[str, Any]) -> Setup | None:
    from napari_shadowinv.physics.setup import SETUPS, setup_from_dict

    # A geometry with an energy belongs to a beam of particles, with a wavelength to light.
    kinds = [kind for kind, model in SETUPS.items() if model.beam_field in geometry]
    has_pixels = not {"pixel_size", "detector_pixel_size"}.isdisjoint(geometry)
    if not kinds or not (geometry.keys() >= _DISTANCES and has_pixels):
        return None
    names = geometry.keys() & SETUPS[kinds[0]].model_fields.keys()
    entries = {name: geometry[name] for name in names}
    return setup_from_dict({"kind": kinds[0], **entries}, str(path))


def read_shot(
    path: str | Path, *, channel: str | int | None = None, variable: str | None = None
) -> Shot:
    """Read one image, as by `read`; a result or many images raise a `FileFormatError`, too."""
    path, variable = split_address(path, variable)
    content = read_stack(path) if is_stack(path) else _read_file(path, channel, variable)
    if not isinstance(content, Shot):
        raise FileFormatError(f"{path} is a result: expected an image; give the original image")
    return content


def read_dataset(path: str | Path) -> xarray.Dataset:
    """Read a ``.shadowinv`` file or a ``.shadowinv.zarr`` store.

    The dataset has at least the displacement. It raises the errors of `read`, and a
    `FileFormatError` if the file holds an image.
    """
    content = read(path) if is_stack(path) or "result" in format_of(path).holds else None
    if content is None or isinstance(content, Shot):
        raise FileFormatError(
            f"{path} is an image: expected the result of an inversion, .shadowinv"
        )
    return content


@as_file_errors
def read_toml(path: Path) -> dict[str, Any]:
    """Return the keys and values of a TOML file.

    A `FileFormatError` if it is missing or cannot be opened; an `InputError`, which names the line,
    if it is not TOML.
    """
    text = small_text(path, "a TOML file")
    if deep := _DEEP_KEY.search(text):
        line = text.count("\n", 0, deep.start()) + 1
        raise InputError(
            f"{path}, line {line} has a key of more than {_DEEPEST_KEY} parts: expected keys such "
            "as options.seed; check that it is the right file"
        )
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path} is not valid TOML: {error}") from None
    except RecursionError:
        raise InputError(
            f"{path} has tables or lists nested too deeply: check that it is the right file"
        ) from None


def write_result(content: BytesIO, dataset: xarray.Dataset) -> None:
    """Write a dataset as NetCDF4, moderately compressed and with a checksum."""
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    encoding: dict[str, dict[str, Any]] = {}
    for name, variable in dataset.variables.items():
        packed = {"zlib": True, "shuffle": True, "complevel": 4} if variable.size > 64 else {}
        kind = variable.dtype.kind
        if kind in "fiub":
            # What the index loses is read as NaN, not as 0.
            fill = {"_FillValue": np.nan if kind == "f" else None}
            encoding[str(name)] = {**packed, **fill}
    # A field that was read from a file of another format still says so.
    marked = dataset.assign_attrs(format=ResultKind.of(dataset.attrs).value)
    with h5netcdf.File(content, "w") as file:
        marked.dump_to_store(H5NetCDFStore(file), encoding=encoding)
    seal_hdf5(content)


def read_result(path: Path) -> xarray.Dataset:
    """Read a dataset that `write_result` wrote, all of it into memory."""
    import xarray as xr

    check_hdf5_seal(path)
    check_arrays(path)
    # Nothing in it is a time, whatever its units look like.
    return xr.load_dataset(path, engine="h5netcdf", decode_times=False)


def write(
    path: str | Path,
    result: AnyResult | xarray.Dataset | AnyArray,
    *,
    setup: Setup | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a result or an image in the format that the path's ending names.

    Parameters
    ----------
    path : str or Path
        For a result: ``.shadowinv`` for all of it, ``.h5`` for pradformat, of a fit for its field
        alone. For an image: ``.tif`` (float32), ``.npy``, ``.png`` (16 bits, its largest value
        white).
    result : Inversion, Fit, FilmDoses, xarray.Dataset, or ndarray of shape (H, W)
        Result or image to write.
    setup : Setup, optional
        Adds SI units; pradformat needs it. A dataset, a fit and film doses bring their own.
    overwrite : bool
        Whether an existing file may be replaced.

    Returns
    -------
    Path

    Raises
    ------
    FileFormatError
        If the file exists and must not be replaced, its folder cannot be written, or the
        ending names no format for this.
    InputError
        If pradformat is asked for without the setup of a particle beam, or a setup is given for
        a fit or film doses.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> write(folder / "ones.tif", np.ones((3, 4))).name
    'ones.tif'
    """
    if isinstance(result, np.ndarray):
        check_output(path, overwrite, suffixes=IMAGE_WRITERS)
        if result.ndim != 2 or result.size == 0:
            raise InputError(f"image has shape {result.shape}: expected (height, width)")
        pixel_size = None if setup is None else setup.object_pixel_size
        writer = IMAGE_WRITERS[Path(path).suffix.lower()]
        return _write_whole(path, overwrite, writer, result, pixel_size)
    dataset = _as_dataset(result, setup)
    kind = ResultKind.of(dataset.attrs)
    check_output(path, overwrite, suffixes=suffixes_for(kind))
    suffix = Path(path).suffix.lower()
    (file_format,) = (each for each in formats_for(kind) if suffix in each.suffixes)
    return _write_whole(path, overwrite, file_format.result_writer, dataset)


def _write_whole(path: str | Path, overwrite: bool, writer: str, *content: Any) -> Path:
    """Make a file in memory, and write it in one go: on a full disk, HDF5 would end the process."""
    with replacing(path, overwrite) as temporary:
        file = BytesIO()
        function(writer)(file, *content)
        temporary.write_bytes(file.getvalue())
    return Path(path)


def _as_dataset(result: Any, setup: Setup | None) -> xarray.Dataset:
    is_dataset = hasattr(result, "data_vars")  # without waiting for xarray's import
    if is_dataset or setup is None:
        dataset: xarray.Dataset = result if is_dataset else result.to_dataset()
        return dataset
    from napari_shadowinv.inversion import Inversion

    if isinstance(result, Inversion):
        return result.in_units(setup).to_dataset()
    raise InputError(f"received a setup for a {result.kind.noun}, which has its own: leave it out")
