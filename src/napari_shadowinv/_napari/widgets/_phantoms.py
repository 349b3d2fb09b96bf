"""Objects to put into a beam, with their parameters: what a form can show.

- what there is: `PHANTOMS`
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field

from napari_shadowinv.errors import InputError

if TYPE_CHECKING:
    from napari_shadowinv.physics.phantoms import Phantom

__all__ = ["PHANTOMS", "PhantomRecipe"]


class PhantomRecipe(BaseModel):
    """An object whose field is known."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    title: ClassVar[str]

    def phantom(self, shape: tuple[int, int], setup: Any) -> Phantom:
        """Make it in the middle of an image; see `napari_shadowinv.physics.phantoms`."""
        raise NotImplementedError


class ToroidRecipe(PhantomRecipe):
    """The paper's toroidal field."""

    title = "toroidal magnetic field"
    peak: float = Field(
        default=97.0,
        title="Peak field (MG µm)",
        description="Path-integrated field at the radius, in MG µm; negative focuses.",
    )
    radius: float = Field(
        default=30e-6,
        gt=0,
        title="Radius (m)",
        description="Radius σ at which the field is largest, in the object plane.",
    )

    def phantom(self, shape: tuple[int, int], setup: Any) -> Phantom:
        from napari_shadowinv.physics.phantoms import toroid

        return toroid(shape, _particles(setup), self.peak, self.radius)


class BlobRecipe(PhantomRecipe):
    """A Gaussian potential, in pixels."""

    title = "Gaussian potential"
    amplitude: float = Field(
        default=50.0,
        title="Amplitude (px²)",
        description="Peak of the normalised potential in px²; negative focuses.",
    )
    sigma: float = Field(
        default=20.0,
        gt=0,
        title="Width (px)",
        description="Standard deviation in px of the object plane.",
    )

    def phantom(self, shape: tuple[int, int], setup: Any) -> Phantom:
        from napari_shadowinv.physics.phantoms import gaussian_blob

        return gaussian_blob(shape, self.amplitude, self.sigma)


class FourToroidsRecipe(PhantomRecipe):
    """The paper's four toroids."""

    title = "four toroids"
    strength: float = Field(
        default=1.0,
        title="Strength",
        description="Factor on the fields, whose largest peak is 135 MG µm; caustics form at 1.",
        json_schema_extra={"slider": [0.05, 3.0]},
    )

    def phantom(self, shape: tuple[int, int], setup: Any) -> Phantom:
        from napari_shadowinv.physics.phantoms import four_toroids

        return four_toroids(shape, _particles(setup), self.strength)


def _particles(setup: Any) -> Any:
    if getattr(setup, "kind", None) != "proton":
        raise InputError(
            "a magnetic field deflects particles: choose the setup 'particles' for this object"
        )
    return setup


PHANTOMS: dict[str, type[PhantomRecipe]] = {
    "toroid": ToroidRecipe,
    "four_toroids": FourToroidsRecipe,
    "blob": BlobRecipe,
}
