"""Many shots inverted at once, for tests of what becomes of each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from napari_shadowinv import Recipe, run_stack
from napari_shadowinv.pipeline import RunOptions


def inverted_stack(shots: Any, folder: Path, recipe: Recipe | None = None, *names: str) -> Any:
    """Invert shots into a store with all digits; the variables are those of this name."""
    run = RunOptions(dtype="float64", overwrite=True, variables=names or None)
    return run_stack(shots, folder / "stack.shadowinv.zarr", recipe, run=run)
