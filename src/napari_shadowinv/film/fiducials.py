"""Alignment of films by marks that go through all of them: `poses_by_fiducials`.

Holes pierced through the assembled pack, or the ends of a cut, are at the same place on each film,
independent of the beam.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.film.registration import EDGES, Poses
from napari_shadowinv.film.scans import upright

__all__ = ["poses_by_fiducials"]

_LEAST_ERROR = 0.3  # px: as marks are read off a scan
_MAX_MISFIT_PX = 10.0  # further from its place by the other marks, a mark has a wrong name
_ROUNDS = 50

Points = Mapping[str, ArrayLike]


def poses_by_fiducials(
    points: Sequence[Points], corners: ArrayLike, scales: ArrayLike, names: Sequence[str]
) -> Poses:
    """Find the poses of films by marks that are at the same place on each.

    One mark on a film determines its shift, two or more also its turn. A film without marks is
    aligned by its edges. Films are aligned to the mean of all, so a mark on one film has no effect.

    Parameters
    ----------
    points : sequence of mapping from str to array_like, shape (2,)
        For each film its marks by name, (y, x) in px of its scan.
    corners : array_like, shape (n, 4, 2)
        Of the films on their scans.
    scales : array_like, shape (n,)
        Px of each film in a px of the images, which magnify with the depth in the pack.
    names : sequence of str
        Names of the films for messages.

    Raises
    ------
    InputError
        If no mark is on two films, or one disagrees with the other marks of its film.
    """
    film_marks = [
        {name: _on_film(np.asarray(place, np.float64), film) for name, place in marks.items()}
        for marks, film in zip(points, np.asarray(corners, np.float64), strict=True)
    ]
    counts = Counter(name for marks in film_marks for name in marks)
    shared = {name for name, count in counts.items() if count > 1}
    if not shared:
        raise InputError(
            "fiducials: no mark is on two films or more: give the marks that go through the pack "
            "the same name on each film"
        )
    film_marks = [
        {name: marks[name] for name in sorted(shared & marks.keys())} for marks in film_marks
    ]
    count = len(film_marks)
    shifts, turns = np.zeros((count, 2)), np.zeros(count)
    marked = [k for k in range(count) if film_marks[k]]
    for _ in range(_ROUNDS):
        common = _mean_places(film_marks, shifts, turns)
        for k in marked:
            shifts[k], turns[k] = _fit_rigid(film_marks[k], common)
        # The edges of all films determine their common position.
        shifts[marked] -= shifts[marked].mean(axis=0)
        turns[marked] -= turns[marked].mean()
    common = _mean_places(film_marks, shifts, turns)
    misfits = [_misfit(film_marks[k], common, shifts[k], turns[k]) for k in range(count)]
    for name, misfit in zip(names, misfits, strict=True):
        if misfit.size and misfit.max() > _MAX_MISFIT_PX:
            raise InputError(
                f"fiducials: a mark on {name} is {misfit.max():.0f} px from its place by the marks "
                "of all films: correct its name or its place"
            )
    # Degrees of freedom left by the marks' common places and each film's pose.
    poses = [len(marks) and min(3, 1 + len(marks)) for marks in film_marks]
    spare = 2 * sum(map(len, film_marks)) - 2 * len(shared) - sum(poses) + max(poses)
    every = np.concatenate(misfits)
    closure = float(np.sqrt((every**2).sum() / spare)) if spare > 0 else float("nan")
    error = float(np.fmax(_LEAST_ERROR, closure))
    errors = np.array([error / np.sqrt(len(marks)) if marks else EDGES for marks in film_marks])
    return Poses(
        shifts / np.asarray(scales, np.float64)[:, None],
        turns,
        errors,
        np.zeros(count, dtype=bool),
        closure,
    )


def _on_film(place: FloatArray, corners: FloatArray) -> FloatArray:
    """Return px down and right from the film's middle."""
    axes, middle, _ = upright(corners)
    return np.asarray((place - middle) @ axes.T)


def _rotation(turn: float) -> FloatArray:
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, s], [-s, c]])


def _mean_places(
    film_marks: list[dict[str, FloatArray]], shifts: FloatArray, turns: FloatArray
) -> dict[str, FloatArray]:
    """Return the mean place of each mark on aligned films."""
    brought: dict[str, list[FloatArray]] = {}
    for marks, shift, turn in zip(film_marks, shifts, turns, strict=True):
        for name, place in marks.items():
            brought.setdefault(name, []).append((place - shift) @ _rotation(turn).T)
    return {name: np.mean(places, axis=0) for name, places in brought.items()}


def _fit_rigid(
    marks: dict[str, FloatArray], common: dict[str, FloatArray]
) -> tuple[FloatArray, float]:
    """Fit the shift and turn from the common places to a film's marks, by least squares."""
    on_film = np.array(list(marks.values()))
    expected = np.array([common[name] for name in marks])
    turn = 0.0
    if len(marks) > 1:
        common_y, common_x = (expected - expected.mean(axis=0)).T
        film_y, film_x = (on_film - on_film.mean(axis=0)).T
        along = (expected - expected.mean(axis=0)) * (on_film - on_film.mean(axis=0))
        across = common_y * film_x - common_x * film_y
        turn = float(np.arctan2(across.sum(), along.sum()))
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
