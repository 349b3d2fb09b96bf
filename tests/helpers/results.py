"""Results in files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from napari_shadowinv import read
from napari_shadowinv.provenance import Provenance


def provenance_in(result: Any) -> Provenance:
    """Return the provenance of a result, in a file or loaded, which must have one."""
    dataset = read(result) if isinstance(result, str | Path) else result
    provenance = Provenance.of(dataset.attrs, dataset.variables)
    assert provenance is not None
    return provenance
