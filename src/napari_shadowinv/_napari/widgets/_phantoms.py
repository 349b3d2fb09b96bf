"""Simulated objects and the images that they cast, as plain arrays, without napari and Qt."""

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
from napari_shadowinv.pipeline.inversion_run import plane_of

if TYPE_CHECKING:
    from napari_shadowinv.physics.phantoms import Phantom
    from napari_shadowinv.physics.setup import Deflector, Setup


class PhantomRecipe(CheckedModel):
    """A simulated object with parameters of its field."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    title: ClassVar[str]
    # Kind of setup that the object requires; empty for any setup, or none.
    probe: ClassVar[str] = ""

    def phantom(self, shape: tuple[int, int], setup: Any) -> Phantom:
        """Create the object at the centre of an image; raise an `InputError` for a wrong setup."""
        if self.probe and getattr(setup, "kind", None) != self.probe:
            raise InputError(_SETUP_HINTS[self.probe])
        from napari_shadowinv.physics import phantoms

        return self._build(phantoms, shape, setup)

    def shadow(self, shape: tuple[int, int], setup: Any) -> BoolArray | None:
        """Return the pixels where the object stops the beam; None if it is transparent."""
        return None

    def _build(self, phantoms: ModuleType, shape: tuple[int, int], setup: Any) -> Phantom:
        raise NotImplementedError


_SETUP_HINTS = {
    "proton": "a magnetic field deflects particles: select the setup 'particles' for this object",
    "optical": "a plasma wave is probed by light: select the setup 'light' for this object",
}


def _metres(default: float, title: str, description: str) -> Any:
    return Field(default=default, gt=0, title=f"{title} (m)", description=description)


def _peak(default: float, where: str) -> Any:
    return Field(
        default=default,
        title="Peak field (MG µm)",
        description=f"Path-integrated field at {where}, in MG µm; negative for a focusing field.",
    )


class ToroidRecipe(PhantomRecipe):
    title = "toroidal magnetic field"
    probe = "proton"
    peak: float = _peak(97.0, "the radius")
    radius: float = _metres(30e-6, "Radius", "Radius σ of maximum field, in the object plane.")

    def _build(self, phantoms: ModuleType, shape: tuple[int, int], setup: Any) -> Phantom:
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

    def _build(self, phantoms: ModuleType, shape: tuple[int, int], setup: Any) -> Phantom:
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

    def _build(self, phantoms: ModuleType, shape: tuple[int, int], setup: Any) -> Phantom:
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

    def _build(self, phantoms: ModuleType, shape: tuple[int, int], setup: Any) -> Phantom:
        return phantoms.wakefield(shape, setup, **self.model_dump())


class BlobRecipe(PhantomRecipe):
    title = "Gaussian potential"
    amplitude: float = Field(
        default=50.0,
        title="Amplitude (px²)",
        description="Peak of the normalised potential in px²; negative for a focusing object.",
    )
    sigma: float = Field(
        default=20.0,
        gt=0,
        title="Width (px)",
        description="Standard deviation in px of the object plane.",
    )

    def _build(self, phantoms: ModuleType, shape: tuple[int, int], setup: Any) -> Phantom:
        return phantoms.gaussian_blob(shape, self.amplitude, self.sigma)


PHANTOMS: dict[str, type[PhantomRecipe]] = {
    "toroid": ToroidRecipe,
    "four_toroids": FourToroidsRecipe,
    "coaxial": CoaxialRecipe,
    "wakefield": WakefieldRecipe,
    "blob": BlobRecipe,
}


@dataclass(frozen=True, eq=False)
class Prediction:
    """The image that an object casts, with its displacement and source."""

    image: FloatArray  # in the unit of the source
    displacement: FloatArray  # px
    source: FloatArray | None  # the beam past opaque parts of the object; None if uniform
    caustic_share: float  # of the pixels: rays cross or nearly cross there
    flux_inside: float  # share of the flux that lands inside the image
    assumption: str = ""  # about the deflecting field, for another setup than the field's

    @property
    def warning(self) -> str:
        """Warnings about caustics, lost flux and assumptions; empty without any."""
        texts = [self.assumption] if self.assumption else []
        if self.caustic_share > 0:
            texts.append(
                f"Caustics: rays cross or nearly cross in {self.caustic_share:.2%} of the "
                "pixels. Once rays cross, one image no longer determines the whole field."
            )
        if self.flux_inside < 0.99:
            texts.append(f"Only {self.flux_inside:.1%} of the flux lands inside the image.")
        return " ".join(texts)


@dataclass(frozen=True, eq=False)
class ForwardJob:
    """A prediction of the image of a potential, a displacement in px, or a simulated object."""

    field: ArrayLike | PhantomRecipe
    shape: tuple[int, int] = (200, 200)  # of a simulated object's image
    to_px2: float = 1.0  # conversion factor of the potential to px²
    setup: Setup | None = None
    field_setup: Setup | None = None  # of the field's measurement
    deflector: Deflector | None = None
    source: ArrayLike | None = None  # None for a uniform beam
    caustic_jacobian: float = InversionOptions.model_fields["caustic_jacobian"].default

    def run(
        self, on_progress: OnProgress | None = None, should_stop: ShouldStop | None = None
    ) -> Prediction:
        from napari_shadowinv.physics.forward import jacobian_determinant, synthetic_image

        report = Reporter(on_progress, should_stop)
        report("field", 0, None)
        displacement, assumption = self._transfer(self._displacement())
        source, shadow = self._source(displacement.shape[1:])
        image = synthetic_image(
            displacement, source, on_progress=on_progress, should_stop=should_stop
        )
        caustic = jacobian_determinant(displacement) < self.caustic_jacobian
        if shadow is not None:
            caustic &= ~shadow
        flux = image.size if source is None else source.sum()
        flux_inside = float(image.sum() / flux) if flux else 1.0
        return Prediction(
            image, displacement, source, float(caustic.mean()), flux_inside, assumption
        )

    def _source(self, shape: tuple[int, ...]) -> tuple[FloatArray | None, BoolArray | None]:
        """Return the beam that passes the object, and where the object stops it."""
        source = None if self.source is None else plane_of(self.source, "the source")
        if not isinstance(self.field, PhantomRecipe):
            return source, None
        shadow = self.field.shadow(self.shape, self.setup)
        if shadow is None:
            return source, None
        return np.where(shadow, 0.0, np.ones(shape) if source is None else source), shadow

    def _transfer(self, displacement: FloatArray) -> tuple[FloatArray, str]:
        """Return the displacement in the chosen setup, and the assumption behind it."""
        from napari_shadowinv.physics.projection import default_deflector, transferred_displacement

        field_setup, setup = self.field_setup, self.setup
        if field_setup is None or setup is None or field_setup == setup:
            return displacement, ""
        deflector = self.deflector or default_deflector(field_setup, setup)
        shape: Any = None if self.source is None else np.shape(self.source)
        moved = transferred_displacement(
            displacement, field_setup, setup, deflector=deflector, shape=shape
        )
        return (
            moved,
            f"Converted to another setup, assuming that only a {deflector} deflects the beam.",
        )

    def _displacement(self) -> FloatArray:
        from napari_shadowinv.physics.setup import displacement_from_potential

        if isinstance(self.field, PhantomRecipe):
            return self.field.phantom(self.shape, self.setup).displacement
        if np.ndim(self.field) == 3:
            return np.asarray(self.field, dtype=np.float64)
        return displacement_from_potential(self.to_px2 * plane_of(self.field, "the potential"))
