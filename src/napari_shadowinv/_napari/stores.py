"""The results of a run of shots as lazy layers with an axis of shots: `store_layers`.

A store holds what one result holds, with the dimension ``shot`` in front. Shots that are not
done yet are empty in it, and are shown so; nothing but the first shot that is done is read
before it is looked at.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._napari.frame import Frame, frame_for
from napari_shadowinv._napari.layer_metadata import mark
from napari_shadowinv._napari.layers import (
    FullLayerData,
    arrow_keywords,
    caustic_keywords,
    component_symbols,
    intensity_limits,
    opened,
    symmetric_limits,
    thinned_arrows,
)
from napari_shadowinv._system.safety import refusing_damage
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.formats import RESULT

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup

    Setup = ProtonSetup | OpticalSetup

__all__ = ["at_shot", "opened_store", "store_layers"]

_SHOT = "shot"
_DONE = 1  # as a store's variable "status" marks a shot


@refusing_damage
def store_layers(path: Path, name: str = "") -> list[FullLayerData]:
    """Describe the layers of a store.

    Parameters
    ----------
    path : Path
        A ``.shadowinv.zarr`` folder.
    name : str
        Name of the run. Default: the folder's.

    Returns
    -------
    list of (data, keywords, layer type)
        Layers over dask arrays of shape (shots, H, W), the lowest first: those of a single
        result as far as the store has them, without sites. The arrows are those of the first
        finished shot; see `napari_shadowinv._napari.arrow_sync`.

    Raises
    ------
    FileFormatError
        If there is no such store or no shot in it is done.
    """
    dataset = opened_store(path)
    name = name or path.name.removesuffix(".zarr").removesuffix(RESULT.suffix)
    return _StoreLayers(path, dataset, name).layers()


@refusing_damage
def opened_store(path: Path) -> xarray.Dataset:
    """Open a store lazily, or say why it is none."""
    import xarray as xr

    from napari_shadowinv.io.store_files import CheckedStore

    if not path.is_dir():
        raise FileFormatError(f"{path} does not exist: expected a folder made by an inversion")
    # Nothing in it is a time, whatever its units look like.
    dataset: xr.Dataset = xr.open_zarr(
        CheckedStore(path), chunks={}, decode_times=False, mask_and_scale=False, consolidated=False
    )
    if "displacement" not in dataset or _SHOT not in dataset["displacement"].dims:
        raise FileFormatError(
            f"{path} is a Zarr folder but not a store of inverted shots (it has no "
            "displacement): open it with napari's own reader"
        )
    return dataset


class _StoreLayers:
    """Makes the layers of one store."""

    def __init__(self, path: Path, dataset: xarray.Dataset, name: str) -> None:
        from napari_shadowinv.inversion.labels import setup_from_dataset

        self._path = path
        self._dataset = dataset.transpose(_SHOT, ...)
        self._name = name
        self._setup: Setup | None = setup_from_dataset(dataset)
        self._done = self._first_done()
        shape = self._dataset["displacement"].shape[-2:]
        self._frame: Frame = frame_for(shape, self._setup)

    def _first_done(self) -> int:
        displacement = self._dataset["displacement"]
        shots: Iterable[int] = range(displacement.sizes[_SHOT])
        if self._is_run("status"):
            shots = np.flatnonzero(self._dataset["status"].values == _DONE)
        for shot in shots:
            if np.isfinite(displacement[shot].values).all():
                return int(shot)
        raise FileFormatError(f"{self._path} contains no finished shot yet: wait for the first one")

    def layers(self) -> list[FullLayerData]:
        return [
            *self._intensities(),
            *self._potential(),
            *self._field(),
            *self._caustics(),
            self._arrows(),
        ]

    def _layer(
        self, data: Any, kind: str, role: str, title: str, unit: str, **keywords: Any
    ) -> FullLayerData:
        metadata = mark(role, unit, self._setup, store=str(self._path), shots=self._shots())
        return (
            data,
            {
                "name": f"{self._name} {title}".strip(),
                "metadata": metadata,
                "visible": False,
                **self._frame.keywords(stacked=True),
                **keywords,
            },
            kind,
        )

    def _shots(self) -> list[str]:
        """Names of the shots, where the store tells them."""
        for name in ("input_file", "name", _SHOT):
            if name in self._dataset.variables and self._dataset[name].dims == (_SHOT,):
                return [str(value) for value in self._dataset[name].values]
        return [str(shot) for shot in range(self._dataset.sizes[_SHOT])]

    def _plane(self, name: str) -> NDArray[np.float64]:
        """The first finished shot of a variable."""
        return np.asarray(self._dataset[name][self._done].values, dtype=np.float64)

    def _intensities(self) -> list[FullLayerData]:
        layers = []
        base = next((name for name in ("image", "reprojection") if name in self._dataset), None)
        limits = (0.0, 1.0) if base is None else intensity_limits(self._plane(base))
        for name, title in (("image", "image"), ("reprojection", "re-projection")):
            if self._is_run(name):
                layers.append(
                    self._image(self._data(name), name, title, "flux/px²", limits, "gray")
                )
        if self._is_run("residual"):
            limits = symmetric_limits(self._plane("residual"))
            layers.append(
                self._image(
                    self._data("residual"), "residual", "residual", "flux/px²", limits, "RdBu_r"
                )
            )
        return layers

    def _is_run(self, name: str) -> bool:
        return name in self._dataset and _SHOT in self._dataset[name].dims

    def _data(self, name: str) -> Any:
        return self._dataset[name].data

    def _image(
        self,
        data: Any,
        role: str,
        title: str,
        unit: str,
        limits: tuple[float, float],
        colormap: str,
        **keywords: Any,
    ) -> FullLayerData:
        choices = {"colormap": colormap, "contrast_limits": opened(limits), **keywords}
        return self._layer(data, "image", role, title, unit, **choices)

    def _potential(self) -> list[FullLayerData]:
        from napari_shadowinv.plotting import shown_potential

        if not self._is_run("potential"):
            return []
        plane = self._plane("potential")
        shown, unit = shown_potential(plane, self._setup)
        factor = _ratio(shown, plane)
        limits = (float(shown.min()), float(shown.max()))
        data = self._data("potential") * factor
        title = f"potential ({unit})"
        return [self._image(data, "potential", title, unit, limits, "viridis")]

    def _field(self) -> list[FullLayerData]:
        """Components and strength, in the unit that suits the first finished shot."""
        import dask.array

        from napari_shadowinv.plotting import shown_fields

        # Both components of all shots, as (component, shot, y, x).
        displacement = self._dataset["displacement"].transpose("component", _SHOT, "y", "x").data
        first = self._plane("displacement")
        (field,) = shown_fields([first], self._setup)
        whole, *parts = component_symbols(field)
        matrix = _field_of_unit_displacements(self._setup)
        matrix = matrix * _ratio(field.vectors, np.tensordot(matrix, first, axes=1))
        vectors = [
            sum(factor * displacement[k] for k, factor in enumerate(row) if factor)
            for row in matrix
        ]
        strongest = float(field.magnitude.max())
        limits = (-strongest, strongest)
        strength = dask.array.hypot(*vectors)
        return [
            *(
                self._image(plane, role, f"{symbol} ({field.unit})", field.unit, limits, "RdBu_r")
                for plane, role, symbol in zip(vectors, ("field y", "field x"), parts, strict=True)
            ),
            self._image(
                strength,
                "field",
                f"{whole} ({field.unit})",
                field.unit,
                (0.0, strongest),
                "inferno",
                visible=True,
            ),
        ]

    def _caustics(self) -> list[FullLayerData]:
        if not self._is_run("caustic"):
            return []
        caustic = self._data("caustic").astype(np.uint8)
        return [self._layer(caustic, "labels", "caustic", "caustics", "", **caustic_keywords())]

    def _arrows(self) -> FullLayerData:
        data, spacing = thinned_arrows(self._plane("displacement"))
        keywords = {"visible": True, **arrow_keywords(data, spacing)}
        return self._layer(
            at_shot(data, self._done), "vectors", "arrows", "displacement arrows", "px", **keywords
        )


def at_shot(arrows: NDArray[np.float64], shot: int) -> NDArray[np.float64]:
    """Return arrows of a plane, shape (n, 2, 2), as those of a shot, shape (n, 2, 3)."""
    stacked = np.zeros((len(arrows), 2, 3))
    stacked[:, 0, 0] = shot
    stacked[:, :, 1:] = arrows
    return stacked


def _field_of_unit_displacements(setup: Setup | None) -> NDArray[np.float64]:
    """Matrix that makes a field (T m, rad or px) of a displacement: all fields are linear."""
    unit_vectors = np.eye(2)
    if setup is None:
        return unit_vectors
    if setup.kind == "proton":
        return setup.path_integrated_b(unit_vectors)
    return setup.deflection_angle(unit_vectors)


def _ratio(shown: NDArray[np.float64], plane: NDArray[np.float64]) -> float:
    """Factor between two planes that differ by a factor only."""
    largest = np.unravel_index(np.argmax(np.abs(plane)), plane.shape)
    return float(shown[largest] / plane[largest]) if plane[largest] else 1.0
