"""Make the pictures of docs/gallery.md by running every script of examples/.

    python docs/make_gallery.py [NAME ...] [--data ../shared/data]

Scripts whose data are absent are left out, and their pictures stay as they are.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

HERE = Path(__file__).parent
PICTURES = HERE / "pictures"
EXAMPLES = HERE.parent / "examples"
# Folder of the data that a script needs.
DATA = {"burner_strip": "burner/data", "donut": "donut", "rcf_layers": "rcf"}

LARGEST_WIDTH = 1500  # px
LARGEST_FILE = 390_000  # bytes


def make_picture(script: Path, arguments: list[str], folder: Path) -> None:
    """Run a script, and keep its picture, shrunk until its file is small enough for a page."""
    start = time.perf_counter()
    command = [sys.executable, str(script), *arguments, "--out", str(folder)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    target = PICTURES / f"{script.stem}.png"
    picture = Image.open(folder / target.name).convert("RGB")
    width = min(LARGEST_WIDTH, picture.width)
    while True:
        size = width, round(width * picture.height / picture.width)
        picture.resize(size, Image.Resampling.LANCZOS).save(target, optimize=True)
        if target.stat().st_size < LARGEST_FILE:
            break
        width = round(0.95 * width)
    seconds = time.perf_counter() - start
    print(f"wrote {target}, {target.stat().st_size / 1000:.0f} kB, in {seconds:.0f} s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = HERE.parents[1] / "shared" / "data"
    parser.add_argument("names", nargs="*", help="scripts to run; all if none is named")
    parser.add_argument("--data", type=Path, default=default)
    options = parser.parse_args()
    data = options.data
    scripts = [EXAMPLES / f"{name}.py" for name in options.names]
    PICTURES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for script in scripts or sorted(EXAMPLES.glob("*.py")):
            needed = DATA.get(script.stem)
            if needed is not None and not (data / needed).is_dir():
                print(f"no data in {data / needed}: {script.stem}.png stays as it is")
                continue
            make_picture(script, [str(data / needed)] if needed else [], Path(folder))


if __name__ == "__main__":
    main()
