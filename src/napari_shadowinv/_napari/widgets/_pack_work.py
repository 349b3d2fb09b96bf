"""A film pack to be evaluated, with what was corrected in the window: `PackJob`, `edits_beside`."""

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


class PackAnswer(NamedTuple):
    """What `run_film` found, and the painted pixels on the pixels of that."""

    dataset: xarray.Dataset
    by_hand: BoolArray | None


@dataclass(frozen=True, eq=False)
class PackJob:
    """What `run_film` is given; corrections become files of a folder, which a failed run removes.

    Attributes
    ----------
    pack : Pack
        As it was before any correction.
    path : str
        Of the file that describes it.
    name : str
    folder : Path
        To be made.
    corners : mapping of str to ndarray, optional
        Of all films, by number.
    by_hand : ndarray of bool, shape (n, H, W), optional
        Unusable pixels that were painted.
    scales : ndarray, shape (n,), optional
        Side of the upright films' pixels in those of each film's scan; needed with corners.
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

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> PackAnswer:
        """Write the corrections and evaluate the pack, beside the window."""
        try:
            corrected, by_hand = self._corrected()
            dataset = run_film(corrected, on_progress=on_progress, should_stop=should_stop)
            return PackAnswer(dataset, by_hand)
        except BaseException:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise

    def _corrected(self) -> tuple[Pack, BoolArray | None]:
        changes: dict[str, Any] = {}
        by_hand = self.by_hand
        if self.corners is not None:
            changes["corners"] = self._file("corners.csv")
            write_corners(changes["corners"], dict(self.corners))
            if by_hand is not None:
                by_hand = _centred(by_hand, self._shape(changes["corners"]))
        if by_hand is not None and by_hand.any():
            layers = list(self.pack.layers)
            for k in np.flatnonzero(by_hand.any(axis=(1, 2))):
                usable = ~by_hand[k]
                given = layers[k].mask
                if given is not None:
                    before = read_radiograph(given).image > 0
                    if before.shape != usable.shape:
                        continue  # `run_film` tells
                    usable &= before
                file = write(
                    self._file(f"mask_{k + 1:02d}{TIFF.suffix}"), usable.astype(np.float32)
                )
                layers[k] = layers[k].model_copy(update={"mask": file})
            changes["layers"] = tuple(layers)
        return self.pack.model_copy(update=changes), by_hand

    def _shape(self, corners: Path) -> tuple[int, int]:
        """Of the upright films, with other corners."""
        assert self.scales is not None
        places = read_corners(corners)
        return common_shape([upright(places[n])[2] / self.scales[int(n) - 1] for n in places])

    def _file(self, name: str) -> Path:
        self.folder.mkdir(parents=True, exist_ok=True)
        return self.folder / name


def _centred(planes: BoolArray, shape: tuple[int, int]) -> BoolArray:
    """Cut planes or add a rim, so that their middles stay in the middle."""
    sides = planes.shape[1:]
    y, x = (np.arange(new) + (old - new) // 2 for new, old in zip(shape, sides, strict=True))
    inside = ((y >= 0) & (y < sides[0]))[:, None] & (x >= 0) & (x < sides[1])
    rows, columns = (np.clip(at, 0, old - 1) for at, old in zip((y, x), sides, strict=True))
    return planes[:, rows[:, None], columns] & inside


def edits_beside(dataset: xarray.Dataset, pack: Pack, scratch: Path, path: Path) -> xarray.Dataset:
    """Copy corrections from the folder `scratch` to beside a result that is to be written.

    The dataset then names the copies, ``result_corners.csv`` and the like.
    """
    overwrite = path.exists()  # then it has been asked

    def kept(file: Path | None) -> Path | None:
        if file is None or scratch not in file.parents:
            return file
        with replacing(path.with_name(f"{path.stem}_{file.name}"), overwrite) as temporary:
            shutil.copyfile(file, temporary)
        return path.with_name(f"{path.stem}_{file.name}")

    layers = tuple(one.model_copy(update={"mask": kept(one.mask)}) for one in pack.layers)
    moved = pack.model_copy(update={"corners": kept(pack.corners), "layers": layers})
    return dataset.assign_attrs(pack=moved.model_dump_json(exclude_defaults=True))
