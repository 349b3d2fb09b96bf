"""Choices of a traced image, apart from its field and its setup.

- beam, output and accuracy: `TraceOptions`
- the direction from which a grid is seen: `GridView`; with the size of the image: `SizedView`

The command takes their keys, so this module does not import numba.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from napari_shadowinv._system.validation import CheckedModel, Seed, Threads
from napari_shadowinv.physics.beam import number_field
from napari_shadowinv.physics.field_grid import FieldGrid

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


class TraceOptions(CheckedModel):
    """Choices of `trace`."""

    output: Literal["fluence", "counts"] = Field(
        default="fluence",
        description="fluence: the exact image of regular rays, without noise; counts: particles "
        "drawn at random, with their counting statistics.",
    )
    rays_per_pixel: int = Field(
        default=4,
        ge=1,
        le=256,
        description="Rays traced per pixel for a fluence; the next square number is used. Between "
        "the rays the displacement is interpolated by cubic splines.",
    )
    counts: float = number_field(
        "Counts per pixel",
        "Mean number of particles per pixel of the image without the object.",
        100.0,
        gt=0,
        le=1e6,
    )
    source_size: float = number_field(
        "Source size (m)",
        "Standard deviation of the Gaussian source in m (FWHM / 2.355); for counts.",
        0.0,
        ge=0,
        le=1.0,
    )
    energy_spread: float = number_field(
        "Energy spread (MeV)",
        "Standard deviation of the kinetic energy in MeV; for counts.",
        0.0,
        ge=0,
    )
    step: float = Field(
        default=0.5,
        gt=0,
        le=1,
        title="Step (cells)",
        description="Longest step of a particle, in units of the smallest spacing of the grid.",
    )
    max_turn: float = Field(
        default=0.05,
        gt=0,
        le=0.5,
        title="Turn per step (rad)",
        description="Largest change of direction in a step, in the strongest field of the grid.",
    )
    keep_particles: bool = Field(
        default=False,
        description="Also return start, landing point and deflection of each particle; for counts.",
    )
    seed: Seed = 0
    threads: Threads = None


class GridView(CheckedModel):
    """Direction from which a grid is seen."""

    beam: Axis = Field(
        default="z",
        title="Beam along",
        description="Axis of the grid along which the beam travels.",
    )
    right: Axis = Field(
        default="x",
        title="Right along",
        description="Axis of the grid that points to the right in the image.",
    )
    centre: bool = Field(
        default=False,
        title="Centre the grid",
        description="Put the middle of the grid on the middle of the object plane.",
    )

    def apply(self, grid: FieldGrid) -> FieldGrid:
        """Return a grid in the frame of the beam."""
        turned = grid.turned(self.beam, self.right)
        return turned.centred() if self.centre else turned


def _side(name: str) -> Any:
    description = f"{name} of the traced image in px."
    return Field(default=200, ge=4, le=20_000, title=f"{name} (px)", description=description)


class SizedView(GridView):
    """Direction from which a grid is seen, and the size of its image."""

    height: int = _side("Height")
    width: int = _side("Width")
