"""The comparison of solvers: images, names of failures, and the page of its results."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from compare import images, page, runner
from compare.catalogue import OURS, SOLVERS, STAND_IN
from compare.runner import Limits, Worker

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "pictures" / "comparison.json"
POISSON = "Poisson (SciPy)"
LOCAL = {solver.name: solver.module for solver in SOLVERS if solver.environment == "ours"}

# Modules of solvers that fail.
FAILING = {
    "raises": "def solve(source, image):\n    raise ValueError('no light')\n",
    "dark": "def solve(source, image):\n    return np.full((2, *image.shape), np.nan)\n",
    "wild": "def solve(source, image):\n    return np.full((2, *image.shape), 1e6)\n",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("compare")
    images.write_images(place / "images", images.cases(quick=True)[:1])
    for name, code in FAILING.items():
        (place / f"{name}.py").write_text(f"import numpy as np\nVERSION = '0'\n{code}")
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


def test_another_program_reads_two_files_and_writes_a_third(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = folder / "linear.py"
    script.write_text(
        "import sys\nimport numpy as np\n"
        f"sys.path.insert(0, {str(ROOT / 'benchmarks' / 'compare' / 'solvers')!r})\n"
        "from poisson import solve\n"
        "source, image = map(np.loadtxt, sys.argv[1:3])\n"
        "np.savetxt(sys.argv[3], np.concatenate(solve(source, image)))\n"
    )
    command = f"{sys.executable} {script} {{source}} {{image}} {{displacement}}"
    monkeypatch.setenv("COMPARE_PROGRAM", command)
    result, built_in = solve("program", folder), solve(LOCAL[POISSON], folder)
    assert result["error_percent"] == pytest.approx(built_in["error_percent"])
    assert result["processor_seconds"] > built_in["processor_seconds"]
    monkeypatch.setenv("COMPARE_PROGRAM", f"{sys.executable} -c 'raise SystemExit(\"no light\")'")
    assert "no light" in solve("program", folder)["failure"]


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
