"""Reader of napari's files; `get_reader` imports no napari and reads at most a header."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from napari_shadowinv._napari.layer_metadata import main_layers, result_of
from napari_shadowinv._napari.viewer_sync import (
    connect_viewer,
    notify_errors,
    once_added,
    show_caution,
)
from napari_shadowinv._system.safety import as_file_errors
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.files import join_address
from napari_shadowinv.io.formats import HDF5, IMAGE_SUFFIXES, RESULT, STORE, format_of
from napari_shadowinv.io.frames import images_in, left_out_of

_MAX_IMAGES = 8  # of one file that are opened as layers


def get_reader(path: str | Sequence[str]) -> Callable[[str | Sequence[str]], list[Any]] | None:
    """Return the reader of a file, folder or list of files, or None."""
    if not isinstance(path, str):
        return read_paths if path and all(_is_image_name(Path(item)) for item in path) else None
    return read_paths if _can_read(Path(path)) else None


def _can_read(path: Path) -> bool:
    if path.name.endswith((STORE.suffix, *RESULT.suffixes)):
        return True
    if path.is_dir():
        return bool(images_in(path))
    # Other programs use the endings of HDF5, too.
    if path.suffix.lower() in HDF5.suffixes:
        from napari_shadowinv.io.field_grids import is_field_grid

        try:  # fields on a grid are refused with advice
            return is_field_grid(path) or bool(HDF5.image_names(path))
        except FileFormatError:
            return False
    return _is_image_name(path)


def _is_image_name(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES


@notify_errors(otherwise=lambda: [(None,)])  # napari then adds no layer
def read_paths(path: str | Sequence[str]) -> list[Any]:
    """Read paths that `get_reader` accepts as layers; in a window, errors become notifications."""
    from napari_shadowinv._napari.shots import stack_layers

    if not isinstance(path, str):
        return stack_layers([Path(item) for item in path])
    file = Path(path)
    if file.name.endswith(STORE.suffix):
        from napari_shadowinv._napari.result_files import store_layers

        layers = main_layers(store_layers(file))
        _show_in_window(layers)
        return layers
    if file.is_dir():
        images = images_in(file)
        if not images:  # they may be gone since napari asked for a reader
            raise FileFormatError(f"{file} contains no image: expected a folder of radiographs")
        if others := left_out_of(file):
            show_caution(f"{file.name}: left out: {others}; open them as a list")
        return stack_layers(images, file.name)
    return _read_file(file)


@as_file_errors
def _read_file(file: Path) -> list[Any]:
    from napari_shadowinv.io.field_grids import is_field_grid

    names = () if is_field_grid(file) else format_of(file).image_names(file)
    if len(names) < 2:
        return _read_content(file)
    if len(names) > _MAX_IMAGES:
        address = str(join_address(file, names[_MAX_IMAGES]))
        show_caution(
            f"{file.name}: {_MAX_IMAGES} of {len(names)} images are open: open another in napari's "
            f"console, viewer.add_image(napari_shadowinv.read({address!r}).image)"
        )
    first = names[:_MAX_IMAGES]
    return [layer for name in first for layer in _read_content(join_address(file, name), name)]


def _read_content(path: Path, array: str = "") -> list[Any]:
    from napari_shadowinv._napari.result_files import layers_of_dataset
    from napari_shadowinv._napari.shots import frame_layers, layers_of_shot
    from napari_shadowinv.io import read
    from napari_shadowinv.io.frames import FRAMES_FORMAT
    from napari_shadowinv.shot import Shot

    content = read(path)
    if isinstance(content, Shot):
        for caution in content.cautions:
            show_caution(f"{path.name}: {caution.text}")
        return layers_of_shot(content, array)
    if content.attrs.get("format") == FRAMES_FORMAT:
        return frame_layers(content, array or path.stem)
    layers = layers_of_dataset(content, path.stem)
    _show_in_window(layers)
    result = result_of(layers[0][1])
    for caution in () if result is None else result.content.cautions:
        show_caution(f"{path.name}: {caution.text}")
    return layers


def _show_in_window(layers: Sequence[Any]) -> None:
    """In a window, show an opened result with its bars, and select its field."""
    from napari_shadowinv._napari.layers import present
    from napari_shadowinv._napari.result_files import follow_arrows, viewer_in_window

    viewer = viewer_in_window()
    if viewer is None:
        return

    def show(added: list[Any]) -> None:
        present_layers = [layer for layer in added if layer in viewer.layers]
        follow_arrows(viewer)
        present(viewer, present_layers)

    connect_viewer(viewer)
    once_added(viewer, len(layers), show)
