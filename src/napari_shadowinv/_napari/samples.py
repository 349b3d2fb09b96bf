"""Sample data: simulated and downloaded shots with setup and source."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from napari_shadowinv import io
from napari_shadowinv._napari.layers import LayerData
from napari_shadowinv._napari.shots import layers_of_shot, lazy_stack
from napari_shadowinv._napari.viewer_sync import notify_errors
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.io.public_images import fetch_burner
from napari_shadowinv.physics import phantoms
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup, setup_from_dict
from napari_shadowinv.shot import Shot

_SHAPE = (200, 200)
_COUNTS = 400.0  # per pixel: 5 % noise

_FILM_SHAPE = (96, 96)
_FILMS = {14.7: 400.0, 3.0: 300.0}  # protons per pixel at each energy in MeV

_RUN_SHAPE = (160, 320)
_RUN_LENGTH = 20


def toroid() -> LayerData:
    """Toroidal field of 97 MG µm, too weak for caustics, under a uniform beam."""
    return _proton_shot("toroid", _toroid_of(97.0))


def toroid_with_caustics() -> LayerData:
    """Toroidal field of 194 MG µm, at which caustics form, under a uniform beam."""
    return _proton_shot("toroid with caustics", _toroid_of(194.0))


def four_toroids() -> LayerData:
    """Four toroids under an uneven beam, which differs by 0.5 % (r.m.s.) from its reference."""
    phantom = phantoms.four_toroids(_SHAPE, ProtonSetup.example(), 0.8)
    y, x = _coordinates()
    beam = 1 + 0.3 * np.sin(2.3 * x + 0.4) * np.cos(1.7 * y - 0.3) + 0.15 * x
    change = 1 + 0.01 * np.sin(5.1 * x + 1.0) * np.cos(4.3 * y + 0.6)
    return _proton_shot("four toroids", phantom, beam, beam * change)


def coaxial_line() -> LayerData:
    """Field between two conductors that stop the beam; the source holds their shadow."""
    phantom, obstructed = phantoms.coaxial_line(_SHAPE, ProtonSetup.example())
    return _proton_shot("coaxial line", phantom, np.where(obstructed, 0.0, 1.0))


def two_energies() -> LayerData:
    """Two opposite toroidal fields at 14.7 and 3 MeV; the beam varies by 10 % and has no image."""
    lengths = {"source_object_distance": 0.01, "object_image_distance": 0.28, "pixel_size": 5e-6}
    films = [{"kind": "proton", "energy": energy, **lengths} for energy in _FILMS]
    setups: list[Any] = [setup_from_dict(film, "the sample") for film in films]
    first = setups[0]
    truth = (
        phantoms.toroid(_FILM_SHAPE, first, 30.0, 48e-6, center=(43, 38)).displacement
        + phantoms.toroid(_FILM_SHAPE, first, -20.0, 34e-6, center=(59, 67)).displacement
    )
    y, x = _coordinates(_FILM_SHAPE)
    beam = np.exp(0.14 * np.sin(1.9 * x + 0.4) * np.cos(1.4 * y - 0.5) + 0.06 * x)
    layers = []
    for seed, (setup, level) in enumerate(zip(setups, _FILMS.values(), strict=True)):
        # Fields displace in inverse proportion to the momentum.
        image = _counts_image(truth * first.momentum / setup.momentum, level * beam, seed)
        layers += layers_of_shot(Shot(image, setup=setup), f"{setup.energy:g} MeV")
    return layers


def wakefield_run() -> LayerData:
    """Twenty optical shots of a plasma wave that moves, grows and fades, computed when shown."""
    stack = lazy_stack(_wakefield_shot, range(_RUN_LENGTH), _RUN_SHAPE)
    shots = Shot(stack, setup=OpticalSetup.example(), source=_wakefield_beam())
    return layers_of_shot(shots, "wakefield run")


# For an image without channels napari adds no layer; it refuses an empty list.
@notify_errors(otherwise=lambda: [(np.empty((0, 1, 1)), {"channel_axis": 0}, "image")])
def burner() -> LayerData:
    """Shadowgram of an alcohol burner's plume with its reference beam, downloaded once."""
    reference, frame = (io.read_shot(path) for path in fetch_burner())
    return layers_of_shot(replace(frame, source=reference.image), "burner")


def _toroid_of(peak: float) -> phantoms.Phantom:
    return phantoms.toroid(_SHAPE, ProtonSetup.example(), peak, 30e-6)


def _proton_shot(
    name: str,
    phantom: phantoms.Phantom,
    beam: FloatArray | float = 1.0,
    reference: FloatArray | None = None,
) -> LayerData:
    light = _COUNTS * beam * np.ones(_SHAPE)
    source = light if reference is None else _COUNTS * reference
    image = _counts_image(phantom.displacement, light, seed=1)
    # Pixels that no ray can reach, behind an obstacle, are dark in both.
    lit = (light > 0) | (synthetic_image(phantom.displacement, light) > 0)
    mask = None if lit.all() else lit
    shot = Shot(image, setup=ProtonSetup.example(), source=source, mask=mask)
    return layers_of_shot(shot, name)


def _counts_image(displacement: FloatArray, source: FloatArray, seed: int) -> FloatArray:
    """Return the image of a source through an object with counting noise."""
    expected = synthetic_image(displacement, source)
    return np.random.default_rng(seed).poisson(expected).astype(np.float64)


def _coordinates(shape: tuple[int, int] = _SHAPE) -> tuple[AnyArray, AnyArray]:
    """Return coordinates from -1 to 1 on both axes."""
    y, x = (np.linspace(-1, 1, side) for side in shape)
    return y[:, None], x[None, :]


def _wakefield_shot(shot: int) -> FloatArray:
    """Return a shot: the wave enters from the left, is strongest at the centre, and decays."""
    phase = shot / (_RUN_LENGTH - 1)
    height, width = _RUN_SHAPE
    wave = phantoms.wakefield(
        _RUN_SHAPE,
        OpticalSetup.example(),
        0.8 * np.sin(np.pi * (0.15 + 0.75 * phase)) ** 2,
        center=((height - 1) / 2, width * (0.2 + 0.6 * phase)),
    )
    return _counts_image(wave.displacement, _wakefield_beam(), seed=shot)


def _wakefield_beam() -> FloatArray:
    return np.full(_RUN_SHAPE, 2500.0)
