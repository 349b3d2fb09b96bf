import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from napari_shadowinv import invert
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.geometry import flips
from napari_shadowinv.inversion import compilation, machine_code
from napari_shadowinv.inversion.compilation import ensure_compiled
from napari_shadowinv.inversion.machine_code import is_compiled

# Root may write everywhere, unless it does without its privileges.
WITHOUT_PRIVILEGES = ["setpriv", "--bounding-set=-all", "--inh-caps=-all"]


def test_without_the_compiler_an_inversion_is_slow_and_the_same():
    """And a first inversion loads no part of SciPy that it does not need."""
    script = """
import sys
import numpy as np
from napari_shadowinv import invert
y, x = np.indices((14, 14)) - 6.5
print(repr(float(np.hypot(*invert(1 + np.exp(-(y**2 + x**2) / 16)).displacement).max())))
print({f"scipy.{name}" for name in ("integrate", "interpolate", "stats")} & set(sys.modules))
"""
    slow, modules = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    y, x = np.indices((14, 14)) - 6.5
    displacement = invert(1 + np.exp(-(y**2 + x**2) / 16)).displacement
    assert float(slow) == pytest.approx(np.hypot(*displacement).max(), rel=1e-6)
    assert float(slow) > 0.5
    assert modules == "set()"


def test_compilation_is_reported_cancellable_and_done_once(monkeypatch):
    progress = []
    monkeypatch.setattr(compilation, "is_compiled", lambda: False)
    ensure_compiled(progress.append)
    assert [news.stage for news in progress] == ["compile"]
    with pytest.raises(InversionCancelled):
        ensure_compiled(should_stop=lambda: True)
    monkeypatch.undo()
    assert is_compiled()
    ensure_compiled(progress.append)
    assert len(progress) == 1


def test_a_first_inversion_has_the_help_of_a_second_process_which_ends_with_it(monkeypatch):
    helpers = []

    class Helper(subprocess.Popen):
        def __init__(self, command, **choices):
            helpers.append(self)
            super().__init__([sys.executable, "-c", "import time; time.sleep(60)"], **choices)
            self.asked = command[-1]

    monkeypatch.setattr(machine_code.subprocess, "Popen", Helper)
    invert(np.ones((20, 20)))
    assert helpers == []
    monkeypatch.setattr(machine_code, "is_loaded", lambda: False)
    monkeypatch.setattr(machine_code, "is_compiled", lambda: False)
    invert(np.ones((20, 20)))
    (helper,) = helpers
    assert helper.returncode is not None
    namespace = {}
    exec(helper.asked.split(";")[0], namespace)
    assert namespace["compile_rest"] is compilation.compile_rest


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="permissions of another kind")
def test_a_kernel_runs_where_no_folder_keeps_its_code(tmp_path):
    """Neither the package nor the home can be written."""
    if os.getuid() == 0 and not shutil.which("setpriv"):
        pytest.skip("root may write everywhere")
    import napari_shadowinv

    script = """
from napari_shadowinv.geometry.compiler import is_code_cached
from napari_shadowinv.geometry.density import _inside_share

print(is_code_cached(), *_inside_share(0.5, 1.0, 1))
"""
    place = tmp_path / "installed"
    shutil.copytree(Path(napari_shadowinv.__file__).parent, place / "napari_shadowinv")
    for folder in (place, *place.rglob("*")):
        folder.chmod(0o555)
    done = subprocess.run(
        [*(WITHOUT_PRIVILEGES if os.getuid() == 0 else []), sys.executable, "-c", script],
        cwd=place,
        env={"PYTHONPATH": str(place), "HOME": str(place / "home")},
        capture_output=True,
        text=True,
    )
    for folder in (place, *place.rglob("*")):
        folder.chmod(0o755)
    assert done.stdout.split() == ["False", "0.0", "0.5"], done.stderr


def test_machine_code_of_an_earlier_process_is_recognised(monkeypatch, tmp_path):
    """By the file that numba writes for the triangulation's kernel, whatever its module's name."""
    source = Path(flips.build.py_func.__code__.co_filename)
    stats = SimpleNamespace(cache_path=str(tmp_path))
    kernel = SimpleNamespace(signatures=[], stats=stats, py_func=flips.build.py_func)
    monkeypatch.setattr(flips, "build", kernel)
    assert not machine_code.is_compiled()
    version = f"py{sys.version_info.major}{sys.version_info.minor}"
    (tmp_path / f"{source.stem}.build-402.{version}.nbi").touch()
    assert machine_code.is_compiled()
