"""The image that an object would make, as plain arrays: no napari, no Qt.

- predict an image: `ForwardJob`, with a `Forecast` as the answer
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_shadowinv._napari.widgets._jobs import plane_of
from napari_shadowinv._napari.widgets._phantoms import PhantomRecipe
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv.options import InversionOptions

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Deflector, Setup

__all__ = ["Forecast", "ForwardJob"]

Image = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Forecast:
    """The image that an object would make.

    Attributes
    ----------
    image : ndarray, shape (H, W)
        Flux of each pixel, in the unit of the source.
    displacement : ndarray, shape (2, H, W)
        Displacement of the rays, px.
    source : ndarray, shape (H, W), or None
        The undisturbed beam, without what the object stops; None if it is uniform.
    caustic_share : float
        Share of the pixels whose rays cross or nearly do.
    kept : float
        Share of the flux that lands inside the image.
    assumed : str
        In words, what is taken to bend the beam in another experiment; empty in its own.
    """

    image: Image
    displacement: Image
    source: Image | None
    caustic_share: float
    kept: float
    assumed: str = ""

    @property
    def warning(self) -> str:
        """What to know before planning with it; empty if there is nothing."""
        texts = [self.assumed] if self.assumed else []
        if self.caustic_share > 0:
            texts.append(
                f"Caustics: rays cross or nearly cross in {self.caustic_share:.2%} of the "
                "pixels. Once rays cross, one image no longer determines the whole field."
            )
        if self.kept < 0.99:
            texts.append(f"Only {self.kept:.1%} of the flux lands inside the image.")
        return " ".join(texts)


@dataclass(frozen=True, eq=False)
class ForwardJob:
    """An image to predict.

    Attributes
    ----------
    field : array_like, shape (H, W) or (2, H, W), or PhantomRecipe
        A potential, a displacement in px, or an object to make one.
    shape : tuple of int
        Height and width of a phantom's image; a potential has its own.
    to_px2 : float
        Factor that brings the potential to px².
    setup : Setup, optional
        The experiment; a magnetic phantom needs it.
    made_with : Setup, optional
        The experiment that the field was found in, if it is another one.
    deflector : str, optional
        What bends the beam, see `napari_shadowinv.physics.projection`.
    source : array_like, shape (H, W), optional
        The undisturbed beam. Default: uniform.
    caustic_jacobian : float
        See `InversionOptions`.
    """

    field: ArrayLike | PhantomRecipe
    shape: tuple[int, int] = (200, 200)
    to_px2: float = 1.0
    setup: Setup | None = None
    made_with: Setup | None = None
    deflector: Deflector | None = None
    source: ArrayLike | None = None
    caustic_jacobian: float = InversionOptions.model_fields["caustic_jacobian"].default

    def run(
        self, on_progress: OnProgress | None = None, should_stop: ShouldStop | None = None
    ) -> Forecast:
        """Predict it.

        Raises
        ------
        InputError
            If the field or the source cannot be used.
        InversionCancelled
            If `should_stop` returned true.
        """
        from napari_shadowinv.physics.forward import jacobian_determinant, synthetic_image

        report = Reporter(on_progress, should_stop)
        report("field", 0, None)
        displacement, assumed = self._seen(self._displacement())
        source, shadow = self._source(displacement.shape[1:])
        image = synthetic_image(
            displacement, source, on_progress=on_progress, should_stop=should_stop
        )
        caustic = jacobian_determinant(displacement) < self.caustic_jacobian
        if shadow is not None:
            caustic &= ~shadow
        flux = image.size if source is None else source.sum()
        kept = float(image.sum() / flux) if flux else 1.0
        return Forecast(image, displacement, source, float(caustic.mean()), kept, assumed)

    def _source(self, shape: tuple[int, ...]) -> tuple[Image | None, Mask | None]:
        """The beam that passes, and where the object stops it."""
        source = None if self.source is None else plane_of(self.source, "the source")
        if not isinstance(self.field, PhantomRecipe):
            return source, None
        shadow = self.field.shadow(self.shape, self.setup)
        if shadow is None:
            return source, None
        return np.where(shadow, 0.0, np.ones(shape) if source is None else source), shadow

    def _seen(self, displacement: Image) -> tuple[Image, str]:
        """The displacement in the experiment that is asked for, and what that assumes."""
        from napari_shadowinv.physics.projection import default_deflector, transferred_displacement

        made_with, setup = self.made_with, self.setup
        if made_with is None or setup is None or made_with == setup:
            return displacement, ""
        deflector = self.deflector or default_deflector(made_with, setup)
        shape: Any = None if self.source is None else np.shape(self.source)
        moved = transferred_displacement(
            displacement,
            made_with,
            setup,
            deflector=deflector,
            shape=shape,
        )
        return moved, f"For another setup, assuming that only a {deflector} deflects the beam."

    def _displacement(self) -> Image:
        from napari_shadowinv.physics.setup import displacement_from_potential

        if isinstance(self.field, PhantomRecipe):
            return self.field.phantom(self.shape, self.setup).displacement
        if np.ndim(self.field) == 3:
            return np.asarray(self.field, dtype=np.float64)
        return displacement_from_potential(self.to_px2 * plane_of(self.field, "the potential"))
