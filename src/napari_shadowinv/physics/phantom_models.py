"""Simulated objects as models, for forms, flags and files: `PHANTOMS`, each a `PhantomRecipe`."""

from __future__ import annotations

from typing import Any, ClassVar, Self

from pydantic import Field

from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import BoolArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics import phantoms
from napari_shadowinv.physics.phantoms import Phantom


class PhantomRecipe(CheckedModel):
    """A simulated object with parameters of its field."""

    title: ClassVar[str]
    # Kind of setup that the object requires; empty for any setup, or none.
    probe: ClassVar[str] = ""

    def phantom(self, shape: tuple[int, int], setup: Any) -> Phantom:
        """Create the object at the centre of an image; raise an `InputError` for a wrong setup."""
        if self.probe and getattr(setup, "kind", None) != self.probe:
            raise InputError(_SETUP_HINTS[self.probe])
        return self._build(shape, setup)

    def shadow(self, shape: tuple[int, int], setup: Any) -> BoolArray | None:
        """Return the pixels where the object stops the beam; None if it is transparent."""
        return None

    def in_finer_pixels(self, factor: int) -> Self:
        """Return the same object in pixels that are smaller by a factor."""
        return self

    def _build(self, shape: tuple[int, int], setup: Any) -> Phantom:
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
    """A magnetic field that runs around an axis along the beam."""

    title = "toroidal magnetic field"
    probe = "proton"
    peak: float = _peak(97.0, "the radius")
    radius: float = _metres(30e-6, "Radius", "Radius σ of maximum field, in the object plane.")

    def _build(self, shape: tuple[int, int], setup: Any) -> Phantom:
        return phantoms.toroid(shape, setup, self.peak, self.radius)


class FourToroidsRecipe(PhantomRecipe):
    """The paper's four toroids, which scale with the image."""

    title = "four toroids"
    probe = "proton"
    strength: float = Field(
        default=1.0,
        description="Scale factor for the fields, whose highest peak is 135 MG µm at 1; caustics "
        "form at 1.",
        json_schema_extra={"slider": [0.05, 3.0]},
    )

    def _build(self, shape: tuple[int, int], setup: Any) -> Phantom:
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

    def _build(self, shape: tuple[int, int], setup: Any) -> Phantom:
        return self._line(shape, setup)[0]

    def _line(self, shape: tuple[int, int], setup: Any) -> tuple[Phantom, BoolArray]:
        return phantoms.coaxial_line(shape, setup, self.peak, (self.inner, self.outer, self.rim))


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
        description="Radius of curvature of the wavefronts on the axis: positive if they lag "
        "behind there, negative if they lead, inf for plane wavefronts.",
    )

    def _build(self, shape: tuple[int, int], setup: Any) -> Phantom:
        return phantoms.wakefield(shape, setup, **self.model_dump())


class BlobRecipe(PhantomRecipe):
    """A Gaussian potential, in pixels."""

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

    def in_finer_pixels(self, factor: int) -> Self:
        changes = {"amplitude": factor**2 * self.amplitude, "sigma": factor * self.sigma}
        return self.model_copy(update=changes)

    def _build(self, shape: tuple[int, int], setup: Any) -> Phantom:
        return phantoms.gaussian_blob(shape, self.amplitude, self.sigma)


PHANTOMS: dict[str, type[PhantomRecipe]] = {
    "toroid": ToroidRecipe,
    "four_toroids": FourToroidsRecipe,
    "coaxial": CoaxialRecipe,
    "wakefield": WakefieldRecipe,
    "blob": BlobRecipe,
}
