"""Carrying a triangulation along when its sites move; see `triangulation`.

All sites move at once, but for the corners of triangles that this would turn over: these are
taken out and put in again where they belong.
"""

from __future__ import annotations

import numpy as np

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.geometry._flips import DONE, EXHAUSTED, REMOVE, insert, repair, restore
from napari_shadowinv.geometry._kernel import kernel, kernel_that_allocates
from napari_shadowinv.geometry._mesh import EVERYWHERE, SIZE, Mesh, compact, remove
from napari_shadowinv.geometry._predicates import CROSS_BOUND, turn

_MOST_STRAYS = 0.1  # of the sites; with more of them a new triangulation is faster


@kernel
def _overturned(mesh: Mesh, t: int) -> bool:
    """Tell whether a triangle is not upright; exact, but fast where that is beyond doubt."""
    points = mesh.points
    i, j, k = mesh.corners[3 * t], mesh.corners[3 * t + 1], mesh.corners[3 * t + 2]
    left = (points[j, 0] - points[i, 0]) * (points[k, 1] - points[i, 1])
    right = (points[j, 1] - points[i, 1]) * (points[k, 0] - points[i, 0])
    if left - right > CROSS_BOUND * (abs(left) + abs(right)):
        return False
    return turn(points, mesh.scratch, i, j, k) <= 0


@kernel_that_allocates
def _stay_behind(mesh: Mesh, origins: FloatArray, strays: BoolArray) -> bool:
    """Return the corners of overturned triangles to their origins; tell if there were any."""
    found = False
    for t in range(mesh.counters[SIZE]):
        if _overturned(mesh, t):
            found = True
            for v in mesh.corners[3 * t : 3 * t + 3]:
                if v < strays.size:
                    mesh.points[v] = origins[v]
                    strays[v] = True
    return found


@kernel_that_allocates
def _take_out(mesh: Mesh, strays: BoolArray) -> int:
    """Remove the strays that are in the triangulation."""
    found = True
    while found:  # flips may move a stray to a triangle that the pass has left behind
        found = False
        for h in range(3 * mesh.counters[SIZE]):
            v = mesh.corners[h]
            if mesh.corners[h - h % 3] >= 0 and v < strays.size and strays[v]:
                found = True
                remove(mesh, h)
                mesh.counters[EVERYWHERE] = 1
                if restore(mesh) != DONE:
                    return EXHAUSTED
    return DONE


@kernel_that_allocates
def relocate(mesh: Mesh, targets: FloatArray) -> int:
    """Move the sites and repair the mesh; EXHAUSTED where building it anew is the better way."""
    n = targets.shape[0]
    origins = mesh.points[:n].copy()
    strays = np.zeros(n, dtype=np.bool_)
    mesh.points[:n] = targets
    while _stay_behind(mesh, origins, strays):
        pass
    if strays.sum() > _MOST_STRAYS * n or repair(mesh, REMOVE, strays[:0]) != DONE:
        return EXHAUSTED
    status = _take_out(mesh, strays)
    for v in range(n):
        if strays[v]:
            mesh.points[v] = targets[v]
    for v in range(n):
        if mesh.hidden[v] and status == DONE:
            status = insert(mesh, v, 1.0 if strays[v] else -1.0)
    compact(mesh)
    return status
