"""Scales in which the Hessian of a fit is about the identity: `Preconditioner`."""

from __future__ import annotations

from copy import copy
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.fft import dct, dctn, idctn
from scipy.ndimage import gaussian_filter, laplace

from napari_shadowinv._typing import FloatArray, IntArray
from napari_shadowinv.fitting.forward import Linear, Scene
from napari_shadowinv.fitting.unknowns import Unknowns
from napari_shadowinv.instrument.effects import DARKEST, RESPONSES

_SCALE, _TRANSPOSE = "nmyx,nyx->myx", "nmyx,myx->nyx"  # sums over the fields of scales


class _Coupling(NamedTuple):
    """The coupling of the `long` waves of potentials and numbers of the beams, at `places`.

    With M the scaled Hessian between both, and D that of these numbers, all other blocks being the
    identity: M as a `table` (n, M, …) and a `root` of (D - MᵀM)⁻¹.
    """

    long: tuple[Any, ...]
    places: IntArray
    table: FloatArray
    root: FloatArray


class Preconditioner:
    """Scales in which the Hessian is about the identity: Sᵀ H S ≈ 1.

    Diagonal in the cosines of the potentials, except for the coupling of two fields, and of fields
    and beams.
    """

    def __init__(self, scene: Scene) -> None:
        prior, squares = scene.prior, scene.prior.wave_numbers
        widths = [psf if isinstance(psf, float) else 0.0 for psf in scene.psf]
        variances = scene.blur**2 + np.square(widths)
        weights = np.exp(-variances[:, None, None] * squares)
        weights *= scene.knot**2 * scene.weights.mean(axis=(1, 2))[:, None, None]
        # An image's change by a weak potential is its Laplacian.
        laplacian = -squares * np.sqrt(prior.power_seen)
        data = np.einsum("lyx,li,lj->yxij", weights, scene.strengths, scene.strengths)
        data *= laplacian[:, :, None, None] ** 2
        of_data = np.moveaxis(np.diagonal(data, axis1=2, axis2=3), -1, 0)
        rough = prior.roughness
        self.determined = np.divide(
            of_data, of_data + rough, out=np.ones_like(rough), where=rough > 0
        )
        of_prior = np.moveaxis(prior.of_potentials(), 0, -1)
        matrix = data + of_prior[..., None] * np.eye(of_prior.shape[-1])
        roots = np.linalg.inv(np.linalg.cholesky(matrix))
        self._potentials = np.ascontiguousarray(np.moveaxis(roots, (2, 3), (0, 1)))
        self.log_ratio = 0.5 * float(np.linalg.slogdet(matrix)[1].sum())
        self.log_ratio -= 0.5 * float(np.log(of_prior).sum())
        pixels = scene.weights.sum(axis=(1, 2))
        brightness = np.where(scene.free_brightness, 1 / np.sqrt(pixels + 1), 0.0)
        # Images have contrasts of some tenths over some pixels; stretching moves the edge by more.
        arm = max(scene.rays.size) / 4
        moved = 0.02 * pixels[:, None] * np.array([1, arm, arm, 1, arm, arm]) ** 2
        frames = np.where(scene.free_frames, 1 / np.sqrt(moved + prior.frame_weights), 0.0)
        frames[0] = 0
        common, separate = _number_scales(scene)
        self._diagonals = [common, brightness, frames, separate]
        self._scene, self._weights, self._laplacian = scene, weights, laplacian

    @cached_property
    def _coupling(self) -> _Coupling:
        """How weak fields can replace beams."""
        scene, weights, laplacian = self._scene, self._weights, self._laplacian
        places, images, of_beams = _beam_cosines(scene)
        scales, count = self.others[places], of_beams.shape[1:]
        long = np.s_[..., : count[0], : count[1]]
        squares = np.diag(np.where(scales > 0, scales**2, 1.0))
        pulls = np.zeros((len(scales), scene.strengths.shape[1], *count))
        # Images whose beams have the same numbers are counted together.
        groups: dict[bytes, list[int]] = {}
        for k, seen in enumerate(images.T):
            groups.setdefault(seen.tobytes(), []).append(k)
        for group in groups.values():
            waves = (scales * images[:, group[0]])[:, None, None] * of_beams
            of_fields = np.einsum("lm,lyx->myx", scene.strengths[group], weights[long][group])
            pulls += of_fields * (laplacian[long] * waves)[:, None]
            waves *= np.sqrt(weights[long][group].sum(axis=0))
            squares += np.einsum("qyx,pyx->qp", waves, waves)
        table = np.einsum("nmyx,qmyx->qnyx", self._potentials[long], pulls)
        squares -= np.einsum("qmyx,pmyx->qp", table, table)
        return _Coupling(long, places, table, np.linalg.inv(np.linalg.cholesky(squares)).T)

    def _turn(self, waves: FloatArray, others: FloatArray) -> None:
        """Turn scaled values in place: with the beams move the fields that replace them."""
        long, places, table, root = self._coupling
        others[places] = numbers = np.einsum("qp,p->q", root, others[places])
        waves[long] -= np.einsum("q,qmyx->myx", numbers, table)

    def _turn_back(self, waves: FloatArray, others: FloatArray) -> None:
        """Apply the transpose of `_turn` in place."""
        long, places, table, root = self._coupling
        numbers = others[places] - np.einsum("qmyx,myx->q", table, waves[long])
        others[places] = np.einsum("qp,q->p", root, numbers)

    def held(self) -> Preconditioner:
        """Return scales in which the numbers of an instrument do not change."""
        scales = copy(self)
        common, brightness, frames, separate = self._diagonals
        scales._diagonals = [0 * common, brightness, frames, 0 * separate]
        scales.others = np.concatenate([part.ravel() for part in scales._diagonals])
        long, places, table, root = self._coupling
        scales._coupling = _Coupling(long, places[:0], table[:0], root[:0, :0])
        return scales

    def damp(self, unknowns: Unknowns) -> Unknowns:
        """Return unknowns without the finest waves, which knots further apart leave behind."""
        waves = dctn(unknowns.potentials, axes=(1, 2), norm="ortho") * self.determined
        return unknowns._replace(potentials=idctn(waves, axes=(1, 2), norm="ortho"))

    def times(self, scaled: Unknowns) -> Unknowns:
        """Return S times scaled unknowns: their change."""
        return scaled.like(self._changed(scaled.flat(), scaled)[1])

    def _changed(self, scaled: FloatArray, like: Unknowns) -> tuple[FloatArray, FloatArray]:
        """Cosines of the potentials' change by scaled values, and the change of all values."""
        size = like.potentials.size
        flat = scaled.copy()
        waves, others = flat[:size].reshape(like.potentials.shape), flat[size:]
        self._turn(waves, others)
        waves = self._potentials_times(waves)
        flat[:size] = idctn(waves, axes=(1, 2), norm="ortho").ravel()
        others *= self.others
        return waves, flat

    def transpose_times(self, slope: Unknowns) -> Unknowns:
        """Return Sᵀ times derivatives: those with respect to scaled unknowns."""
        waves = dctn(slope.potentials, axes=(1, 2), norm="ortho")
        return slope.like(self._scaled(waves, slope.flat()))

    def _scaled(self, waves: FloatArray, flat: FloatArray) -> FloatArray:
        """Sᵀ times derivatives, by the cosines of those by potentials, in place of all."""
        waves = self._potentials_times(waves, _TRANSPOSE)
        others = flat[waves.size :]
        others *= self.others
        self._turn_back(waves, others)
        flat[: waves.size] = waves.ravel()
        return flat

    def hessian_times(self, linear: Linear, scaled: FloatArray) -> FloatArray:
        """Return Sᵀ H S times scaled unknowns, both flat, by half of the transforms of each."""
        unknowns, prior = linear.unknowns, linear.scene.prior
        waves, flat = self._changed(scaled, unknowns)
        change = unknowns.like(flat)
        slope = linear.normal_times(change)
        prior.add_ties(change.potentials, slope.potentials)
        of_data = dctn(slope.potentials, axes=(1, 2), norm="ortho")
        of_data += prior.roughness * waves
        result, size = slope.flat(), waves.size
        result[size:] += linear.weights_of_others * flat[size:]
        return self._scaled(of_data, result)

    @property
    def has_rough_numbers(self) -> bool:
        """Whether numbers of the instrument may change in scales that hardly know the fields.

        Where each image has a beam of its own, fields are replaced nearly altogether.
        """
        common, separate = (self._diagonals[place] for place in (0, 3))
        return bool(separate.any() or np.count_nonzero(common) > len(self._coupling.places))

    @cached_property
    def others(self) -> FloatArray:
        """Scales of all values but the potentials."""
        return np.concatenate([part.ravel() for part in self._diagonals])

    def _potentials_times(self, waves: FloatArray, sums: str = _SCALE) -> FloatArray:
        """Cosines of the potentials by scaled ones, or the transpose."""
        if len(waves) == 1:  # a product is faster than a sum over one field
            return np.asarray(self._potentials[0] * waves)
        return np.asarray(np.einsum(sums, self._potentials, waves))


def _number_scales(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Return approximate standard deviations of an instrument's numbers, (n,) and (L, n)."""
    imperfect, weights = scene.imperfect, scene.weights
    common, separate = (np.ones(count) for count in imperfect.counts)
    separate = np.tile(separate, (len(weights), 1))
    images = np.maximum(scene.images, DARKEST)
    changes = {
        "blur": imperfect.blur / 2 * laplace(gaussian_filter(images, (0, 1, 1))),
        "other_field": 0.1 * (images - 1),
    }
    for each in RESPONSES:
        if size := imperfect.responses.get(each.key):
            _, _, changes[each.key] = each.record(images, size, 0.0)
    shapes = {each.key: each for each in imperfect.shapes}
    sides = zip(scene.beams.shape[1:], weights.shape[1:], strict=True)
    around = [(scene.pad, beams - scene.pad - image) for beams, image in sides]
    for part in imperfect.parts.values():
        if part.key in shapes:
            curvature = np.stack(
                [shapes[part.key].squares(np.pad(each, around)) for each in weights]
            )
        else:
            curvature = np.einsum("lyx,lyx->l", weights, changes[part.key] ** 2)[:, None]
        curvature = curvature.sum(axis=0) if part.is_common else curvature
        is_held = part.key in scene.held
        part.of(common, separate)[...] = 0 if is_held else 1 / np.sqrt(1 + curvature)
    return common, separate


def _beam_cosines(
    scene: Scene, longest: int = 24, most: int = 150
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the cosines of smooth changes of the beams, within the image, by their first numbers.

    They are the `longest` waves along each axis, for at most `most` numbers of each beam. Returns
    the places of n numbers among all values but the potentials, in which images, (n, L), each acts
    (1), and the cosines at the knots by each number of 1, (n, …).
    """
    lines: list[FloatArray] = []
    knots: list[FloatArray] = []
    for n, side in zip(scene.rays.shape, scene.rays.size, strict=True):
        place = np.asarray(scene.knot * (np.arange(float(n)) - 1) - scene.pad)
        inside = np.clip(np.minimum(place, side - place) / scene.knot + 0.5, 0, 1)
        lines.append(dct(np.diag(inside), axis=0, norm="ortho")[:longest])
        knots.append(place + scene.pad - 0.5)
    numbers, count = scene.nothing(), len(scene.images)
    numbers = numbers.like(np.arange(float(numbers.flat().size)) - numbers.potentials.size)
    waves = [np.empty((0, len(lines[0]), len(lines[1])))]
    places, images = [np.empty(0, np.int64)], [np.empty((0, count))]
    for part, shapes in scene.imperfect.shape_parts():
        if part.key in scene.held or not len(shapes.means) or shapes.envelope is not None:
            continue
        cosines = shapes.cosines(lines, knots)[:most]
        rows = np.atleast_2d(part.of(numbers.common, numbers.separate))
        members = np.ones((1, count)) if part.is_common else np.eye(count)
        for row, seen in zip(rows, members, strict=True):
            waves.append(cosines)
            places.append(row[len(shapes.planes) :][:most].astype(np.int64))
            images.append(np.tile(seen, (len(cosines), 1)))
    return np.concatenate(places), np.concatenate(images), np.concatenate(waves)
