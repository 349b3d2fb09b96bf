import os
import subprocess
import sys

import pytest

from napari_shadowinv import InversionCancelled, compilation
from napari_shadowinv.compilation import ensure_compiled, is_compiled


def test_an_empty_cache_means_to_compile(tmp_path):
    script = "from napari_shadowinv.compilation import is_compiled; print(is_compiled())"
    printed = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert printed.stdout.strip() == "False"


def test_it_is_told_and_can_be_cancelled_and_is_done_once(monkeypatch):
    told = []
    monkeypatch.setattr(compilation, "is_compiled", lambda: False)
    ensure_compiled(told.append)
    assert [news.stage for news in told] == ["compile"]
    with pytest.raises(InversionCancelled):
        ensure_compiled(should_stop=lambda: True)
    monkeypatch.undo()
    assert is_compiled()
    ensure_compiled(told.append)
    assert len(told) == 1


def test_it_leaves_nothing_to_compile_for_an_inversion():
    script = """
import sys
import numpy as np
from napari_shadowinv import compilation, invert

compilation.is_compiled = lambda: False
compilation.ensure_compiled()
kernels = {
    function
    for name, module in list(sys.modules.items()) if name.startswith("napari_shadowinv")
    for function in vars(module).values() if hasattr(function, "signatures")
}
compiled = {kernel: len(kernel.signatures) for kernel in kernels}
assert sum(compiled.values()) > 10
y, x = np.indices((40, 60)) / 60
invert(1 + y * x, source=1 + x)
print([kernel.py_func.__name__ for kernel in kernels if len(kernel.signatures) > compiled[kernel]])
"""
    printed = subprocess.run(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, check=True
    )
    assert printed.stdout.strip() == "[]"
