"""Images of a fit, each with all that is known of it: `FitShot`.

- a field near which a fit is to end: `NearField`
- values for all images, from the values of each: `join_shots`
- width of the point spread in px, from the beam's source and the detector: `point_spread`
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.options import KindOfNoise
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.preprocessing import Radiograph


@dataclass(frozen=True, eq=False)
class NearField:
    """A field near the true one, from which alone a fit starts: no alternatives are looked for.

    Attributes
    ----------
    potential : ndarray, shape (H, W)
        In px², of the first field.
    smoothness : tuple of float
        The weights λ and κ of a similar fit, as `FittedField.smoothness`; they are not estimated.
    """

    potential: FloatArray
    smoothness: tuple[float, float]


@dataclass(frozen=True, eq=False)
class FitShot:
    """One image of a fit, and all that is known of it.

    Values of None follow from those for all images; in `run_fit`, from the recipe or the file.

    Attributes
    ----------
    image : Radiograph, array_like of shape (H, W), or path
        As recorded. `fit` takes no path.
    setup : Setup, optional
        Its experiment.
    source : as `image`, or "unknown", optional
        The undisturbed beam; unknown in all images or in none.
    mask, source_mask : array_like of bool or path, optional
        True where a pixel can be used; where the object is not, for a source that `run_fit`
        estimates. Files are 0 elsewhere.
    strength : tuple of float, optional
        Displacement by each field relative to the first image. Default: from the setups.
    brightness : float, optional
        How many times brighter than its source the image is.
    psf : float, optional
        Standard deviation of the point spread in px, after all steps.
    noise : float, "poisson" or "proportional", optional
        Standard deviation in a pixel after all steps, or Poisson noise, or a share of each pixel.
    fiducials : array_like of shape (n, 5), or path of a table, optional
        Known displacements, in the first image only: rows of y, x, dy, dx and their σ, in px after
        all steps.
    start : array_like of shape (H, W), or NearField, optional
        A potential in px² to start from, of the first field, in the first image only. A fit
        starts from other fields, too, unless it is a `NearField`.
    name : str, optional
        Its name in messages. Default: its file or its number.
    measured : bool, default True
        Whether the source was recorded, not estimated from the image.

    Examples
    --------
    >>> shot = FitShot(np.ones((64, 64)), strength=(0.6,), name="14.7 MeV")
    """

    image: Radiograph | ArrayLike | Path
    setup: Setup | None = None
    source: Radiograph | ArrayLike | Path | Literal["unknown"] | None = None
    mask: ArrayLike | Path | None = None
    source_mask: ArrayLike | Path | None = None
    strength: tuple[float, ...] | None = None
    brightness: float | None = None
    psf: float | None = None
    noise: KindOfNoise | float | None = None
    fiducials: ArrayLike | Path | None = None
    start: ArrayLike | NearField | None = None
    name: str | None = None
    measured: bool = True

    @property
    def beam_unknown(self) -> bool:
        """Whether its beam is to be fitted."""
        return isinstance(self.source, str) and self.source == "unknown"


Images = ArrayLike | Mapping[str, ArrayLike] | FitShot | Sequence[FitShot | Radiograph | ArrayLike]
# Attribute of a shot: the value for all images.
_OF_ALL_IMAGES = {
    "strength": "strengths",
    "setup": "setups",
    "source": "source",
    "mask": "mask",
    "brightness": "brightness",
    "noise": "noise",
    "psf": "psf",
}


def common_values(
    names: Sequence[str], values: Sequence[Any], quantity: str
) -> tuple[Any, ...] | None:
    """Return the values of all images, or None if none has one.

    Parameters
    ----------
    names : sequence of str
        Names of the images.
    values : sequence
        A value for each image, or None.
    quantity : str
        Its name.

    Raises
    ------
    InputError
        If some images have a value and others have none.
    """
    without = [name for name, value in zip(names, values, strict=True) if value is None]
    if len(without) == len(names):
        return None
    if without:
        raise InputError(
            f"{without[0]} has no {quantity}, other images have: expected it for all of them, or "
            "none"
        )
    return tuple(values)


def list_shots(images: Images) -> list[FitShot]:
    """Return images with knowledge of their own; none if they are planes alone."""
    if isinstance(images, Mapping):
        images = [replace(_as_shot(image), name=str(name)) for name, image in images.items()]
    planes = list(images) if isinstance(images, (list, tuple)) else [images]
    if not any(isinstance(plane, (FitShot, Radiograph)) for plane in planes):
        return []
    return [_as_shot(plane) for plane in planes]


def _as_shot(image: Any) -> FitShot:
    shot = image if isinstance(image, FitShot) else FitShot(image)
    recorded = shot.image
    if isinstance(recorded, (str, Path)):
        raise InputError(f"received the file {recorded}: read it first, or use run_fit")
    if not isinstance(recorded, Radiograph):
        return shot
    return replace(
        shot,
        image=recorded.image,
        setup=shot.setup or recorded.setup,
        source=recorded.source if shot.source is None else shot.source,
        mask=recorded.mask if shot.mask is None else shot.mask,
    )


def names_of(shots: Sequence[FitShot]) -> tuple[str, ...]:
    """Return the names of images, or their numbers."""
    return tuple(shot.name or f"image {k + 1}" for k, shot in enumerate(shots))


def join_shots(shots: Sequence[FitShot], of_all: Mapping[str, Any]) -> dict[str, Any]:
    """Return values for all images, from the values of each and those `of_all`."""
    names = names_of(shots)
    joined = dict(of_all)
    for attribute, keyword in _OF_ALL_IMAGES.items():
        values = [getattr(shot, attribute) for shot in shots]
        if all(value is None for value in values):
            continue
        common = of_all[keyword]
        if attribute in ("noise", "psf"):
            values = [common if value is None else value for value in values]
        elif not (common is None or (isinstance(common, str) and common == "known")):
            text = f"{keyword}={common!r}" if isinstance(common, str) else keyword
            raise InputError(
                f"received the {attribute} of each image and {text}: expected one of them"
            )
        if attribute == "mask":
            everywhere = np.ones(np.asarray(shots[0].image).shape, bool)
            values = [everywhere if value is None else value for value in values]
        if attribute == "source":
            values = [beam.image if isinstance(beam, Radiograph) else beam for beam in values]
        joined[keyword] = common_values(names, values, attribute)
    if joined["strengths"] is not None and of_all["strengths"] is None:
        joined["setups"] = of_all["setups"]  # the strengths of images precede their setups
        lengths = [len(row) for row in joined["strengths"]]
        if len(set(lengths)) > 1:
            raise InputError(
                f"strengths have {', '.join(map(str, lengths))} numbers: expected one for each "
                "field in all images"
            )
    if isinstance(joined["noise"], tuple):
        joined["noise"] = _common_noise(joined["noise"])
    if isinstance(joined["source"], tuple) and any(shot.beam_unknown for shot in shots):
        flags = [shot.beam_unknown or None for shot in shots]
        common_values(names, flags, "unknown source")
        joined["source"] = "unknown"
    return joined


def _common_noise(noises: Sequence[Any]) -> Any:
    """Return the kind of noise of all images, or their standard deviations."""
    kinds = {repr(noise) if isinstance(noise, str) else "a number" for noise in noises}
    if len(kinds) > 1:
        raise InputError(
            f"noise is {' in some images and '.join(sorted(kinds))} in others: give the same "
            "for all, or numbers"
        )
    return noises[0] if isinstance(noises[0], str) else noises


def value_of_first(shots: Sequence[FitShot], attribute: str) -> Any:
    """Return a value that only the first image may have.

    Raises
    ------
    InputError
        If a later image has one.
    """
    if any(getattr(shot, attribute) is not None for shot in shots[1:]):
        raise InputError(
            f"received {attribute} of a later image: expected them in the first image, whose "
            "pixels are those of the fields"
        )
    return getattr(shots[0], attribute) if shots else None


def point_spread(setup: Setup, source_size: float = 0.0, resolution: float = 0.0) -> float:
    """Return the standard deviation in px by which an image is blurred.

    Parameters
    ----------
    setup : Setup
        The experiment.
    source_size : float, default 0
        Standard deviation of the beam's source in m; a FWHM is 2.355 times as large.
    resolution : float, default 0
        Standard deviation of the detector's point spread in m, at the detector.

    Returns
    -------
    float
        σ in px at the object: a source of size s is seen as s L/l at the detector, all of it
        divided by the magnification.

    Raises
    ------
    InputError
        If a length is negative or not finite.
    """
    for name, length in (("source_size", source_size), ("resolution", resolution)):
        if not 0 <= length < np.inf:
            raise InputError(f"{name} is {length}: expected a length in m, 0 or more")
    magnification = setup.magnification
    width = np.hypot(source_size * (magnification - 1), resolution)
    return float(width / magnification / setup.object_pixel_size)
