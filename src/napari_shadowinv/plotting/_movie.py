"""Films: one variable of a stack, shot after shot, on one colour scale."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io.files import replacing
from napari_shadowinv.io.store_shots import check_images
from napari_shadowinv.physics.units import display_unit, prefix_for, takes_prefix
from napari_shadowinv.plotting._panels import choose_grid, image_scale, new_page, own_style

if TYPE_CHECKING:
    import xarray

_COLOUR_MAP = "viridis"
_H264 = {"quality": 8, "macro_block_size": 2, "ffmpeg_log_level": "quiet"}  # 10 is lossless
_RECORDED = ("image", "source", "mask")  # shown under masks, too


def stack_frames(
    stack: xarray.Dataset, variable: str | None = None, *, limits: tuple[float, float] | None = None
) -> Iterator[NDArray[np.uint8]]:
    """Yield one variable of every shot as a picture, (rows, columns, 3), all on one colour scale.

    The stack is that of a store; the variable, by default the potential, has an image for each
    shot, or vectors, whose magnitude is shown. The limits of the scale are in the variable's own
    units; by default the smallest and largest value of all shots, but for a few shots that stick
    out. Rows and columns are even numbers. An `InputError` if there is no such variable.
    """
    setup = setup_from_dataset(stack)
    if variable is None:
        variable = "potential" if setup is None else "potential_si"
    check_images(stack, [variable])
    field = stack[variable]
    used = None if variable in _RECORDED else stack.get("mask")
    low, high = _limits(field, used) if limits is None else limits
    if not high > low:
        raise InputError(f"limits are {low:g} and {high:g}: the second must be larger")
    unit = str(field.attrs.get("units", ""))
    factor, prefix = prefix_for(max(abs(low), abs(high))) if takes_prefix(unit) else (1.0, "")
    label = f"{field.attrs.get('long_name', variable)} ({prefix}{display_unit(unit)})"
    shape = field.sizes["y"], field.sizes["x"]
    planes = (
        (factor * _plane(field, index, used), str(stack["name"].values[index]))
        for index in range(field.sizes["shot"])
    )
    common = None if "setup" in stack else setup  # otherwise shots may differ in their pixels
    return _draw_frames(planes, shape, common, label, (factor * low, factor * high))


def _plane(field: xarray.DataArray, index: int, used: xarray.DataArray | None) -> FloatArray:
    values = np.asarray(field.isel(shot=index).values, dtype=np.float64)
    plane: FloatArray = values if values.ndim == 2 else np.sqrt((values**2).sum(axis=0))
    if used is None:
        return plane
    mask = np.asarray(used.isel(shot=index) if "shot" in used.dims else used, dtype=bool)
    return np.where(mask, plane, np.nan)


def _limits(
    field: xarray.DataArray, used: xarray.DataArray | None, *, outliers: float = 0.02
) -> tuple[float, float]:
    """Return the ends of the colour scale; a share of the shots may lie beyond each."""
    planes = (_plane(field, index, used) for index in range(field.sizes["shot"]))
    extremes = np.array([(np.nanmin(plane), np.nanmax(plane)) for plane in planes])
    low = float(np.quantile(extremes[:, 0], outliers, method="lower"))
    high = float(np.quantile(extremes[:, 1], 1 - outliers, method="higher"))
    if "component" in field.dims:
        low = 0.0
    return low, high if high > low else low + 1.0


def _draw_frames(
    planes: Iterable[tuple[FloatArray, str]],
    shape: tuple[int, int],
    setup: Any,
    label: str,
    limits: tuple[float, float],
) -> Iterator[NDArray[np.uint8]]:
    grid = choose_grid(shape, 1, title=False)
    lines = textwrap.wrap(label, max(12, int(grid.height / 0.075)))
    grid = replace(grid, right_margin=grid.right_margin + 0.15 * (len(lines) - 1))
    with new_page(grid, image_scale(shape, setup), None) as (figure, (panel,)):
        # Without values: the colour bar must not depend on the first shot.
        panel.show(np.full(shape, limits[0]), "", "\n".join(lines), _COLOUR_MAP, limits)
    canvas: Any = figure.canvas
    for plane, name in planes:
        panel.hatch_gaps(plane)
        panel.axes.images[0].set_data(plane)
        with own_style():
            panel.axes.set_title(name)
            figure.set_dpi(120)
            canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())[..., :3]
        rows, columns = (length - length % 2 for length in pixels.shape[:2])
        yield np.ascontiguousarray(pixels[:rows, :columns])


def write_film(
    path: Path, frames: Iterable[NDArray[np.uint8]], rate: float, *, overwrite: bool = False
) -> int:
    """Write the frames of a stack as a film, whole or not at all; return their number.

    The film is an ``.mp4`` or ``.gif`` with a rate of frames a second. A `FileFormatError` if it
    exists and `overwrite` does not allow to replace it, or it cannot be written.
    """
    with replacing(path, overwrite) as temporary, TemporaryDirectory() as folder:
        draft = Path(folder, f"film{path.suffix.lower()}")
        try:
            count = _encode(draft, frames, rate)
        except FileFormatError:  # of the shots
            raise
        except OSError as error:
            reason = str(error).partition("\n")[0]
            raise FileFormatError(
                f"{path} cannot be written ({reason}): free some disk space, or write a .gif"
            ) from None
        temporary.write_bytes(draft.read_bytes())
    return count


def _encode(path: Path, frames: Iterable[NDArray[np.uint8]], rate: float) -> int:
    import imageio.v2 as iio

    is_gif = path.suffix == ".gif"
    form = {"duration": 1000 / rate, "loop": 0} if is_gif else {"fps": rate, **_H264}
    count = 0
    # In memory: on a full disk the writer of GIF, once deleted, would print tracebacks.
    target = BytesIO() if is_gif else path
    film: Any = iio.get_writer(target, format=path.suffix, mode="I", **form)
    with film:
        for frame in frames:
            film.append_data(frame)
            count += 1
    if isinstance(target, BytesIO):
        path.write_bytes(target.getvalue())
    else:
        from imageio_ffmpeg import count_frames_and_secs

        try:
            n_readable = count_frames_and_secs(str(path))[0]
        except RuntimeError:  # nothing of it
            n_readable = 0
        if n_readable != count:
            raise OSError(f"ffmpeg: {n_readable} of {count} frames can be read back")
    return count
