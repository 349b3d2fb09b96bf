import os
import subprocess
import sys

import numpy as np

from napari_shadowinv import invert
from napari_shadowinv.compilation import is_compiled


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


def test_after_an_inversion_the_code_is_kept():
    invert(np.ones((8, 8)))
    assert is_compiled()
