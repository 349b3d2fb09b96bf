"""What all estimates of the source share: `Estimate`."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing.steps import Choice

if TYPE_CHECKING:
    from napari_shadowinv._system.progress import OnWarning, ShouldStop
    from napari_shadowinv.physics.setup import Setup

__all__ = ["Estimate"]


class Estimate(Choice):
    """A way to guess the undisturbed beam from the shot.

    Attributes
    ----------
    needs_mask, uses_mask : bool
        Whether it does nothing without a mask, or anything with one.
    """

    key = "method"
    needs_mask: ClassVar[bool] = False
    uses_mask: ClassVar[bool] = True

    def check(self, *, has_mask: bool) -> None:
        """Refuse to work without a mask where one is needed.

        Parameters
        ----------
        has_mask : bool
            Whether there is one.

        Raises
        ------
        InputError
            If there is none, and one is needed.
        """
        if self.needs_mask and not has_mask:
            raise InputError(
                f"got the estimate '{self.title}' without a mask: it fills in the masked pixels; "
                "choose a mask that covers the object"
            )

    def placed(
        self, setup: Setup | None, shape: tuple[int, int], matrix: FloatArray | None = None
    ) -> Estimate:
        """Return the same for the images of an experiment; most estimates do not depend on it.

        Parameters
        ----------
        setup : Setup or None
            Of the image whose source is to be estimated, None if it is not known.
        shape : tuple of int
            Shape (H, W) of the image as recorded.
        matrix : ndarray, shape (3, 3), optional
            What takes (y, x, 1) from the image whose source is to be estimated to the image as
            recorded. Default: they are the same.

        Raises
        ------
        InputError
            If the estimate needs another setup.
        """
        return self

    def source(
        self,
        image: FloatArray,
        mask: BoolArray | None,
        should_stop: ShouldStop | None = None,
        on_warning: OnWarning | None = None,
    ) -> FloatArray:
        """Estimate the source.

        Parameters
        ----------
        image : ndarray, shape (H, W)
            The shot.
        mask : ndarray of bool, shape (H, W), or None
            The pixels to look at.
        should_stop : callable, optional
            Asked now and then by estimates that take long.
        on_warning : callable, optional
            Receives a sentence where the estimate has to be doubted. Default: `warnings.warn`.

        Returns
        -------
        ndarray, shape (H, W)

        Raises
        ------
        InputError
            If the image cannot be used.
        InversionCancelled
            If `should_stop` returned true.
        """
        self.check(has_mask=mask is not None)
        return self._source(image, mask, should_stop, on_warning)

    def coarser(self, factor: int) -> Estimate:
        """Return the same for an image with pixels `factor` times as large."""
        lengths = {
            name: getattr(self, name) / factor
            for name, field in self.parameters().items()
            if (field.title or "").endswith("(px)")
        }
        return self.model_copy(update=lengths)

    def _source(
        self,
        image: FloatArray,
        mask: BoolArray | None,
        should_stop: ShouldStop | None,
        on_warning: OnWarning | None,
    ) -> FloatArray:
        raise NotImplementedError
