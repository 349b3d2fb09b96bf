"""Any program: the command in COMPARE_PROGRAM is handed two text files and writes a third."""

import os
import shlex
import subprocess
import tempfile
from pathlib import Path

import numpy as np

VERSION = "as given"


def solve(source: np.ndarray, image: np.ndarray) -> np.ndarray:
    with tempfile.TemporaryDirectory() as folder:
        names = ("source", "image", "displacement")
        files = {name: str(Path(folder, f"{name}.txt")) for name in names}
        np.savetxt(files["source"], source)
        np.savetxt(files["image"], image)
        words = shlex.split(os.environ["COMPARE_PROGRAM"])
        for name, file in files.items():
            words = [word.replace(f"{{{name}}}", file) for word in words]
        limit = 0.95 * float(os.environ.get("COMPARE_LIMIT", "inf"))
        done = subprocess.run(words, capture_output=True, text=True, timeout=limit)
        if done.returncode:
            said = (done.stderr.strip() or done.stdout.strip() or "nothing").splitlines()[-1]
            raise RuntimeError(f"exit code {done.returncode}: {said}")
        return np.loadtxt(files["displacement"]).reshape(2, *image.shape)
