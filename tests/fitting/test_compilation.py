"""The compiler is waited for once, and that is told."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.fitting import _ray_kernels, compilation, fit
from napari_shadowinv.fitting.compilation import ensure_compiled, is_compiled
from napari_shadowinv.options import FitOptions
from napari_shadowinv.shot import shots_of


def printed(script: str, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return done.stdout.strip()


def test_a_fit_tells_that_it_compiles_and_can_be_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    progress: list[Any] = []
    shots = shots_of(np.ones((2, 32, 32)), strength=[1, 0.5], noise=0.1)
    options = FitOptions(samples=0, max_iterations=1)
    ensure_compiled()  # else transport tells that it compiles, too
    monkeypatch.setattr(compilation, "is_compiled", lambda: False)
    fit(shots, options=options, on_progress=progress.append)
    assert [news.stage for news in progress[:4]] == ["compile"] * 3 + ["fit"]
    assert [news.step for news in progress[:3]] == [0, 1, 2]
    assert "once, for" in progress[0].message
    progress.clear()
    with pytest.raises(InversionCancelled):
        ensure_compiled(progress.append, should_stop=lambda: len(progress) == 2)
    assert len(progress) == 2
    monkeypatch.undo()
    assert is_compiled()
    fit(shots, options=options, on_progress=progress.append)
    assert progress[2].stage == "fit"


def test_code_of_other_kernels_is_no_reason_not_to_compile(tmp_path: Path) -> None:
    script = """
import os, time
from pathlib import Path
from napari_shadowinv.fitting import _ray_kernels as kernels
from napari_shadowinv.fitting import compilation

folder = Path(kernels.collect.stats.cache_path)
folder.mkdir(parents=True, exist_ok=True)
version = "py{0.major}{0.minor}".format(__import__("sys").version_info)
answers = [compilation.is_compiled()]
for when in (0.0, time.time()):
    for kernel in compilation._KERNELS:
        name = kernel.py_func.__name__
        path = folder / f"_ray_kernels.{name}-1.{version}.nbi"
        path.touch()
        os.utime(path, (when, when))
    answers.append(compilation.is_compiled())
print(answers)
"""
    # The middle one is of a source that has changed since.
    assert printed(script, NUMBA_CACHE_DIR=str(tmp_path)) == "[False, False, True]"


def test_it_leaves_nothing_to_compile_for_an_inversion_and_a_fit() -> None:
    script = """
import sys
import numpy as np
from napari_shadowinv.fitting import compilation, fit
from napari_shadowinv.inversion import compilation as of_transport, invert
from napari_shadowinv.options import FitOptions, InversionOptions
from napari_shadowinv.shot import shots_of
from napari_shadowinv.transport.linear import LaplacianSolver

kernels = {
    function
    for name, module in list(sys.modules.items()) if name.startswith("napari_shadowinv")
    for function in vars(module).values() if hasattr(function, "signatures")
}
count = lambda: {kernel.py_func.__name__: len(kernel.signatures) for kernel in kernels}
added = lambda before: [name for name, number in count().items() if number > before[name]]

of_transport.is_compiled = lambda: False
of_transport.ensure_compiled()
compiled = count()
assert sum(compiled.values()) > 10
LaplacianSolver.__init__.__kwdefaults__["nodes_per_block"] = 700  # blocks of nodes on two levels
y, x = np.indices((100, 100)) / 100
for rows in (40, 100):
    source = 1 + x[:rows]
    invert(1 + y[:rows] * x[:rows], source=source, options=InversionOptions(n_sites=source.size))
print(added(compiled))

compilation.is_compiled, of_transport.is_compiled = lambda: False, lambda: True
compilation.ensure_compiled()
compilation.is_compiled = lambda: True
compiled = count()
y, x = np.indices((32, 40)) / 10
image = 1 + 0.1 * np.sin(y) * np.cos(x)
shots = shots_of([image, 1 + 0.5 * (image - 1)], strength=[1, 0.5], noise=0.02)
fit(shots, options=FitOptions(samples=2, max_iterations=2, align="affine"))
print(added(compiled))
"""
    assert printed(script) == "[]\n[]"


def test_parts_of_kernels_are_compiled_into_them_only() -> None:
    """A part with machine code of its own would sum in another order in the first process."""
    attributes = vars(_ray_kernels).items()
    compiled = {name: kernel for name, kernel in attributes if hasattr(kernel, "py_func")}
    parts = {name: kernel for name, kernel in compiled.items() if name.startswith("_")}
    assert len(parts) > 4
    assert all(part.targetoptions.get("inline") == "always" for part in parts.values())
    kernels = compiled.keys() - parts.keys()
    assert kernels == {kernel.py_func.__name__ for kernel in compilation._KERNELS}
    # None of them calls another.
    called = {name for kernel in kernels for name in compiled[kernel].py_func.__code__.co_names}
    assert not called & kernels
