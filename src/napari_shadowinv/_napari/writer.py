"""What napari saves with this plugin: layers of one result, a part of which stands for all."""

# napari's own dialog asks before a file is replaced.

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.formats import PRADFORMAT, RESULT, SITES, Format

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv._napari.layer_metadata import Result
    from napari_shadowinv._napari.layers import FullLayerData


def write_result(path: str, layers: Sequence[FullLayerData]) -> list[str]:
    """Write all of a result, and how its layers look, as ``.shadowinv``."""
    return _write(path, layers, RESULT)


def write_pradformat(path: str, layers: Sequence[FullLayerData]) -> list[str]:
    """Write a result's potential and deflection as a pradformat inversion."""
    return _write(path, layers, PRADFORMAT)


def write_sites(path: str, layers: Sequence[FullLayerData]) -> list[str]:
    """Write the sites of a result, all of them, with weight, mass and displacement, as CSV."""
    return _write(path, layers, SITES)


def _write(path: str, layers: Sequence[FullLayerData], form: Format) -> list[str]:
    from napari_shadowinv.io import write

    try:
        target = Path(path)
        is_named = target.suffix.lower() in form.suffixes
        if not is_named:
            target = target.with_name(target.name + form.suffix)
        # napari's dialog asked about the name that was typed in, not about a longer one.
        return [str(write(target, dataset_to_save(layers), overwrite=is_named))]
    except InputError as error:
        # napari takes any ValueError of a writer for "no writer", and swallows what it says.
        raise FileFormatError(str(error)) from error


def dataset_to_save(layers: Sequence[FullLayerData]) -> xarray.Dataset:
    """Make the dataset of the one result that layers show; a warning names changed layers."""
    from napari_shadowinv._napari.layer_state import dataset_of_layers

    parts, result = _one_result(layers)
    _warn_of_changes(parts, result)
    return dataset_of_layers(parts, result)


def _one_result(layers: Sequence[FullLayerData]) -> tuple[list[FullLayerData], Result]:
    from napari_shadowinv._napari.layer_metadata import result_of

    results = {id(found): found for layer in layers if (found := result_of(layer[1])) is not None}
    if len(results) > 1:
        names = [_name(layer) for layer in layers if result_of(layer[1]) is not None]
        raise InputError(
            f"the layers show {len(results)} results ({_listed(names)}): select layers of one "
            "result and save the selected layers"
        )
    if not results:
        raise InputError(
            f"no layer shows a result ({_listed([_name(layer) for layer in layers])}): expected "
            "at least one layer of an inversion; save other layers as images"
        )
    (result,) = results.values()
    return [layer for layer in layers if result_of(layer[1]) is result], result


def _warn_of_changes(layers: Sequence[FullLayerData], result: Result) -> None:
    """Say which layers no longer show what the file will hold."""
    from napari_shadowinv._napari.frame import Frame
    from napari_shadowinv._napari.layer_metadata import slot_of
    from napari_shadowinv._napari.layer_state import layers_of_result

    images = [layer for layer in layers if layer[2] == "image"]
    retrieved = {slot_of(layer[1]): layer[0] for layer in layers_of_result(result, Frame())}
    changed = [
        _name(layer) for layer in images if not _same(layer[0], retrieved.get(slot_of(layer[1])))
    ]
    if changed:
        from napari.utils.notifications import show_warning

        show_warning(
            f"{_listed(changed)} changed since the result was made: the file contains the original "
            "result; save the changed layers separately, as images"
        )


def _same(shown: Any, retrieved: Any) -> bool:
    if shown is retrieved:
        return True
    return retrieved is not None and np.array_equal(shown, retrieved, equal_nan=True)


def _name(layer: FullLayerData) -> str:
    return str(layer[1].get("name", "?"))


def _listed(names: Sequence[str], most: int = 3) -> str:
    shown = ", ".join(f"'{name}'" for name in names[:most])
    return shown + (f" and {len(names) - most} more" if len(names) > most else "")
