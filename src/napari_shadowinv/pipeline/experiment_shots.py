"""Simulated shots of a planned experiment: `ShotSimulator`, which draws `SimulatedShots`.

- the object and the stated quality of the experiment: `ExperimentInputs`

The chain from the beam to the counts has its own imperfections, drawn from the stated instrument.
Of the models by which inversions and fits judge them it has only how places move, the exponent, and
smooth fields.
Rays start at nine samples a pixel, and each sample is cut into nine tiles; light that enters from
beyond the edge is in it.

Order: beam, transmission of the object, displacement, misalignment, blur, response, background,
Poisson noise. Each imperfection has random numbers of its own, so that the others stay the same if
one is changed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting.shots import point_spread
from napari_shadowinv.instrument.effects import Gamma, motion
from napari_shadowinv.instrument.shapes import Shapes
from napari_shadowinv.options import BeamPrior, Instrument
from napari_shadowinv.physics.projection import displacement_ratio
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.pipeline.experiment_object import FINER, Grid, PlannedObject
from napari_shadowinv.pipeline.experiment_options import ExperimentOptions

_BEYOND_PX = 4  # more than rays are displaced
_DIMMEST = 0.02  # of the mean, for a beam or a transmission
_EDGE = 0.1  # of the largest displacement, where the object ends
_STEEPNESS = 2.0

# Streams of random numbers.
_STREAMS = (
    *("energy", "structure", "beam", "between", "absorption", "other_field"),
    *("alignment", "registration", "blur", "gamma", "background", "counts", "reference"),
)


@dataclass(frozen=True)
class ExperimentInputs:
    """Checked inputs of a plan; a setup of None stands for one image in pixels."""

    object: PlannedObject
    setups: tuple[Setup | None, ...]
    shape: tuple[int, int]
    instrument: Instrument
    options: ExperimentOptions

    @property
    def is_fit(self) -> bool:
        """Whether the images are fitted, not inverted."""
        if self.options.method == "automatic":
            return len(self.setups) > 1
        return self.options.method == "fit"

    @property
    def beam(self) -> BeamPrior:
        """Expected difference of beam and reference, or of the beam and a uniform one."""
        return self.instrument.beam_of(measured=self.options.is_recorded)

    @property
    def fitted_instrument(self) -> Instrument:
        """The instrument with the beam that is assumed, which a fit takes as exact otherwise."""
        if self.instrument.beam_rms is not None or self.options.is_recorded:
            return self.instrument
        return Instrument(**{**self.instrument.stated, "beam_rms": self.beam.rms})

    @property
    def psf(self) -> tuple[float, ...]:
        """Known point spread of each image, px."""
        options = self.options
        if options.psf is not None or self.setups == (None,):
            return (options.psf or 0.0,) * len(self.setups)
        lengths = options.source_size or 0.0, options.resolution or 0.0
        return tuple(point_spread(setup, *lengths) for setup in self.setups if setup is not None)


@dataclass(frozen=True, eq=False)
class SimulatedShots:
    """Images of one object in one draw of the imperfections."""

    images: FloatArray  # (L, H, W), counts
    source: FloatArray | None  # (H, W), recorded or open beam, counts of an image; None: even
    source_noise: float  # variance of the reference over its counts


class ShotSimulator:
    """Draws shots of an object, with the stated quality of the experiment."""

    def __init__(self, inputs: ExperimentInputs) -> None:
        self.inputs = inputs
        self._object, self._setups, self._beam = inputs.object, inputs.setups, inputs.beam
        self._shapes: dict[float, Shapes] = {}  # by their length, px
        shape = inputs.shape
        coarse = [self._object.displacement(setup, Grid(shape)) for setup in self._setups]
        reach = max(float(np.abs(moved).max()) for moved in coarse)
        margin = min(math.ceil(reach) + _BEYOND_PX, max(shape) // 2)
        self._grid = Grid(shape, FINER, margin)
        self._nominal = [self._object.displacement(setup, self._grid) for setup in self._setups]
        self.truth = coarse[0]
        # Of all images about the displacement in the first, over that of the first.
        squares = [float((moved**2).sum()) for moved in coarse]
        self.information = sum(squares) / max(squares[0], 1e-300)
        passed = self._object.transmission(self._setups[0], self._grid)
        self._open_share = np.ones(self._grid.sizes) if passed is None else passed

    def draw(self, number: int) -> SimulatedShots:
        """Return the shots of a draw; the same number gives the same shots."""
        inputs, options, grid = self.inputs, self.inputs.options, self._grid
        instrument, beam = inputs.instrument, self._beam
        streams = {
            name: np.random.default_rng([options.seed, number, stream])
            for stream, name in enumerate(_STREAMS)
        }
        energy = max(1 + instrument.energy * streams["energy"].normal(), _DIMMEST)
        structure = 1 + self._wave(streams["structure"], options.beam_structure)
        common = structure * (1 + self._wave(streams["beam"], beam.rms))
        common = common * (1 + self._absorption(streams["absorption"]))
        admixture = instrument.other_field * streams["other_field"].normal()
        width = instrument.blur * abs(streams["blur"].normal())
        exponent = Gamma.exponent(instrument.gamma * streams["gamma"].normal())

        def counts(flux: FloatArray, image: int, mean: float, noise: str) -> FloatArray:
            flux = gaussian_filter(flux, math.hypot(inputs.psf[image], width), mode="nearest")
            level = instrument.background * streams["background"].normal()
            recorded = np.maximum(grid.inner(flux), 0) ** exponent + level
            return streams[noise].poisson(mean * np.maximum(recorded, 0)).astype(np.float64)

        images = []
        for image, setup in enumerate(self._setups):
            light = common * (1 + self._wave(streams["between"], beam.between if image else 0.0))
            light = np.maximum(light, _DIMMEST) * self._open_share
            scale = self._energy_factor(setup, energy) + admixture * self._other_ratio(setup)
            displacement = self._nominal[image] * scale
            if image and (shift := instrument.registration):  # onto a misaligned detector
                landing = displacement + grid.places()
                numbers = shift * streams["alignment"].normal(size=4)
                displacement = displacement + motion(landing, inputs.shape, numbers)
            flux = self._object.image(light, displacement, grid)
            images.append(counts(flux, image, options.counts, "counts"))
        source, noise = None, 0.0
        if options.is_recorded:
            reference = self._moved(structure * self._open_share, streams["registration"])
            level = options.reference_counts or options.counts
            counted = counts(reference, 0, level, "reference")
            source, noise = options.counts * (counted / level), options.counts * (1 / level)
        elif self._object.shadow is not None:
            source = options.counts * grid.inner(grid.in_pixels(self._open_share))
        return SimulatedShots(np.stack(images), source, noise)

    def _energy_factor(self, setup: Setup | None, energy: float) -> float:
        """Displacement at `energy` times the stated energy, over the stated displacement."""
        if setup is None:
            return 1.0
        true = setup.model_copy(update={setup.beam_field: energy * setup.beam_value})
        return displacement_ratio(setup, true, deflector=self._object.cause(setup))

    def _other_ratio(self, setup: Setup | None) -> float:
        """Displacement by the other field over that by the object's, relative to image 1."""
        first = self._setups[0]
        if setup is None or first is None or self._object.cause(first) != "magnetic field":
            return 1.0
        electric, magnetic = (
            displacement_ratio(first, setup, deflector=cause)
            for cause in ("electric field", "magnetic field")
        )
        return electric / magnetic

    def _wave(
        self, rng: np.random.Generator, rms: float, length: float | None = None
    ) -> FloatArray:
        """Smooth noise at the samples, with a mean of 0 over the image and an expected r.m.s."""
        grid = self._grid
        if not rms:
            return np.zeros(grid.sizes)
        if length is None:
            length = self._beam.length * min(grid.shape)
        if length not in self._shapes:
            edge = grid.margin * grid.factor
            image = np.pad(np.ones([grid.factor * side for side in grid.shape]), edge)
            self._shapes[length] = Shapes.of_length("beam", grid.factor * length, image)
        shapes = self._shapes[length]
        return rms * shapes.sum(rng.normal(size=len(shapes)))

    def _absorption(self, rng: np.random.Generator) -> FloatArray:
        """Smooth noise of the object's size inside the object."""
        rms = self.inputs.instrument.absorption
        if not rms:
            return np.zeros(self._grid.sizes)
        size = np.hypot(*self._nominal[0])
        depth = size / max(float(size.max()), 1e-12)
        steep = _STEEPNESS * (np.log(np.maximum(depth, 1e-9)) - math.log(_EDGE))
        inside = self._grid.inner(self._grid.in_pixels(depth)) > _EDGE
        radius = math.sqrt(inside.sum() / np.pi)
        return np.asarray(self._wave(rng, rms, max(radius, 1.0)) / (1 + np.exp(-steep)))

    def _moved(self, reference: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Reference in pixels, out of register with the image."""
        shift, places = self.inputs.instrument.registration, self._grid.places()
        if not shift:
            return self._grid.in_pixels(reference)
        moved = places + motion(places, self._grid.shape, shift * rng.normal(size=4))
        indices = (moved + 0.5 + self._grid.margin) * self._grid.factor - 0.5
        shifted = map_coordinates(reference, indices, order=3, mode="nearest")
        return self._grid.in_pixels(np.maximum(shifted, 0))
