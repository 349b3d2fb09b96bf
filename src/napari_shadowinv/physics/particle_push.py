"""Kernels that push charged particles through a field on a grid, and integrate it along rays.

- particles, by the relativistic Boris scheme: `push_particles`
- line integrals of the field along straight rays: `integrate_rays`

The field is an array of float32 of shape (Y, X, Z, 3) or (Y, X, Z, 6): B_x, B_y, B_z in T, and
E_x, E_y, E_z in V/m where there is an electric field. The beam travels along z, so the nodes that
a particle passes lie next to each other in memory. Between the nodes the field is trilinear,
outside the grid it is zero.

A particle is a row x, y, z in m and u_x, u_y, u_z, its momentum over m c. It drifts half a step,
receives the kick of a whole step by the field there, and drifts the other half. The kick is half
the electric impulse, a rotation about B by the exact angle, and the other half of the impulse
(J. P. Boris, 1970; C. K. Birdsall, A. B. Langdon, Plasma Physics via Computer Simulation, ch. 15).
The speed is constant without an electric field, to rounding.
"""

from __future__ import annotations

import math

from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.geometry.compiler import njit

UNTOUCHED, DEFLECTED, TRAPPED = range(3)
"""Status of a particle: met no field, left the grid, or did not leave it."""

_SLOW_SHARE = 1e-3  # of a cell, over which a particle at rest is accelerated in one step
_GAUSS = 0.5 / math.sqrt(3.0)  # places of a rule that is exact for cubic polynomials


@njit(nogil=True, cache=True, error_model="numpy")
def push_particles(
    first: int,
    last: int,
    field: AnyArray,
    origin: FloatArray,
    spacing: FloatArray,
    particles: FloatArray,
    status: AnyArray,
    steps: AnyArray,
    charge: float,
    longest: float,
    max_turn: float,
    peaks: FloatArray,
    max_path: float,
) -> None:
    """Move particles from anywhere on their straight path before the grid to where they leave it.

    The grid has its first node at `origin` and a `spacing` along x, y, z, in m. Particles, (N, 6),
    are positions in m and momenta over m c, unchanged if they meet no field; each gets a status,
    (N,), and its number of steps, (N,). The charge is q / (m c) in 1 / (T m). A step is at most
    `longest`, in m, and turns by `max_turn` rad, as limited by the `peaks` (2,): largest |B| in T
    and |E| / c in T on the grid. Beyond a path of `max_path`, in m, inside the grid a particle is
    trapped.
    """
    rim_x, rim_y, rim_z = field.shape[1] - 1.0, field.shape[0] - 1.0, field.shape[2] - 1.0
    inv_x, inv_y, inv_z = 1.0 / spacing[0], 1.0 / spacing[1], 1.0 / spacing[2]
    is_electric = field.shape[3] > 3
    light_speed = 299792458.0
    max_b, max_e = abs(charge * peaks[0]), abs(charge * peaks[1])
    for p in range(first, last):
        ux, uy, uz = particles[p, 3], particles[p, 4], particles[p, 5]
        u = math.sqrt(ux * ux + uy * uy + uz * uz)
        gamma = math.sqrt(1.0 + u * u)
        x = (particles[p, 0] - origin[0]) * inv_x
        y = (particles[p, 1] - origin[1]) * inv_y
        z = (particles[p, 2] - origin[2]) * inv_z
        start, end = _chord(
            x, y, z, ux / u * inv_x, uy / u * inv_y, uz / u * inv_z, rim_x, rim_y, rim_z
        )
        status[p] = UNTOUCHED
        steps[p] = 0
        if not end > start:
            continue
        x += start * ux / u * inv_x
        y += start * uy / u * inv_y
        z += start * uz / u * inv_z
        length = min(longest, max_turn * u / (max_b + max_e * gamma / u))
        if end - start > length:
            # Steps of equal length end at the rim.
            length = (end - start) / math.ceil((end - start) / length)
        squared_u = u * u
        step_u = squared_u  # for which the step was chosen
        flight = length / u  # c dt / γ
        hx, hy, hz = 0.5 * flight * inv_x, 0.5 * flight * inv_y, 0.5 * flight * inv_z
        path, count, is_bent = 0.0, 0, False
        while path <= max_path:
            if abs(squared_u - step_u) > 1e-3 * step_u:
                step_u = squared_u
                # Close to a turning point, at the speed that the field gives within the step.
                u = math.sqrt(max(squared_u, 2.0 * _SLOW_SHARE * max_e * length))
                limit = max_turn * u / (max_b + max_e * gamma / u)
                flight = min(length, max(limit, _SLOW_SHARE * length)) / u
                hx, hy, hz = 0.5 * flight * inv_x, 0.5 * flight * inv_y, 0.5 * flight * inv_z
            dx, dy, dz = hx * ux, hy * uy, hz * uz
            share = 1.0
            if not (
                0.0 <= x + 2 * dx <= rim_x
                and 0.0 <= y + 2 * dy <= rim_y
                and 0.0 <= z + 2 * dz <= rim_z
            ):
                share = min(
                    _share_inside(x, 2 * dx, rim_x),
                    _share_inside(y, 2 * dy, rim_y),
                    _share_inside(z, 2 * dz, rim_z),
                )
                if not share > 1e-9:  # so close to the rim it has left the grid
                    break
            x += share * dx
            y += share * dy
            z += share * dz
            i = min(max(int(x), 0), field.shape[1] - 2)
            j = min(max(int(y), 0), field.shape[0] - 2)
            k = min(max(int(z), 0), field.shape[2] - 2)
            bx, by, bz = _gather(field, i, j, k, x - i, y - j, z - k, 0)
            # The rotation's angle is 2 |t|, the angle without relativity times c dt / γ.
            turn = 0.5 * charge * flight * share
            if is_electric:
                ex, ey, ez = _gather(field, i, j, k, x - i, y - j, z - k, 3)
                half = turn * gamma / light_speed
                ux += half * ex
                uy += half * ey
                uz += half * ez
                turn *= gamma / math.sqrt(1.0 + ux * ux + uy * uy + uz * uz)
                is_bent = is_bent or ex != 0.0 or ey != 0.0 or ez != 0.0
            tx, ty, tz = turn * bx, turn * by, turn * bz
            squared = tx * tx + ty * ty + tz * tz
            is_bent = is_bent or squared > 0.0
            # tan a = a (1 + a²/3 + 2 a⁴/15) for small angles
            tangent = 1.0 + squared * (1.0 / 3.0 + squared * (2.0 / 15.0))
            tx *= tangent
            ty *= tangent
            tz *= tangent
            factor = 2.0 / (1.0 + squared * tangent * tangent)
            vx = ux + uy * tz - uz * ty
            vy = uy + uz * tx - ux * tz
            vz = uz + ux * ty - uy * tx
            ux += factor * (vy * tz - vz * ty)
            uy += factor * (vz * tx - vx * tz)
            uz += factor * (vx * ty - vy * tx)
            if is_electric:
                ux += half * ex
                uy += half * ey
                uz += half * ez
                squared_u = ux * ux + uy * uy + uz * uz
                share *= gamma
                gamma = math.sqrt(1.0 + squared_u)
                share /= gamma
            x += share * hx * ux
            y += share * hy * uy
            z += share * hz * uz
            path += length
            count += 1
        steps[p] = count
        if not is_bent:
            continue
        status[p] = DEFLECTED if path <= max_path else TRAPPED
        particles[p, 0] = x * spacing[0] + origin[0]
        particles[p, 1] = y * spacing[1] + origin[1]
        particles[p, 2] = z * spacing[2] + origin[2]
        particles[p, 3] = ux
        particles[p, 4] = uy
        particles[p, 5] = uz


@njit(nogil=True, cache=True, error_model="numpy")
def integrate_rays(
    first: int,
    last: int,
    field: AnyArray,
    origin: FloatArray,
    spacing: FloatArray,
    rays: FloatArray,
    integrals: FloatArray,
) -> None:
    """Integrate the field's components across the beam over z along straight rays.

    A ray, (N, 6), has a point in m and a direction. Integrals, (N, 2) or (N, 4), are ∫B_y dz and
    ∫B_x dz in T m, then ∫E_y dz and ∫E_x dz in V; exact for a trilinear field, as the ray is cut
    where it passes from cell to cell.
    """
    rim_x, rim_y, rim_z = field.shape[1] - 1.0, field.shape[0] - 1.0, field.shape[2] - 1.0
    for p in range(first, last):
        length = math.sqrt(rays[p, 3] ** 2 + rays[p, 4] ** 2 + rays[p, 5] ** 2)
        gx = rays[p, 3] / length / spacing[0]
        gy = rays[p, 4] / length / spacing[1]
        gz = rays[p, 5] / length / spacing[2]
        x0 = (rays[p, 0] - origin[0]) / spacing[0]
        y0 = (rays[p, 1] - origin[1]) / spacing[1]
        z0 = (rays[p, 2] - origin[2]) / spacing[2]
        at, end = _chord(x0, y0, z0, gx, gy, gz, rim_x, rim_y, rim_z)
        integrals[p] = 0.0
        while at < end:
            leave = min(_next_face(x0, gx, at), _next_face(y0, gy, at), _next_face(z0, gz, at))
            leave = min(leave, end)
            weight = 0.5 * (leave - at) * rays[p, 5] / length
            for side in (-_GAUSS, _GAUSS):
                t = 0.5 * (at + leave) + side * (leave - at)
                x, y, z = x0 + t * gx, y0 + t * gy, z0 + t * gz
                i = min(max(int(x), 0), field.shape[1] - 2)
                j = min(max(int(y), 0), field.shape[0] - 2)
                k = min(max(int(z), 0), field.shape[2] - 2)
                for c in range(0, integrals.shape[1], 2):
                    across_x, across_y, _ = _gather(
                        field, i, j, k, x - i, y - j, z - k, 3 * (c // 2)
                    )
                    integrals[p, c] += weight * across_y
                    integrals[p, c + 1] += weight * across_x
            at = leave


@njit(nogil=True, cache=True, error_model="numpy")
def _chord(
    x: float, y: float, z: float, gx: float, gy: float, gz: float,
    rim_x: float, rim_y: float, rim_z: float,
) -> tuple[float, float]:  # fmt: skip
    """Distances in m along a line at which it enters and leaves the grid; places in cells."""
    start, end = -math.inf, math.inf
    for at, slope, rim in ((x, gx, rim_x), (y, gy, rim_y), (z, gz, rim_z)):
        if slope != 0.0:
            near, far = -at / slope, (rim - at) / slope
            start, end = max(start, min(near, far)), min(end, max(near, far))
        elif not 0.0 <= at <= rim:
            return 0.0, 0.0
    return start, end


@njit(nogil=True, cache=True, error_model="numpy")
def _share_inside(at: float, move: float, rim: float) -> float:
    """Share of a move, in cells, after which it leaves the grid along an axis."""
    if at + move < 0.0:
        return -at / move
    if at + move > rim:
        return (rim - at) / move
    return 1.0


@njit(nogil=True, cache=True, error_model="numpy")
def _next_face(at: float, slope: float, t: float) -> float:
    """Distance along a line, beyond `t`, at which it meets the next plane of nodes."""
    place = at + t * slope
    if slope > 0.0:
        return (math.floor(place + 1e-9) + 1.0 - at) / slope
    if slope < 0.0:
        return (math.ceil(place - 1e-9) - 1.0 - at) / slope
    return math.inf


@njit(nogil=True, cache=True, error_model="numpy")
def _gather(
    field: AnyArray, i: int, j: int, k: int, fx: float, fy: float, fz: float, c: int
) -> tuple[float, float, float]:
    """Interpolate the components c, c + 1 and c + 2 inside a cell."""
    w11 = fx * fy
    w01, w10 = fx - w11, fy - w11
    w00 = 1.0 - fx - w10
    g = 1.0 - fz
    return (
        g * _across(field, i, j, k, c, w00, w01, w10, w11)
        + fz * _across(field, i, j, k + 1, c, w00, w01, w10, w11),
        g * _across(field, i, j, k, c + 1, w00, w01, w10, w11)
        + fz * _across(field, i, j, k + 1, c + 1, w00, w01, w10, w11),
        g * _across(field, i, j, k, c + 2, w00, w01, w10, w11)
        + fz * _across(field, i, j, k + 1, c + 2, w00, w01, w10, w11),
    )


@njit(nogil=True, cache=True, error_model="numpy")
def _across(
    field: AnyArray, i: int, j: int, k: int, c: int,
    w00: float, w01: float, w10: float, w11: float,
) -> float:  # fmt: skip
    """Interpolate a component in a plane of nodes."""
    value: float = (
        w00 * field[j, i, k, c]
        + w01 * field[j, i + 1, k, c]
        + w10 * field[j + 1, i, k, c]
        + w11 * field[j + 1, i + 1, k, c]
    )
    return value
