"""Writers of napari's layers: any layers of a result save the complete result."""

# napari's dialog asks before a file is replaced.

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
    from napari_shadowinv.io.results import AnyResult


def write_result(path: str, layers: Sequence[FullLayerData]) -> list[str]:
    """Write a complete result, with the appearance of its layers, as ``.shadowinv``."""
    return _write(path, layers, RESULT)


def write_pradformat(path: str, layers: Sequence[FullLayerData]) -> list[str]:
    """Write a result's potential and deflection as a pradformat inversion."""
    return _write(path, layers, PRADFORMAT)


def write_sites(path: str, layers: Sequence[FullLayerData]) -> list[str]:
    """Write all sites of a result, with weight, mass and displacement, as CSV."""
    return _write(path, layers, SITES)


def _write(path: str, layers: Sequence[FullLayerData], form: Format) -> list[str]:
    from napari_shadowinv.io import write

    try:
        target = Path(path)
        has_suffix = target.suffix.lower() in form.suffixes
        if not has_suffix:
            target = target.with_name(target.name + form.suffix)
        # napari's dialog asked about replacing the entered name only.
        return [str(write(target, dataset_to_save(layers), overwrite=has_suffix))]
    except InputError as error:
        # napari takes a ValueError of a writer as "no writer" and hides its message.
        raise FileFormatError(str(error)) from error


def dataset_to_save(layers: Sequence[FullLayerData]) -> xarray.Dataset:
    """Return the dataset of the result that layers show; warn about changed layers."""
    from napari_shadowinv._napari.layer_state import dataset_of_layers

    parts, result = _common_result(layers)
    _warn_of_changes(parts, result)
    return dataset_of_layers(parts, result)


def _common_result(
    layers: Sequence[FullLayerData],
) -> tuple[list[FullLayerData], Result[AnyResult]]:
    from napari_shadowinv._napari.layer_metadata import result_of

    results = {
        id(result): result for layer in layers if (result := result_of(layer[1])) is not None
    }
    if len(results) > 1:
        names = [_name(layer) for layer in layers if result_of(layer[1]) is not None]
        raise InputError(
            f"the layers belong to {len(results)} results ({_quote_names(names)}): select layers "
            "of one result and save the selected layers"
        )
    if not results:
        raise InputError(
            f"no layer belongs to a result ({_quote_names([_name(layer) for layer in layers])}): "
            "expected at least one layer of an inversion; save other layers as images"
        )
    (common,) = results.values()
    return [layer for layer in layers if result_of(layer[1]) is common], common


def _warn_of_changes(layers: Sequence[FullLayerData], result: Result[AnyResult]) -> None:
    """Warn about layers whose data differ from the file."""
    from napari_shadowinv._napari.frame import Frame
    from napari_shadowinv._napari.layer_metadata import layer_key
    from napari_shadowinv._napari.layer_state import layers_of_result

    images = [layer for layer in layers if layer[2] == "image"]
    originals = {layer_key(layer[1]): layer[0] for layer in layers_of_result(result, Frame())}
    changed = [
        _name(layer)
        for layer in images
        if not _has_data(layer[0], originals.get(layer_key(layer[1])))
    ]
    if changed:
        from napari.utils.notifications import show_warning

        show_warning(
            f"{_quote_names(changed)} changed since the result was computed: the file contains the "
            "original result; save the changed layers separately, as images"
        )


def _has_data(shown: Any, original: Any) -> bool:
    if shown is original:
        return True
    return original is not None and np.array_equal(shown, original, equal_nan=True)


def _name(layer: FullLayerData) -> str:
    return str(layer[1].get("name", "?"))


def _quote_names(names: Sequence[str], max_count: int = 3) -> str:
    text = ", ".join(f"'{name}'" for name in names[:max_count])
    return text + (f" and {len(names) - max_count} more" if len(names) > max_count else "")
