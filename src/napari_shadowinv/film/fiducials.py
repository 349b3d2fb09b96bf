"""Films laid on each other by marks that go through all of them: `poses_by_fiducials`.

Holes that were pierced through the assembled pack, or the ends of a cut, lie at the same place of
each film, whatever the beam did.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.film.registration import EDGES, Poses
from napari_shadowinv.film.scans import upright

__all__ = ["poses_by_fiducials"]

_LEAST_ERROR = 0.3  # px: as marks are read off a scan
_ODD = 10.0  # px: further from where the other marks tell, a mark is that of another name
_ROUNDS = 50

Points = Mapping[str, ArrayLike]


def poses_by_fiducials(
    points: Sequence[Points], corners: ArrayLike, scales: ArrayLike, names: Sequence[str]
) -> Poses:
    """Find how films lie on each other by marks that are at the same place of each.

    One mark on a film tells its shift, two or more its turn, too. A film without marks lies as its
    edges do. Films are laid on the mean of all, so that marks on one film alone tell nothing.

    Parameters
    ----------
    points : sequence of mapping from str to array_like, shape (2,)
        For each film its marks by name, (y, x) in px of its scan.
    corners : array_like, shape (n, 4, 2)
        Of the films on their scans.
    scales : array_like, shape (n,)
        Px of each film in a px of the images, which magnify with the depth in the pack.
    names : sequence of str
        What messages call the films.

    Raises
    ------
    InputError
        If no mark is on two films, or one is far from where the others of its film tell.
    """
    there = [
        {name: _on_film(np.asarray(place, np.float64), film) for name, place in marks.items()}
        for marks, film in zip(points, np.asarray(corners, np.float64), strict=True)
    ]
    shared = {name for marks in there for name in marks if sum(name in one for one in there) > 1}
    if not shared:
        raise InputError(
            "fiducials: no mark is on two films or more: give the marks that go through the pack "
            "the same name on each film"
        )
    there = [{name: one[name] for name in sorted(shared & one.keys())} for one in there]
    count = len(there)
    shifts, turns = np.zeros((count, 2)), np.zeros(count)
    marked = [k for k in range(count) if there[k]]
    for _ in range(_ROUNDS):
        common = _means(there, shifts, turns)
        for k in marked:
            shifts[k], turns[k] = _rigid(there[k], common)
        # Where all lie together, the edges of all tell.
        shifts[marked] -= shifts[marked].mean(axis=0)
        turns[marked] -= turns[marked].mean()
    common = _means(there, shifts, turns)
    misfits = [_misfit(there[k], common, shifts[k], turns[k]) for k in range(count)]
    for name, misfit in zip(names, misfits, strict=True):
        if misfit.size and misfit.max() > _ODD:
            raise InputError(
                f"fiducials: a mark on {name} is {misfit.max():.0f} px from where the marks of all "
                "films tell: correct its name or its place"
            )
    # What the marks' coordinates tell beyond their common places and each film's pose.
    poses = [len(one) and min(3, 1 + len(one)) for one in there]
    spare = 2 * sum(map(len, there)) - 2 * len(shared) - sum(poses) + max(poses)
    every = np.concatenate(misfits)
    closure = float(np.sqrt((every**2).sum() / spare)) if spare > 0 else float("nan")
    error = float(np.fmax(_LEAST_ERROR, closure))
    errors = np.array([error / np.sqrt(len(one)) if one else EDGES for one in there])
    return Poses(
        shifts / np.asarray(scales, np.float64)[:, None],
        turns,
        errors,
        np.zeros(count, dtype=bool),
        closure,
    )


def _on_film(place: FloatArray, corners: FloatArray) -> FloatArray:
    """Px down and right from the film's middle."""
    axes, middle, _ = upright(corners)
    return np.asarray((place - middle) @ axes.T)


def _rotation(turn: float) -> FloatArray:
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, s], [-s, c]])


def _means(
    there: list[dict[str, FloatArray]], shifts: FloatArray, turns: FloatArray
) -> dict[str, FloatArray]:
    """Where each mark is on films that have been laid on each other."""
    brought: dict[str, list[FloatArray]] = {}
    for marks, shift, turn in zip(there, shifts, turns, strict=True):
        for name, place in marks.items():
            brought.setdefault(name, []).append((place - shift) @ _rotation(turn).T)
    return {name: np.mean(places, axis=0) for name, places in brought.items()}


def _rigid(marks: dict[str, FloatArray], common: dict[str, FloatArray]) -> tuple[FloatArray, float]:
    """Shift and turn that bring the common places onto a film's marks, by least squares."""
    on_film = np.array(list(marks.values()))
    expected = np.array([common[name] for name in marks])
    turn = 0.0
    if len(marks) > 1:
        one, other = (places - places.mean(axis=0) for places in (expected, on_film))
        along, across = (
            (one * other).sum(),
            (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]).sum(),
        )
        turn = float(np.arctan2(across, along))
    return (on_film - expected @ _rotation(turn)).mean(axis=0), turn


def _misfit(
    marks: dict[str, FloatArray], common: dict[str, FloatArray], shift: FloatArray, turn: float
) -> FloatArray:
    return np.array(
        [
            np.hypot(*(place - shift - common[name] @ _rotation(turn)))
            for name, place in marks.items()
        ]
    )
