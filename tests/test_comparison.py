"""The comparison of solvers: images, limits, names of failures, and the page of its results."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from compare import fields, images, page, runner
from compare.catalogue import OURS, SOLVERS, STAND_IN
from compare.runner import Limits, Worker
from napari_shadowinv import synthetic_image

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "pictures" / "comparison.json"
POISSON = "Poisson (SciPy)"
LOCAL = {solver.name: solver.module for solver in SOLVERS if solver.environment == "ours"}

# Modules of solvers that fail; the first call warms up.
FAILING = {
    "raises": "def solve(source, image):\n    raise ValueError('no light')\n",
    "dark": "def solve(source, image):\n    return np.full((2, *image.shape), np.nan)\n",
    "wild": "def solve(source, image):\n    return np.full((2, *image.shape), 1e6)\n",
    "sleeps": (
        "calls = []\n"
        "def solve(source, image):\n"
        "    calls.append(0)\n"
        "    time.sleep(60 if len(calls) > 1 else 0)\n"
    ),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("compare")
    images.write_images(place / "images", images.cases(quick=True)[:1])
    for name, code in FAILING.items():
        (place / f"{name}.py").write_text(f"import time\nimport numpy as np\nVERSION = '0'\n{code}")
    return place


def solve(module: str, folder: Path, seconds: float = 60.0) -> runner.Result:
    results: dict[str, runner.Result] = {}
    worker = Worker(sys.executable, module, Limits(seconds))
    runner.run(worker, images.cases(quick=True)[:1], results, folder, lambda: None)
    assert worker.process is None
    return results["toroid 97 32"]


def test_errors_of_solvers_are_in_order(folder: Path) -> None:
    results = {name: solve(LOCAL[name], folder) for name in (OURS, STAND_IN, POISSON)}
    errors = {name: result["error_percent"] for name, result in results.items()}
    assert 0 < errors[OURS] < 6
    assert 0 < errors[STAND_IN] < 6
    assert 30 < errors[POISSON] < 60
    assert all(result["processor_seconds"] > 0 for result in results.values())


@pytest.mark.parametrize(
    ("module", "failure"),
    [
        ("raises", "ValueError: no light"),
        ("dark", "not finite"),
        ("wild", "diverged"),
        ("absent_solver", "No module named"),
    ],
)
def test_failures_are_recorded_by_name(
    folder: Path, monkeypatch: pytest.MonkeyPatch, module: str, failure: str
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(folder))
    assert failure in solve(module, folder)["failure"]


@pytest.mark.parametrize("limit", ["time", "memory"])
def test_a_limit_ends_the_process(
    folder: Path, monkeypatch: pytest.MonkeyPatch, limit: str
) -> None:
    if limit == "memory" and not Path("/proc/self/statm").exists():
        pytest.skip("the system does not report the memory of a process")
    monkeypatch.setenv("PYTHONPATH", str(folder))
    worker = Worker(sys.executable, "sleeps", Limits(0.2 if limit == "time" else 30.0))
    assert worker._start() == ""
    assert worker.process is not None
    pid = worker.process.pid
    if limit == "memory":
        worker.limits = Limits(30.0, memory=1)
    path = str(folder / "images" / "toroid 97 32.npz")
    reply = worker.ask({"image": path, "output": str(folder / "none.npy")})
    assert reply == {"error": runner.OUT_OF_TIME if limit == "time" else runner.OUT_OF_MEMORY}
    assert worker.process is None
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_solved_images_are_not_solved_again(folder: Path) -> None:
    results = {"toroid 97 32": {"error_percent": 1.0}}
    worker = Worker(sys.executable, "raises", Limits())
    runner.run(worker, images.cases(quick=True)[:1], results, folder, lambda: None)
    assert results == {"toroid 97 32": {"error_percent": 1.0}}


@pytest.mark.parametrize("name", ["toroid 97", "opposite pair"])
def test_counted_rays_agree_with_the_forward_model(name: str) -> None:
    field = fields.paper_fields()[name]
    source = np.ones((48, 48))
    image = images.count_rays(field, source)
    expected = synthetic_image(field(48) * 48, source)
    assert image.sum() == pytest.approx(source.sum(), rel=1e-3)
    assert np.linalg.norm(image - expected) < 0.01 * np.linalg.norm(expected)


def test_waves_are_zero_at_the_border_and_invertible() -> None:
    shift = fields.waves(seed=1, modes=3, smallest=0.4)(64)
    rims = (shift[:, 0], shift[:, -1], shift[:, :, 0], shift[:, :, -1])
    assert max(np.abs(rim).max() for rim in rims) < 0.1 * np.abs(shift).max()
    slopes = np.gradient(shift * 64, axis=(1, 2))
    (yy, xy), (yx, xx) = slopes[0], slopes[1]
    least = (yy + xx) / 2 - np.hypot((yy - xx) / 2, (yx + xy) / 2)
    assert 0.35 < 1 + least.min() < 0.5


def test_page_is_that_of_the_results_and_names_solvers_that_do_not_install() -> None:
    results = json.loads(RESULTS.read_text(encoding="utf-8"))
    text = (ROOT / "docs" / "comparison.md").read_text(encoding="utf-8")
    assert text == page.render(results)
    assert f"Measured on {results['date']}" in text
    for solver in SOLVERS:
        assert solver.name in results["solvers"]
        assert solver.name in text
    results["solvers"]["absent"] = {"images": {}, "failure": "no wheel", "note": ""}
    assert "**absent** does not install: no wheel." in page.render(results)
