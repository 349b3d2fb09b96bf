"""Each of several images predicted from a fit of the others: `leave_one_out`.

Images that one field does not explain along with the rest spoil every fit that they take part in.
They are found first, in larger pixels, and take part in no prediction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import OnProgress, OnStep, ShouldStop, run_in_parallel
from napari_shadowinv._system.validation import as_model
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting._fit import report_steps, reweight_counts
from napari_shadowinv.fitting.compilation import ensure_compiled
from napari_shadowinv.fitting.conjugate_gradients import SoftModes, product
from napari_shadowinv.fitting.descent import finer, settle
from napari_shadowinv.fitting.forward import Linear, Scene
from napari_shadowinv.fitting.left_out import LeaveOneOut, check_count, explanation_of
from napari_shadowinv.fitting.measurements import FitData, collect_data
from napari_shadowinv.fitting.posterior import Posterior
from napari_shadowinv.fitting.rays import at_rest
from napari_shadowinv.fitting.search import (
    COARSE_GAIN,
    FIRST_SMOOTHNESS,
    SMOOTHNESS_RATIO,
    Minimum,
    estimate_smoothness,
    refine_minimum,
    search,
    settle_minimum,
)
from napari_shadowinv.fitting.shots import Shots
from napari_shadowinv.fitting.starts import collect_starts
from napari_shadowinv.fitting.unknowns import Unknowns
from napari_shadowinv.options import FitOptions, Instrument

_T = TypeVar("_T")


def leave_one_out(
    shots: Shots,
    *,
    fields: Sequence[str] = ("B",),
    options: FitOptions | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> LeaveOneOut:
    """Predict each of several images from a fit of the others, to see whether one field fits all.

    Images that one field does not explain along with the rest are found first; they are predicted
    like the others, and no image is predicted from them. Only the
    brightness of the image that is left out is adjusted, and its position if the options let
    images be aligned.

    Parameters
    ----------
    shots, fields, options
        As for `fit`, with three images or more, and without fiducials or a field to start from.
        The instrument counts as exact.
    on_progress, should_stop : callable, optional
        As for `fit`.

    Returns
    -------
    LeaveOneOut

    Raises
    ------
    InputError
        As `fit`, and if there are fewer than three images.
    InversionCancelled
        If `should_stop` returned true.
    """
    options = as_model(FitOptions, options, "options")
    exact = Instrument(beam_rms=0.0)
    data = collect_data(shots, fields=fields, instrument=exact, options=options)
    check_count(len(data.units))
    if data.scene.fiducials is not None or data.start is not None:
        raise InputError(
            "received fiducials or a start, which belong to the first image: leave them out, "
            "because that image is left out, too"
        )
    ensure_compiled(on_progress, should_stop)
    on_step = report_steps("leave one out", on_progress, should_stop)
    first = search(data.scene, collect_starts(data, on_step, should_stop), on_step)[0]
    work = _Work(data, on_step, data.scene, first)
    agreeing = work.find_agreeing()
    predictions = work.with_smoothness(agreeing).predict_all(agreeing)
    return _result(data, predictions)


class _Prediction(NamedTuple):
    """The prediction of an image by others, in units of its beam, and the limit of its χ²."""

    image: FloatArray
    weights: FloatArray
    brightness: float
    chi2: float
    alone: float
    limit: float


@dataclass(frozen=True)
class _SampledFit:
    """Unknowns of all images by a fit at full size of some; random changes that it leaves open."""

    scene: Scene  # of those images
    unknowns: Unknowns
    changes: list[Unknowns]

    def variance_in(self, linear: Linear) -> float:
        """Return the mean square of the changes in one image, in units of its noise."""
        no_change = linear.unknowns.zeros()
        residuals = [
            linear.push(no_change._replace(potentials=change.potentials, common=change.common))
            for change in self.changes
        ]
        return float(np.mean(np.square(residuals)[:, linear.scene.weights > 0]))


class _JointFit(NamedTuple):
    members: list[int]
    linear: Linear
    unknowns: Unknowns  # of all images


@dataclass(frozen=True)
class _Work:
    """Context of all steps: inputs, the callback for progress, and what earlier steps have found.

    That is the `scene` of all images, the field that they have in `common`, and a `joint` fit.
    Folds are deeper in the image that is displaced most than in those that predict it, hence the
    `dense` rays: shares of their usual distance. Fits of more than `most_sampled` pixels of all
    images are sampled in pixels of two.
    """

    data: FitData
    on_step: OnStep
    scene: Scene
    common: Minimum
    joint: _JointFit | None = None
    dense: float = 0.5
    most_sampled: int = 2_000_000

    @property
    def _all(self) -> list[int]:
        return list(range(len(self.data.units)))

    def _run_for_each(self, numbers: list[int], work: Callable[[_Work, int], _T]) -> dict[int, _T]:
        """Call `work(context, number)` for images, in threads."""

        def run(k: int, on_step: OnStep) -> _T:
            return work(replace(self, on_step=on_step), k)

        threads = available_threads(self.data.options.threads)
        results = run_in_parallel([partial(run, k) for k in numbers], threads, self.on_step)
        return dict(zip(numbers, results, strict=True))

    def find_agreeing(self) -> list[int]:
        """The most images that one field explains, found in pixels of two."""
        work = self
        if self.data.options.smoothness is None:
            usual = SMOOTHNESS_RATIO * np.tile(FIRST_SMOOTHNESS, (len(self.scene.smoothness), 1))
            work = replace(self, scene=replace(self.scene, smoothness=usual))
        alone = work._run_for_each(
            self._all,
            lambda work, k: work._settle_members(work.common, [k], f"image {k + 1} alone"),
        )
        most: list[int] = []
        remaining = self._all
        while len(remaining) > len(most):
            group = work._find_group(remaining, alone)
            most = max(most, group, key=len)
            remaining = [k for k in remaining if k not in group]
        return most

    def _settle_without(self, k: int, minimum: Minimum, group: list[int]) -> Minimum:
        """Fit a group but for one image; unknowns of all are kept, so that each can come back."""
        members = [image for image in group if image != k]
        return self._settle_members(minimum, members, f"without image {k + 1}")

    def _find_group(
        self, left: list[int], alone: dict[int, Minimum], *, fewest: int = 2, worse: float = 1.3
    ) -> list[int]:
        """Images that one field explains, after removing the worst one by one.

        An image is explained if its χ², in pixels of two, where a misfit counts four times, is
        less than `worse` times the χ² of a field of its own.
        """
        least = np.array([self._chi2_in_middle(alone[k], [k])[0] for k in self._all])
        together = self._settle_members(self.common, left, "all images")
        while len(left) > fewest:
            if (self._chi2_in_middle(together, left) / least[left]).max() < worse:
                break
            without = partial(_Work._settle_without, minimum=together, group=left)
            tried = self._run_for_each(left, without)
            out = min(left, key=lambda k: tried[k].value + alone[k].value)
            left = [k for k in left if k != out]
            together = tried[out]
        return left

    def with_smoothness(self, members: list[int]) -> _Work:
        """Return the same with the λ and κ and the field of some images, and weights of counts."""
        rng, start = np.random.default_rng(self.data.options.seed), self.common.unknowns
        first = replace(self.common, unknowns=start.only(members))
        part, best = estimate_smoothness(self.scene.only(members), first, rng, self.on_step)
        scene = replace(self.scene, smoothness=part.smoothness)
        common = replace(best, unknowns=start.with_images(members, best.unknowns))
        if not self.data.counted:
            return replace(self, scene=scene, common=common)
        work = replace(self, scene=reweight_counts(self.data, scene, common))
        return replace(work, common=work._settle_members(common, members, "all that agree"))

    def predict_all(self, agreeing: list[int]) -> list[_Prediction]:
        """Each image as all others predict it that agree.

        Larger pixels may set aside too many: images that the others predict are added again.
        """
        work = self._with_joint_fit(agreeing)
        alone = work._run_for_each(self._all, _Work._fit_alone)
        predictions: dict[int, _Prediction] = {}
        while outside := [k for k in self._all if k not in agreeing]:
            fit = work._sample_fit(agreeing)
            for k in outside:
                predictions[k] = work._predict(k, agreeing, fit, alone[k])
            back = [k for k in outside if predictions[k].chi2 <= predictions[k].limit]
            if not back:
                break
            agreeing = sorted([*agreeing, *back])
            work = self._with_joint_fit(agreeing)

        def predict(work: _Work, k: int) -> _Prediction:
            others = [image for image in agreeing if image != k]
            return work._predict(k, others, work._sample_fit(others), alone[k])

        predictions |= work._run_for_each(agreeing, predict)
        return [predictions[k] for k in self._all]

    def _with_joint_fit(self, members: list[int]) -> _Work:
        if self.scene.only(members).images.size > self.most_sampled:
            return self
        _, fine, unknowns, _ = self._fit_densely(members)
        of_all = finer(self.common.unknowns).with_images(members, unknowns)
        return replace(self, joint=_JointFit(members, fine.linear(unknowns), of_all))

    def _fit_densely(
        self, members: list[int], least_gain: float = 0.5
    ) -> tuple[Minimum, Scene, Unknowns, float]:
        coarse = self._settle_members(self.common, members, _name(members), least_gain)
        first = replace(coarse, unknowns=coarse.unknowns.only(members))
        scene = self.scene.only(members)
        fine, unknowns, *_ = refine_minimum(scene, first, self.data.options, self.on_step)
        fine = replace(fine, spacing=self.dense * fine.spacing)
        return coarse, fine, *self._settle_densely(fine, unknowns, members)

    def _settle_densely(
        self,
        fine: Scene,
        unknowns: Unknowns,
        members: list[int],
        linear: Linear | None = None,
        *,
        steps: int = 4,
        least_gain: float = 0.5,
    ) -> tuple[Unknowns, float]:
        unknowns, value, *_ = settle(
            fine,
            unknowns,
            steps=steps,
            least_gain=least_gain,
            after_step=partial(self.on_step, _name(members)),
            linear=linear,
        )
        return unknowns, value

    def _sample_fit(
        self, members: list[int], *, count: int = 2, tolerance: float = 0.05
    ) -> _SampledFit:
        """Fit some images, from a joint fit of these and others if there is one.

        `count` samples show how far the images leave the unknowns open.
        """
        linear = self._linear_of(members)
        large = False
        if linear is not None and self.joint is not None:
            fine, start = linear.scene, self.joint.unknowns
            unknowns, value = self._settle_densely(fine, start.only(members), members, linear)
            sampled = fine, unknowns
        else:
            coarse, fine, unknowns, value = self._fit_densely(members)
            start, sampled = finer(coarse.unknowns), (fine, unknowns)
            large = fine.images.size > self.most_sampled
            if large:
                sampled = coarse.coarsen(self.scene.only(members)), coarse.unknowns.only(members)
        rng = np.random.default_rng(self.data.options.seed)
        report = partial(self.on_step, _name(members), value)
        posterior = Posterior(*sampled, rng, report, linear=linear)
        samples = posterior.draw_samples(count, tolerance)
        changes = [sample.change for sample in samples]
        if large:
            changes = [finer(change) for change in changes]
        return _SampledFit(fine, start.with_images(members, unknowns), changes)

    def _predict(
        self,
        k: int,
        others: list[int],
        fit: _SampledFit,
        alone: tuple[float, float],
        *,
        most_noise: float = 1.15,
        most_variance: float = 5.0,
        of_rays: float = 2.5,
    ) -> _Prediction:
        """One image, as others predict it.

        Its χ² may be `most_noise`, and `most_variance` times the variance of the prediction: the
        squared error is about as large, but up to four times in deep folds of narrow objects. That
        variance includes `of_rays` times the change by denser rays.
        """
        scene = replace(self.scene, spacing=fit.scene.spacing)
        unknowns = fit.unknowns
        if scene.free_frames.any():
            unknowns = _align_image(scene, unknowns, others[0], k)
        unknowns = unknowns.only([k])._replace(brightness=np.zeros(1))
        scene = scene.only([k])
        (rough,) = scene.model(unknowns)
        scene = replace(scene, spacing=self.dense * scene.spacing)
        (image,) = scene.model(unknowns)
        brightness, weights = self._match_brightness(k, image, scene)
        chi2 = _chi2(brightness * image, scene.images[0], weights)
        variance = fit.variance_in(self._linear_of([k]) or scene.linear(unknowns))
        variance += of_rays * _chi2(brightness * image, brightness * rough, weights)
        limit = most_noise + most_variance * variance
        own_chi2, noise_chi2 = alone
        return _Prediction(
            brightness * image, weights, brightness, chi2, own_chi2, limit * noise_chi2
        )

    def _fit_alone(self, k: int, most_fitted: float = 0.9) -> tuple[float, float]:
        """χ² of an image with a field of its own, and of the noise in it.

        Where few pixels are in use, the field is taken to fit at most a share `most_fitted` of
        the noise.
        """
        fit = self._sample_fit([k])
        unknowns = fit.unknowns.only([k])
        chi2 = float(fit.scene.chi2(fit.scene.model(unknowns))[0])
        # A field of an image's own follows the noise by as much as it is left open.
        variance = fit.variance_in(self._linear_of([k]) or fit.scene.linear(unknowns))
        share = min(variance, most_fitted)
        return chi2, chi2 / (1 - share)

    def _match_brightness(self, k: int, made: FloatArray, one: Scene) -> tuple[float, FloatArray]:
        """Brightness with which a prediction is nearest to an image, and the pixels' weights."""
        (weights,), (data,) = one.weights, one.images
        brightness = _brightness(made, data, weights)
        if self.data.counted:
            unit = self.data.units[k]
            expected = np.maximum(brightness * made * unit, 1.0)
            weights = np.where(weights > 0, unit**2 / expected, 0.0)
            brightness = _brightness(made, data, weights)
        return brightness, weights

    def _settle_members(
        self, minimum: Minimum, members: list[int], name: str, least_gain: float = COARSE_GAIN
    ) -> Minimum:
        """Fit some of the images; brightness and frames of the others stay."""
        first = replace(minimum, unknowns=minimum.unknowns.only(members), modes=SoftModes())
        end = settle_minimum(self.scene.only(members), first, self.on_step, name, least_gain)
        unknowns = minimum.unknowns.with_images(members, end.unknowns)
        return replace(end, unknowns=unknowns, modes=SoftModes())

    def _chi2_in_middle(self, minimum: Minimum, members: list[int]) -> FloatArray:
        scene = minimum.coarsen(self.scene.only(members))
        return scene.chi2(scene.model(minimum.unknowns.only(members)))

    def _linear_of(self, members: list[int]) -> Linear | None:
        """Some images to first order by a joint fit, if there is one in which all take part."""
        joint = self.joint
        if joint is None or not set(members) <= set(joint.members):
            return None
        return joint.linear.only([joint.members.index(k) for k in members])


def _name(members: list[int]) -> str:
    return f"images {', '.join(str(k + 1) for k in members)}"


def _align_image(scene: Scene, unknowns: Unknowns, first: int, k: int, steps: int = 4) -> Unknowns:
    """Find where an image lies, and its brightness, beside one whose place is known."""
    pair = scene.only([first, k])
    weights = np.append(np.where(scene.free_frames, scene.prior.frame_weights, 0.0), 1.0)
    now = unknowns.only([first, k])
    # Of each number of the second image's frame that is free, and of its brightness.
    places = np.flatnonzero(scene.free_frames)
    units = [now.zeros() for _ in range(len(places) + 1)]
    for unit, place in zip(units, places, strict=False):
        unit.frames[1, place] = 1
    units[-1].brightness[1] = 1
    for _ in range(steps):
        counts = pair.ray_counts(now)
        linear = pair.linear(now, counts)
        columns = [linear.push(unit)[1].ravel() for unit in units]
        misfit = (pair.model(now, counts) - pair.images)[1] * np.sqrt(pair.weights[1])
        matrix = np.array([[product(a, b) for b in columns] for a in columns])
        slope = np.array([product(column, misfit.ravel()) for column in columns])
        about_rest = np.append(now.frames[1] - at_rest(), now.brightness[1])
        free = np.append(scene.free_frames, True)
        step = np.linalg.solve(
            matrix + np.diag(weights[free]), -slope - weights[free] * about_rest[free]
        )
        for unit, share in zip(units, step, strict=True):
            now = now.plus(unit, float(share))
    return unknowns.with_images([k], now.only([1]))


def _brightness(made: FloatArray, data: FloatArray, weights: FloatArray) -> float:
    above = np.einsum("yx,yx,yx", weights, made, data)
    return float(above / max(np.einsum("yx,yx,yx", weights, made, made), 1e-300))


def _chi2(made: FloatArray, data: FloatArray | float, weights: AnyArray) -> float:
    return float(((made - data) ** 2 * weights).sum() / (weights > 0).sum())


def _result(data: FitData, predictions: Sequence[_Prediction]) -> LeaveOneOut:
    height, width = data.size
    units = data.units[:, None, None]
    used = data.scene.weights[:, :height, :width] > 0
    images = data.scene.images[:, :height, :width] * units
    arrays = map(np.array, zip(*predictions, strict=True))
    predicted, weights, brightness, chi2, alone, limit = arrays
    models = predicted[:, :height, :width] * units
    residual = np.where(used, images - models, 0.0)
    level = np.where(used, images, 0.0).sum(axis=(1, 2)) / used.sum(axis=(1, 2))
    squares = (residual**2).sum(axis=(1, 2)) / used.sum(axis=(1, 2))
    return LeaveOneOut(
        images=images,
        mask=used,
        predicted=models,
        residual=residual,
        brightness=brightness * data.brightness,
        chi2=chi2,
        alone=alone,
        limit=limit,
        rms=np.sqrt(squares) / level,
        explanation=explanation_of(chi2, limit, data.setups, data.names),
        setups=data.setups or (),
        names=data.names or (),
        noise=data.noise_of(weights),
    )
