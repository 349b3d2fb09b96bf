"""Objects of a planned experiment: `PlannedObject`.

- a phantom, by its model: `object_of_phantom`; by a text: `phantom_of_text`; the size of an image
  by a text: `shape_of_text`; setups at several energies: `setups_of_text`
- a 3-D field, through which particles are traced: `object_of_field`
- a field that was retrieved or computed before: `object_of_result`, `object_of_displacement`

An object supplies the displacement of rays in any setup.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates, spline_filter

from napari_shadowinv._system.validation import suggestion, validate
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.arrays import complete_block_means
from napari_shadowinv.physics.beam import numbers_in_unit
from napari_shadowinv.physics.field_grid import FieldGrid
from napari_shadowinv.physics.forward import checked_displacement, synthetic_image
from napari_shadowinv.physics.particle_flight import check_particles
from napari_shadowinv.physics.phantom_models import PHANTOMS, PhantomRecipe
from napari_shadowinv.physics.projection import default_deflector, displacement_ratio
from napari_shadowinv.physics.setup import SETUPS, Setup, deflector_titles
from napari_shadowinv.physics.tracing import traced_displacement
from napari_shadowinv.results import unpack_result

FINER = 3  # samples of a phantom, and of a simulated image, along a side of a pixel
_TILES = 9  # of rays, in each sample of a grid


class Grid(NamedTuple):
    """Samples over an image of (height, width) px and beyond: `factor` along a side of a pixel."""

    shape: tuple[int, int]
    factor: int = 1
    margin: int = 0  # px beyond each edge

    @property
    def sizes(self) -> tuple[int, int]:
        """Number of samples along y and x."""
        height, width = (self.factor * (side + 2 * self.margin) for side in self.shape)
        return height, width

    def lines(self) -> tuple[FloatArray, FloatArray]:
        """Return the places of the samples along y and x, px."""
        rows, columns = (
            (np.arange(size) + 0.5) / self.factor - 0.5 - self.margin for size in self.sizes
        )
        return rows, columns

    def places(self) -> FloatArray:
        """Return the places (y, x) of all samples, (2, h, w), px."""
        return np.stack(np.meshgrid(*self.lines(), indexing="ij"))

    def in_pixels(self, values: FloatArray) -> FloatArray:
        """Return means over the pixels, (H + 2 margin, W + 2 margin), of sampled values."""
        return complete_block_means(values, self.factor)

    def inner(self, pixels: FloatArray) -> FloatArray:
        """Return the pixels of the image, without the margin."""
        inside = (slice(self.margin, self.margin + side) for side in self.shape)
        return pixels[tuple(inside)]


@dataclass(frozen=True, eq=False)
class PlannedObject:
    """A thin object, by the displacement of rays in one setup."""

    is_thin: ClassVar[bool] = True

    samples: FloatArray  # (2, h, w), displacement in px of `setup`, about the image's middle
    title: str = "a displacement"  # in texts
    setup: Setup | None = None  # without one, the object can be planned in pixels only
    deflector: str | None = None  # title of the cause. Default: see `default_deflector`
    finer: int = 1  # samples along a side of a pixel
    shadow: BoolArray | None = None  # (h, w), where the object stops the beam
    source: FloatArray | None = None  # (h, w), the beam in which it was seen, if it is known

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in px of the setup."""
        height, width = (size // self.finer for size in self.samples.shape[1:])
        return height, width

    def cause(self, setup: Setup | None) -> str | None:
        """Return the title of the cause of the deflection in a setup; None without setups."""
        if self.setup is None or setup is None:
            return self.deflector
        return self.deflector or default_deflector(self.setup, setup)

    def displacement(self, setup: Setup | None, grid: Grid) -> FloatArray:
        """Return the displacement in px of a setup at the samples of a grid, (2, h, w).

        Beyond the samples the nearest one is used. An `InputError` if the deflector does not act on
        the beam, or only one experiment is described.
        """
        factor = 1.0
        if setup is not None and self.setup is not None:
            factor = displacement_ratio(self.setup, setup, deflector=self.deflector)
        elif setup is not None:
            raise InputError(
                f"the object is {self.title} in px without a setup, but the experiment has one: "
                "give the setup of the displacement, or none at all"
            )
        places = self._places(grid, setup)
        values = [
            map_coordinates(
                spline_filter(part, mode="nearest"), places, mode="nearest", prefilter=False
            )
            for part in self.samples
        ]
        return factor * np.stack(values)

    def transmission(self, setup: Setup | None, grid: Grid) -> FloatArray | None:
        """Return the share of the beam that passes at each sample; None for a transparent one."""
        if self.shadow is None:
            return None
        shadow = self.shadow.astype(np.float64)
        places = self._places(grid, setup)
        return 1 - np.asarray(map_coordinates(shadow, places, order=0, mode="nearest"))

    def image(self, beam: FloatArray, displacement: FloatArray, grid: Grid) -> FloatArray:
        """Return the image, (H + 2 margin, W + 2 margin), of a beam that displaced rays carry.

        Beam, (h, w), and displacement, (2, h, w) in px, are those at the samples of the grid.
        """
        fine = synthetic_image(grid.factor * displacement, beam, rays_per_pixel=_TILES, threads=1)
        return grid.in_pixels(fine)

    def _places(self, grid: Grid, setup: Setup | None) -> FloatArray:
        """Indices into the samples, (2, h, w), of the places of a grid in px of a setup."""
        ratio, lines = 1.0, []
        if setup is not None and self.setup is not None:
            ratio = setup.object_pixel_size / self.setup.object_pixel_size
        for line, side, size in zip(grid.lines(), grid.shape, self.samples.shape[1:], strict=True):
            from_middle = (line - (side - 1) / 2) * ratio * self.finer
            lines.append(from_middle + (size - 1) / 2)
        return np.stack(np.meshgrid(*lines, indexing="ij"))


@dataclass(frozen=True, eq=False, kw_only=True)
class TracedObject(PlannedObject):
    """A 3-D field, through which particles are traced in every setup; it may be thick."""

    is_thin: ClassVar[bool] = False

    field: FieldGrid  # E and B around the object

    def displacement(self, setup: Setup | None, grid: Grid) -> FloatArray:
        """Trace particles; an `InputError` if the setup has none, or one misses the detector."""
        particles = check_particles(setup)
        finer = check_particles(finer_setup(particles, grid.factor))
        return traced_displacement(self.field, finer, grid.sizes) / grid.factor


def object_of_field(
    field: FieldGrid, setup: Setup | None, *, title: str = "a 3-D field"
) -> TracedObject:
    """Return an object through which particles are traced, as a field in the experiment's frame.

    A fit of several energies has the displacement of its first image: differences between the
    energies, because the object is thick or E and B act together, are in the error. The setup is
    that of the first image; pixels of this size cover the grid if no other shape is chosen. An
    `InputError` if it is none of particles, or as of `traced_displacement`.
    """
    checked = check_particles(setup)
    sides = [(last - first) / checked.object_pixel_size for first, last in field.extent[1:]]
    height, width = (max(int(side), 1) for side in sides)
    return TracedObject(
        traced_displacement(field, checked, (height, width)),
        title=title,
        setup=checked,
        deflector="magnetic field" if field.peak("magnetic") else "electric field",
        field=field,
    )


def object_of_phantom(
    recipe: PhantomRecipe, setup: Setup | None, shape: tuple[int, int]
) -> PlannedObject:
    """Return a simulated object; an `InputError` if the phantom needs another setup.

    Its parameters belong to the setup, or without one to pixels or shares of the image, (H, W).
    """
    fine_shape = FINER * shape[0], FINER * shape[1]
    fine_setup = None if setup is None else finer_setup(setup, FINER)
    fine = recipe.in_finer_pixels(FINER)
    shadow = fine.shadow(fine_shape, fine_setup)
    return PlannedObject(
        fine.phantom(fine_shape, fine_setup).displacement / FINER,
        title=recipe.title,
        setup=setup,
        deflector=SETUPS[recipe.probe].deflectors[0].title if recipe.probe else None,
        finer=FINER,
        shadow=shadow,
    )


def phantom_of_text(text: str) -> PhantomRecipe:
    """Return a phantom by its name and parameters, such as "toroid:peak=60,radius=3e-5".

    An `InputError` if the name or a parameter is unknown, or a value is no number.
    """
    name, _, parameters = text.partition(":")
    key = name.strip().lower().replace("-", "_")
    if key not in PHANTOMS:
        raise InputError(
            f"the object is '{name}', which is neither a file nor a phantom: "
            f"{suggestion(key, PHANTOMS)}"
        )
    values = {}
    for part in filter(None, parameters.split(",")):
        parameter, _, number = part.partition("=")
        try:
            values[parameter.strip()] = float(number)
        except ValueError:
            raise InputError(
                f"the object has the parameter '{part}': expected a name and a number, such as "
                "peak=60"
            ) from None
    return validate(PHANTOMS[key], values, f"the object {key}")


def shape_of_text(text: str, name: str) -> tuple[int, int]:
    """Return height and width from a text such as "200x200"; `name` is its subject."""
    parts = text.lower().replace("×", "x").split("x")
    if len(parts) != 2 or not all(part.strip().isdecimal() for part in parts):
        raise InputError(f"{name} is '{text}': expected height and width in px, such as 200x200")
    return int(parts[0]), int(parts[1])


def setups_of_text(setup: Setup | None, text: str, name: str) -> list[Setup] | None:
    """Return a setup at the energies or wavelengths of a text, or alone without any."""
    if not text.strip():
        return None if setup is None else [setup]
    if setup is None:
        raise InputError(f"{name} is '{text}': it needs a setup, the geometry of all images")
    quantity = setup.beam_quantity()
    values = numbers_in_unit(text, quantity.unit, name)
    changes = [{**setup.model_dump(), quantity.name: value} for value in values]
    return [validate(type(setup), each, name) for each in changes]


def finer_setup(setup: Setup, factor: int) -> Setup:
    """Return a setup with pixels that are smaller by a factor."""
    size = setup.object_pixel_size / factor
    return setup.model_copy(update={"pixel_size": size, "detector_pixel_size": None})


def object_of_displacement(
    displacement: ArrayLike,
    setup: Setup | None = None,
    *,
    deflector: str | None = None,
    title: str = "a displacement",
    source: FloatArray | None = None,
) -> PlannedObject:
    """Return an object with a displacement, (2, H, W) in px of a setup.

    The deflector is the title of the cause of the deflection, the source its beam, (H, W). An
    `InputError` if the shape is another or a value is not finite.
    """
    samples = checked_displacement(displacement)
    if not np.isfinite(samples).all():
        raise InputError(
            "the displacement of the object has values that are not finite: expected numbers in px"
        )
    return PlannedObject(samples, title=title, setup=setup, deflector=deflector, source=source)


def object_of_result(result: Any) -> PlannedObject:
    """Return the object that an inversion, a fit, or a field, also as a dataset, has shown.

    An `InputError` if it has no field or several, or is not of one shot.
    """
    content = unpack_result(result)
    fields: tuple[Any, ...] = getattr(content, "fields", (content,))
    if len(fields) > 1:
        names = " and ".join(field.name for field in fields)
        raise InputError(
            f"the result has the fields {names}: expected one; in Python, object_of_displacement "
            "takes the displacement of one of them"
        )
    (field,) = fields
    displacement = getattr(field, "displacement", None)
    if displacement is None:
        raise InputError(f"got a {content.kind.noun}, expected a result with a field")
    cause = deflector_titles().get(getattr(field, "name", ""))
    source = getattr(content, "source", None)
    return object_of_displacement(
        displacement,
        content.setup,
        deflector=cause,
        title="an earlier result",
        source=None if source is None else source.reshape(-1, *source.shape[-2:])[0],
    )
