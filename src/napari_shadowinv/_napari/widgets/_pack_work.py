"""Evaluation of a film pack with the user's corrections: `PackJob`, `copy_edits`."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.film import Pack, read_corners, write_corners
from napari_shadowinv.film.scans import common_shape, upright
from napari_shadowinv.io import read_radiograph, replacing, write
from napari_shadowinv.io.formats import TIFF
from napari_shadowinv.pipeline import run_film

if TYPE_CHECKING:
    import xarray


class FinishedPack(NamedTuple):
    """The dataset of a film pack, and the painted pixels on its grid."""

    dataset: xarray.Dataset
    by_hand: BoolArray | None


@dataclass(frozen=True, eq=False)
class PackJob:
    """Arguments of `run_film`; corrections are written to a folder, which a failed run removes.

    Attributes
    ----------
    pack : Pack
        The pack before any correction.
    path : str
        Path of the pack file.
    name : str
    folder : Path
        Folder to create.
    corners : mapping of str to ndarray, optional
        Corners of all films by number.
    by_hand : ndarray of bool, shape (n, H, W), optional
        Painted pixels, which are not used.
    scales : ndarray, shape (n,), optional
        Pixel side of the upright films in pixels of each film's scan; required with corners.
    plane : int
        The film in view.
    """

    pack: Pack
    path: str
    name: str
    folder: Path
    corners: Mapping[str, FloatArray] | None = None
    by_hand: BoolArray | None = None
    scales: FloatArray | None = None
    plane: int = 0

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> FinishedPack:
        """Write the corrections and evaluate the pack."""
        try:
            pack, by_hand = self._write_corrections()
            dataset = run_film(pack, on_progress=on_progress, should_stop=should_stop)
            return FinishedPack(dataset, by_hand)
        except BaseException:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise

    def _write_corrections(self) -> tuple[Pack, BoolArray | None]:
        changes: dict[str, Any] = {}
        by_hand = self.by_hand
        if self.corners is not None:
            changes["corners"] = self._file("corners.csv")
            write_corners(changes["corners"], dict(self.corners))
            if by_hand is not None:
                by_hand = _resize(by_hand, self._shape(changes["corners"]))
        if by_hand is not None and by_hand.any():
            layers = list(self.pack.layers)
            for k in np.flatnonzero(by_hand.any(axis=(1, 2))):
                usable = ~by_hand[k]
                mask_file = layers[k].mask
                if mask_file is not None:
                    mask = read_radiograph(mask_file).image > 0
                    if mask.shape != usable.shape:
                        continue  # `run_film` reports it
                    usable &= mask
                file = write(
                    self._file(f"mask_{k + 1:02d}{TIFF.suffix}"), usable.astype(np.float32)
                )
                layers[k] = layers[k].model_copy(update={"mask": file})
            changes["layers"] = tuple(layers)
        return self.pack.model_copy(update=changes), by_hand

    def _shape(self, corners: Path) -> tuple[int, int]:
        """Return the shape of the upright films with the new corners."""
        assert self.scales is not None
        films = read_corners(corners)
        return common_shape([upright(films[n])[2] / self.scales[int(n) - 1] for n in films])

    def _file(self, name: str) -> Path:
        self.folder.mkdir(parents=True, exist_ok=True)
        return self.folder / name


def _resize(planes: BoolArray, shape: tuple[int, int]) -> BoolArray:
    """Crop or pad planes around their centres."""
    sides = planes.shape[1:]
    y, x = (np.arange(new) + (old - new) // 2 for new, old in zip(shape, sides, strict=True))
    inside = ((y >= 0) & (y < sides[0]))[:, None] & (x >= 0) & (x < sides[1])
    rows, columns = (np.clip(index, 0, old - 1) for index, old in zip((y, x), sides, strict=True))
    return planes[:, rows[:, None], columns] & inside


def copy_edits(dataset: xarray.Dataset, pack: Pack, scratch: Path, path: Path) -> xarray.Dataset:
    """Copy corrections from the folder `scratch` next to the result's file at `path`.

    The returned dataset names the copies, such as ``result_corners.csv``.
    """
    overwrite = path.exists()  # the dialog has asked

    def copy(file: Path | None) -> Path | None:
        if file is None or scratch not in file.parents:
            return file
        with replacing(path.with_name(f"{path.stem}_{file.name}"), overwrite) as temporary:
            shutil.copyfile(file, temporary)
        return path.with_name(f"{path.stem}_{file.name}")

    layers = tuple(layer.model_copy(update={"mask": copy(layer.mask)}) for layer in pack.layers)
    saved_pack = pack.model_copy(update={"corners": copy(pack.corners), "layers": layers})
    return dataset.assign_attrs(pack=saved_pack.model_dump_json(exclude_defaults=True))
