"""A small inversion with a known potential, and its inputs."""

from __future__ import annotations

import gc
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from helpers.fit_images import without_causes
from helpers.pages import run_python, text_of
from helpers.public_data import public_file, public_names
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.facts import Assessment, Verdict
from napari_shadowinv.fitting import Basin, Fit, FitReport, FittedField
from napari_shadowinv.inversion import Cells, Inversion, Report
from napari_shadowinv.inversion.error_budget import ErrorBudget, ErrorEstimate
from napari_shadowinv.inversion.solution_checks import image_residual
from napari_shadowinv.options import FitOptions, InversionOptions
from napari_shadowinv.physics.beam import BeamSetup
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.setup import SETUPS, OpticalSetup, ProtonSetup
from napari_shadowinv.physics.significance import deviation_along

# The same examples in each run: a failure is due to a change, not to chance.
settings.register_profile("same each time", derandomize=True)
settings.load_profile("same each time")

# A shell that runs the tests in the background makes them ignore Ctrl-C, and some wait for it.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Exclude modules and collected tests, which last, from all garbage collections.

    Each collection would otherwise look through them: half of the time in which tests are found.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.enable()


LONG_FILES = ("test_tutorials.py", "test_tutorials_clicked.py", "test_examples.py", "test_pages.py")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take longest, so that no process waits for them at the end."""
    items.sort(key=lambda item: item.path.name not in LONG_FILES)


_HOOKS: list[object] = []  # an audit hook cannot be removed
_opened_paths: list[str] | None = None


def _note_opened(event: str, arguments: tuple[object, ...]) -> None:
    if event == "open" and _opened_paths is not None:
        _opened_paths.append(str(arguments[0]))


@pytest.fixture
def opened_paths() -> Iterator[list[str]]:
    """Paths of the files that this process opens during a test."""
    global _opened_paths
    if _note_opened not in _HOOKS:
        sys.addaudithook(_note_opened)
        _HOOKS.append(_note_opened)
    _opened_paths = []
    yield _opened_paths
    _opened_paths = None


@pytest.fixture(scope="session", autouse=True)
def dots_per_inch() -> int:
    """Write figures with few pixels, which take half as long; return the usual resolution."""
    from napari_shadowinv.plotting import figures

    usual = figures.DOTS_PER_INCH
    figures.DOTS_PER_INCH = 40
    return usual


@pytest.fixture
def blank_pages(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compose figures, but leave their files blank: to draw takes longer than most commands.

    Tests marked `draws_figures` draw them.
    """
    if request.node.get_closest_marker("draws_figures") is None:
        monkeypatch.setattr("matplotlib.figure.Figure.draw", lambda figure, renderer: None)


@pytest.fixture
def no_causes() -> Iterator[None]:
    """Seek no causes of a misfit, which takes longer than the fit."""
    with without_causes():
        yield


def invert_exactly(shape: tuple[int, int], **report: object) -> Inversion:
    """Inversion of an off-centre blob, as if it had been solved exactly."""
    height, width = shape
    blob = gaussian_blob(shape, 12.0, 0.15 * min(shape), (0.4 * height, 0.6 * width))
    source = np.full(shape, 3.0)
    reprojection = synthetic_image(blob.displacement, source)
    image = reprojection + np.random.default_rng(1).normal(0, 0.05, shape)
    sites = np.random.default_rng(2).uniform(0, min(shape), (17, 2))
    caustic = np.zeros(shape, dtype=bool)
    caustic[height // 3 : height // 3 + 6, width // 3 : width // 3 + 7] = True
    facts = {
        "converged": True,
        "iterations": 31,
        "residual": 1 / 3000,
        "tolerance": 1e-3,
        "n_sites": 17,
        "floor": 1e-3,
        "floored_pixels": 2,
        "clipped_pixels": 1,
        "levels": ((4, 10, 0.1), (17, 21, 1 / 3000)),
        "seconds": {"prepare": 0.1, "sites": 0.2, "transport": 1.0, "read-out": 0.1},
        "cautions": (Caution("negative-pixels", "1 negative pixel was set to zero"),),
        "flux_scale": 1.0,
        "flux_left": {},
        "flux_entered": {},
        "sites_reason": "as requested",
        "image_residual": image_residual(image, reprojection, np.ones(shape, dtype=bool)),
    }
    errors = ErrorBudget(
        peak=float(np.hypot(*blob.displacement).max()),
        rms=float(np.sqrt((blob.displacement**2).sum(axis=0).mean())),
        discretisation=ErrorEstimate(0.01, 0.02),
        noise=ErrorEstimate(0.1, 0.05),
        effects={"solver": ErrorEstimate(1e-5, 2e-5)},
        edge=ErrorEstimate(0.05, 0.01),
        sides=("left",),
        beam=ErrorEstimate(2.0, 1.0),
        beam_sensitivity=ErrorEstimate(0.4, 0.2),
        sensitivities={"blur, 1 px": ErrorEstimate(0.02, 0.03)},
        sizes={},
        beam_variation=0.05,
        beam_scale=0.25,
        beam_basis="assumed",
        noise_correlation=0.0,
    )
    return Inversion(
        image=image,
        source=source,
        potential=blob.potential,
        displacement=blob.displacement,
        cells=Cells(
            sites=sites,
            weights=np.linspace(-1, 1, 17),
            mass=np.full(17, source.sum() / 17),
            flux=source.sum() / 17 * (1 + np.linspace(-1, 1, 17) / 3000),
            displacement=sites / 7,
        ),
        reprojection=reprojection,
        residual=image - reprojection,
        caustic=caustic,
        mask=np.ones(shape, dtype=bool),
        report=Report(**{**facts, **report}),  # type: ignore[arg-type]
        options=InversionOptions(n_sites=17, tolerance=1e-3, seed=5, negative="clip"),
        errors=errors,
    )


def errors_by_noise(displacement: FloatArray, std: FloatArray) -> ErrorBudget:
    """The budget of a fitted field with an error of 2 % in all, and these in each pixel."""
    length = np.hypot(*displacement)
    row, column = np.unravel_index(length.argmax(), length.shape)
    rms = float(np.sqrt((length**2).mean()))
    at_peak = deviation_along(displacement[:, row, column], std[:, row, column])
    noise = ErrorEstimate(0.02 * rms, float(at_peak))
    return ErrorBudget(float(length.max()), rms, noise, {}, per_pixel=std, causes=("noise",))


def fit_exactly(
    shape: tuple[int, int] = (48, 64),
    names: tuple[str, ...] = ("B",),
    strengths: tuple[float, ...] = (1.0, 1.7),
    **changes: object,
) -> Fit:
    """Fit of images of a blob, as if it had been found exactly."""
    rng = np.random.default_rng(3)
    height, width = shape
    count = len(strengths)
    blob = gaussian_blob(shape, 12.0, 0.15 * min(shape), (0.4 * height, 0.6 * width))
    matrix = np.array([[strength ** (m + 1) for m in range(len(names))] for strength in strengths])
    moved = [row.sum() * blob.displacement for row in matrix]
    images = np.stack([3 * synthetic_image(displacement) for displacement in moved])
    residual = rng.normal(0, 0.05, images.shape)
    mask = np.ones(images.shape, bool)
    mask[0, :4, :6] = False
    residual[~mask] = 0
    keywords = {
        "images": images + residual,
        "mask": mask,
        "strengths": matrix,
        "fields": tuple(
            FittedField(
                name,
                blob.potential,
                blob.displacement,
                errors_by_noise(blob.displacement, rng.uniform(0.01, 0.03, (2, *shape))),
                (1 / 3, 2.0),
            )
            for name in names
        ),
        "source": np.full(images.shape, 3.0),
        "brightness": np.linspace(1, 1.1, count),
        "frames": rng.normal(0, 0.1, (count, 6)),
        "reprojection": images,
        "residual": residual,
        "chi2": np.array(
            [(plane[use] ** 2).mean() for plane, use in zip(residual, mask, strict=True)]
        )
        / 0.05**2,
        "noise": np.full(count, 0.05),
        "basins": tuple(
            Basin(start, value, 1.01, away, rng.normal(size=(len(names), 2, 24, 32)))
            for start, value, away in (("from far", 100 / 3, 0.0), ("from near", 40.0, 0.3))
        ),
        "folded": 0.1,
        "assessment": Assessment(
            Verdict.DETERMINED, "all starts lead to one field, which explains 2 images to the noise"
        ),
        "report": FitReport(100 / 3, 12, True, {"starts": 0.5, "full size": 1.5}),
        "options": FitOptions(align="shift", threads=2),
    }
    return Fit(**{**keywords, **changes})  # type: ignore[arg-type]


@pytest.fixture(scope="session")
def make_fit() -> Callable[..., Fit]:
    return fit_exactly


@pytest.fixture(scope="session")
def inversion() -> Inversion:
    return invert_exactly((24, 32))


@pytest.fixture(scope="session")
def make_inversion() -> Callable[..., Inversion]:
    return invert_exactly


@pytest.fixture(scope="session")
def proton_setup() -> ProtonSetup:
    return ProtonSetup(
        energy=14.7,
        source_object_distance=1.3e-3,
        object_image_distance=2e-2,
        pixel_size=1.5e-6,
    )


@pytest.fixture(scope="session")
def optical_setup() -> OpticalSetup:
    return OpticalSetup(wavelength=532e-9, object_image_distance=0.3, pixel_size=12e-6)


@pytest.fixture
def usual_ctrl_c() -> Iterator[None]:
    """Restore the usual Ctrl-C, which other packages or the shell may have changed."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[tuple[Path, Callable[[str], bool]]]:
    """A folder on a disk of 400 kB, and a function that changes the size of the disk."""
    folder = tmp_path / "disk"
    folder.mkdir()

    def mount(option: str) -> bool:
        command = ["mount", "-t", "tmpfs", "-o", option, "tmpfs", str(folder)]
        return subprocess.run(command, capture_output=True).returncode == 0

    if os.name != "posix" or not shutil.which("mount") or not mount("size=400k"):
        pytest.skip("no file system can be mounted here")
    try:
        yield folder, lambda size: mount(f"remount,size={size}")
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.fixture(scope="session")
def burner() -> list[Path]:
    """Reference beam and frames of a real plume, next to the project or downloaded."""
    return [public_file(name) for name in public_names("burner")]


@pytest.fixture
def xray_setup(monkeypatch: pytest.MonkeyPatch) -> type[BeamSetup]:
    """The kind of setup of CONTRIBUTING.md, added to those of the package."""
    text = text_of("CONTRIBUTING.md").partition("### a kind of setup")[2].partition("\n### ")[0]
    kind: type[BeamSetup] = run_python(text)["XRaySetup"]
    monkeypatch.setitem(SETUPS, "x-ray", kind)
    return kind
