"""Films: one variable of a stack, shot after shot, on one colour scale."""

from __future__ import annotations

import re
import subprocess
import textwrap
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import lru_cache
from io import BytesIO
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._system.machine import defer_interrupts
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io.files import replacing
from napari_shadowinv.physics.units import display_unit, prefix_for, takes_prefix
from napari_shadowinv.plotting._panels import STYLE, choose_grid, image_scale, new_page

if TYPE_CHECKING:
    import xarray

_DOTS_PER_INCH = 120
_OUTLIER_SHARE = 0.02  # share of the shots whose extremes may lie beyond the colour scale
_COLOUR_MAP = "viridis"
_RATE_FACTOR = 10  # of H.264: 0 is lossless, 51 the worst
_RECORDED = ("image", "source", "mask")  # shown under masks, too
_GREYS = 56  # colours of a GIF that are reserved for text
_LETTER_WIDTH_IN = 0.075
_LINE_HEIGHT_IN = 0.15


def stack_frames(
    stack: xarray.Dataset, variable: str | None = None, *, limits: tuple[float, float] | None = None
) -> Iterator[NDArray[np.uint8]]:
    """Draw one variable of every shot, all on one colour scale.

    Parameters
    ----------
    stack : xarray.Dataset
        From `napari_shadowinv.invert_stack` or a store.
    variable : str, optional
        An image for each shot; of vectors the magnitude is shown. Default: the potential.
    limits : tuple of float, optional
        Ends of the colour scale, in the variable's own units. Default: the smallest and
        largest value of all shots, but for a few shots that stick out.

    Yields
    ------
    ndarray of uint8, shape (rows, columns, 3)
        A frame for each shot, with even numbers of rows and columns.

    Raises
    ------
    InputError
        If there is no such variable.
    """
    setup = setup_from_dataset(stack)
    if variable is None:
        variable = "potential" if setup is None else "potential_si"
    if variable not in stack or stack[variable].dims[-2:] != ("y", "x"):
        images = [str(name) for name in stack.data_vars if stack[name].dims[-2:] == ("y", "x")]
        raise InputError(
            f"the stack has no images {variable!r}: expected one of {', '.join(images)}"
        )
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
    return _draw_frames(planes, shape, _common_setup(stack), label, (factor * low, factor * high))


def _common_setup(stack: xarray.Dataset) -> Any:
    """Return a setup with the pixel size of all shots; None if they differ, or without setups."""
    shots = (
        [stack] if "setup" not in stack else [stack.isel(shot=k) for k in range(stack.shot.size)]
    )
    setups = [setup_from_dataset(shot) for shot in shots]
    sizes = {None if setup is None else setup.object_pixel_size for setup in setups}
    return setups[0] if len(sizes) == 1 else None


def _plane(field: xarray.DataArray, index: int, used: xarray.DataArray | None) -> FloatArray:
    """Values or lengths in one shot, NaN where a mask leaves pixels out."""
    values = np.asarray(field.isel(shot=index).values, dtype=np.float64)
    plane: FloatArray = values if values.ndim == 2 else np.sqrt((values**2).sum(axis=0))
    if used is None:
        return plane
    mask = np.asarray(used.isel(shot=index) if "shot" in used.dims else used, dtype=bool)
    # A fit uses a pixel that one of its images shows.
    return np.where(mask.reshape(-1, *plane.shape).any(axis=0), plane, np.nan)


def _limits(field: xarray.DataArray, used: xarray.DataArray | None) -> tuple[float, float]:
    planes = (_plane(field, index, used) for index in range(field.sizes["shot"]))
    extremes = np.array([(np.nanmin(plane), np.nanmax(plane)) for plane in planes])
    low = float(np.quantile(extremes[:, 0], _OUTLIER_SHARE, method="lower"))
    high = float(np.quantile(extremes[:, 1], 1 - _OUTLIER_SHARE, method="higher"))
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
    """Redraw a figure with the values and the name of each shot."""
    from matplotlib import rc_context

    grid = choose_grid(shape, 1, title=False)
    lines = textwrap.wrap(label, max(12, int(grid.height / _LETTER_WIDTH_IN)))
    grid = replace(grid, right_margin=grid.right_margin + _LINE_HEIGHT_IN * (len(lines) - 1))
    with new_page(grid, image_scale(shape, setup), None) as (figure, (panel,)):
        # Without values: the colour bar must not depend on the first shot.
        panel.show(np.full(shape, limits[0]), "", "\n".join(lines), _COLOUR_MAP, limits)
    canvas: Any = figure.canvas
    for plane, name in planes:
        panel.hatch_gaps(plane)
        panel.axes.images[0].set_data(plane)
        with rc_context(STYLE):
            panel.axes.set_title(name)
            figure.set_dpi(_DOTS_PER_INCH)
            canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())[..., :3]
        rows, columns = (length - length % 2 for length in pixels.shape[:2])
        yield np.ascontiguousarray(pixels[:rows, :columns])


def in_few_colours(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Reduce the colours to a fixed palette that suits a GIF.

    A palette of the 256 most frequent colours would leave few for the bright parts.

    Takes and returns an ndarray of uint8, shape (rows, columns, 3); the colours are the nearest of
    the colour scale, and greys.
    """
    tree, palette = _palette()
    rows = frame.reshape(-1, 3)
    # A frame has few thousand different colours, and most pixels share some.
    packed = rows @ np.array([1 << 16, 1 << 8, 1], dtype=np.uint32)
    _, first, which = np.unique(packed, return_index=True, return_inverse=True)
    nearest: NDArray[np.uint8] = palette[tree.query(rows[first])[1]]
    return nearest[which].reshape(frame.shape)


@lru_cache(maxsize=1)
def _palette() -> tuple[Any, NDArray[np.uint8]]:
    """Return a search tree of the palette, and the palette."""
    from matplotlib import colormaps
    from scipy.spatial import cKDTree

    scale = 255 * colormaps[_COLOUR_MAP](np.linspace(0, 1, 256 - _GREYS))[:, :3]
    greys = np.repeat(np.linspace(0, 255, _GREYS), 3).reshape(-1, 3)
    colours = np.concatenate([scale, greys]).round().astype(np.uint8)
    return cKDTree(colours), colours


def write_film(
    path: Path, frames: Iterable[NDArray[np.uint8]], rate: float, *, overwrite: bool = False
) -> int:
    """Write frames as a film, whole or not at all; return their number.

    Parameters
    ----------
    path : Path
        The film, ``.mp4`` or ``.gif``.
    frames : iterable of ndarray of uint8, shape (rows, columns, 3)
        From `stack_frames`, one at least.
    rate : float
        Frames a second.

    Raises
    ------
    FileFormatError
        If the film exists and `overwrite` does not allow to replace it, or it cannot be written.
    """
    with replacing(path, overwrite) as temporary:
        if path.suffix.lower() == ".gif":
            return _write_gif(temporary, frames, rate)
        try:
            return _write_mp4(temporary, frames, rate)
        except _FFmpegError as error:
            raise FileFormatError(
                f"{path} cannot be written (ffmpeg: {error}): free some disk space, choose "
                "another folder, or write a .gif"
            ) from None


class _FFmpegError(Exception):
    """Reason for a failure, as reported by ffmpeg."""


def _write_mp4(path: Path, frames: Iterable[NDArray[np.uint8]], rate: float) -> int:
    from imageio_ffmpeg import count_frames_and_secs

    remaining = iter(frames)
    first = next(remaining)
    count = 0
    with TemporaryFile() as messages:
        ffmpeg = _start_ffmpeg(path, first.shape, rate, messages)
        try:
            for frame in chain([first], remaining):
                ffmpeg.stdin.write(frame.tobytes())
                count += 1
            ffmpeg.communicate()
        except BrokenPipeError:
            ffmpeg.wait()
        finally:
            with defer_interrupts():
                ffmpeg.kill()
                ffmpeg.wait()
        if ffmpeg.returncode:
            messages.seek(0)
            lines = messages.read().decode(errors="replace").splitlines()
            reason = lines[-1] if lines else f"exit code {ffmpeg.returncode}"
            # Without which of its parts speaks: "[out#0/mp4 @ 0x560c9438a4c0] ".
            raise _FFmpegError(re.sub(r"^\[[^]]*\] ", "", reason))
    try:
        n_readable = count_frames_and_secs(str(path))[0]
    except RuntimeError:
        n_readable = 0
    if n_readable != count:
        raise _FFmpegError(f"{n_readable} of {count} frames can be read back")
    return count


def _start_ffmpeg(path: Path, shape: tuple[int, ...], rate: float, messages: Any) -> Any:
    from imageio_ffmpeg import get_ffmpeg_exe

    pixels = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{shape[1]}x{shape[0]}"]
    frames = [*pixels, "-r", str(rate), "-i", "-"]
    film = ["-an", "-vcodec", "libx264", "-pix_fmt", "yuv420p", "-crf", str(_RATE_FACTOR)]
    return subprocess.Popen(
        [get_ffmpeg_exe(), "-v", "error", "-y", *frames, *film, str(path.absolute())],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=messages,
        # Ctrl-C is for this process, which then ends the other.
        start_new_session=True,
    )


def _write_gif(path: Path, frames: Iterable[NDArray[np.uint8]], rate: float) -> int:
    import imageio.v2 as iio

    content, count = BytesIO(), 0
    film: Any = iio.get_writer(content, format="GIF", duration=1000 / rate, loop=0)
    with film:
        for frame in frames:
            film.append_data(in_few_colours(frame))
            count += 1
    path.write_bytes(content.getvalue())
    return count
