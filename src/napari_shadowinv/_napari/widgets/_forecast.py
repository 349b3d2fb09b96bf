"""The image that an object would make, as plain arrays: no napari, no Qt."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ConfigDict, Field

from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.pipeline._run import plane_of

if TYPE_CHECKING:
    from napari_shadowinv.physics.phantoms import Phantom
    from napari_shadowinv.physics.setup import Deflector, Setup


class PhantomRecipe(CheckedModel):
    """An object whose field is known."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    title: ClassVar[str]
    # Kind of setup that the object needs; empty for any, or none.
    probe: ClassVar[str] = ""

    def phantom(self, shape: tuple[int, int], setup: Any) -> Phantom:
        """Make it in the middle of an image, or raise an `InputError` if it needs another setup."""
        if self.probe and getattr(setup, "kind", None) != self.probe:
            raise InputError(_NEEDS[self.probe])
        from napari_shadowinv.physics import phantoms

        return self._made(phantoms, shape, setup)

    def shadow(self, shape: tuple[int, int], setup: Any) -> BoolArray | None:
        """Pixels where the object stops the beam; None if it is transparent."""
        return None

    def _made(self, phantoms: ModuleType, shape: tuple[int, int], setup: Any) -> Phantom:
        raise NotImplementedError


_NEEDS = {
    "proton": "a magnetic field deflects particles: choose the setup 'particles' for this object",
    "optical": "a plasma wave is probed by light: choose the setup 'light' for this object",
}


def _metres(default: float, title: str, description: str) -> Any:
    return Field(default=default, gt=0, title=f"{title} (m)", description=description)


def _peak(default: float, where: str) -> Any:
    return Field(
        default=default,
        title="Peak field (MG µm)",
        description=f"Path-integrated field at {where}, in MG µm; negative values focus.",
    )


class ToroidRecipe(PhantomRecipe):
    title = "toroidal magnetic field"
    probe = "proton"
    peak: float = _peak(97.0, "the radius")
    radius: float = _metres(30e-6, "Radius", "Radius σ of maximum field, in the object plane.")

    def _made(self, phantoms: ModuleType, shape: tuple[int, int], setup: Any) -> Phantom:
        return phantoms.toroid(shape, setup, self.peak, self.radius)


class FourToroidsRecipe(PhantomRecipe):
    title = "four toroids"
    probe = "proton"
    strength: float = Field(
        default=1.0,
        title="Strength",
        description=(
            "Scale factor for the fields, whose highest peak is 135 MG µm at 1; caustics form at 1."
        ),
        json_schema_extra={"slider": [0.05, 3.0]},
    )

    def _made(self, phantoms: ModuleType, shape: tuple[int, int], setup: Any) -> Phantom:
        return phantoms.four_toroids(shape, setup, self.strength)


class CoaxialRecipe(PhantomRecipe):
    """The paper's two conductors, with equal and opposite currents along the beam."""

    title = "coaxial conductors"
    probe = "proton"
    peak: float = _peak(60.0, "the inner conductor's surface")
    inner: float = _metres(21e-6, "Inner conductor", "Radius of the inner conductor.")
    outer: float = _metres(66e-6, "Outer conductor, inside", "Inner radius of the outer conductor.")
    rim: float = _metres(78e-6, "Outer conductor, outside", "Outer radius of the outer conductor.")

    def shadow(self, shape: tuple[int, int], setup: Any) -> BoolArray:
        return self._line(shape, setup)[1]

    def _made(self, phantoms: ModuleType, shape: tuple[int, int], setup: Any) -> Phantom:
        return self._line(shape, setup)[0]

    def _line(self, shape: tuple[int, int], setup: Any) -> tuple[Phantom, BoolArray]:
        from napari_shadowinv.physics.phantoms import coaxial_line

        return coaxial_line(shape, setup, self.peak, (self.inner, self.outer, self.rim))


class WakefieldRecipe(PhantomRecipe):
    """The paper's plasma wave, seen from the side."""

    title = "plasma wakefield"
    probe = "optical"
    amplitude: float = Field(
        default=0.8,
        title="Amplitude Δn/n₀",
        description="Relative density perturbation at the centre; below 1.",
        json_schema_extra={"slider": [0.0, 1.0]},
    )
    density: float = Field(
        default=1.65e25,
        gt=0,
        title="Density n₀ (m⁻³)",
        description="Electron density of the undisturbed plasma; it sets the plasma wavelength.",
    )
    width: float = _metres(6e-6, "Width", "Radius of the wave perpendicular to its axis.")
    length: float = _metres(14e-6, "Length", "Radius of the wave along its axis.")
    curvature_radius: float = Field(
        default=20e-6,
        title="Wavefront radius of curvature (m)",
        description=(
            "Radius of curvature of the wavefronts on the axis: positive if they lag behind "
            "there, negative if they lead, inf for plane wavefronts."
        ),
    )

    def _made(self, phantoms: ModuleType, shape: tuple[int, int], setup: Any) -> Phantom:
        return phantoms.wakefield(shape, setup, **self.model_dump())


class BlobRecipe(PhantomRecipe):
    title = "Gaussian potential"
    amplitude: float = Field(
        default=50.0,
        title="Amplitude (px²)",
        description="Peak of the normalised potential in px²; negative values focus.",
    )
    sigma: float = Field(
        default=20.0,
        gt=0,
        title="Width (px)",
        description="Standard deviation in px of the object plane.",
    )

    def _made(self, phantoms: ModuleType, shape: tuple[int, int], setup: Any) -> Phantom:
        return phantoms.gaussian_blob(shape, self.amplitude, self.sigma)


PHANTOMS: dict[str, type[PhantomRecipe]] = {
    "toroid": ToroidRecipe,
    "four_toroids": FourToroidsRecipe,
    "coaxial": CoaxialRecipe,
    "wakefield": WakefieldRecipe,
    "blob": BlobRecipe,
}


@dataclass(frozen=True, eq=False)
class Forecast:
    image: FloatArray  # in the unit of the source
    displacement: FloatArray  # px
    source: FloatArray | None  # the beam without what the object stops; None if it is uniform
    caustic_share: float  # of the pixels, whose rays cross or nearly do
    kept: float  # share of the flux that lands inside the image
    assumed: str = ""  # what is taken to bend the beam in another experiment than its own

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
    """An image to predict: of a potential, a displacement in px, or an object."""

    field: ArrayLike | PhantomRecipe
    shape: tuple[int, int] = (200, 200)  # of a phantom's image; a potential has its own
    to_px2: float = 1.0  # brings the potential to px²
    setup: Setup | None = None
    made_with: Setup | None = None  # where the field was found
    deflector: Deflector | None = None
    source: ArrayLike | None = None  # None for a uniform beam
    caustic_jacobian: float = InversionOptions.model_fields["caustic_jacobian"].default

    def run(
        self, on_progress: OnProgress | None = None, should_stop: ShouldStop | None = None
    ) -> Forecast:
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

    def _source(self, shape: tuple[int, ...]) -> tuple[FloatArray | None, BoolArray | None]:
        """The beam that passes, and where the object stops it."""
        source = None if self.source is None else plane_of(self.source, "the source")
        if not isinstance(self.field, PhantomRecipe):
            return source, None
        shadow = self.field.shadow(self.shape, self.setup)
        if shadow is None:
            return source, None
        return np.where(shadow, 0.0, np.ones(shape) if source is None else source), shadow

    def _seen(self, displacement: FloatArray) -> tuple[FloatArray, str]:
        """The displacement in the experiment that is asked for, and what that assumes."""
        from napari_shadowinv.physics.projection import default_deflector, transferred_displacement

        made_with, setup = self.made_with, self.setup
        if made_with is None or setup is None or made_with == setup:
            return displacement, ""
        deflector = self.deflector or default_deflector(made_with, setup)
        shape: Any = None if self.source is None else np.shape(self.source)
        moved = transferred_displacement(
            displacement, made_with, setup, deflector=deflector, shape=shape
        )
        return moved, f"For another setup, assuming that only a {deflector} deflects the beam."

    def _displacement(self) -> FloatArray:
        from napari_shadowinv.physics.setup import displacement_from_potential

        if isinstance(self.field, PhantomRecipe):
            return self.field.phantom(self.shape, self.setup).displacement
        if np.ndim(self.field) == 3:
            return np.asarray(self.field, dtype=np.float64)
        return displacement_from_potential(self.to_px2 * plane_of(self.field, "the potential"))
