"""Make the pictures that the README shows.

    python docs/make_pictures.py [--data ../shared/data]

The burner shadowgrams (see the README's credits) are looked for in the data folder and
left out where they are absent.
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from napari_shadowinv import InversionOptions, invert, poisson_invert, read, synthetic_image
from napari_shadowinv.physics.phantoms import paper_setup, toroid
from napari_shadowinv.plotting import comparison_figure, report_figure

HERE = Path(__file__).parent
SHOT = "Image_20241017221829851.bmp"


def save_small(figure: Figure, path: Path, width: int) -> None:
    """Save a figure as a PNG `width` pixels wide."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=200)
    picture = Image.open(buffer).convert("RGB")
    height = round(width * picture.height / picture.width)
    picture.resize((width, height), Image.Resampling.LANCZOS).save(path, optimize=True)
    print(f"wrote {path}")


def toroid_picture() -> None:
    """The paper's toroid with noise: truth, retrieval and linear inversion."""
    setup = paper_setup()
    truth = toroid((200, 200), setup, 97.0, 30e-6).displacement
    image = synthetic_image(truth)
    image += 0.1 * np.random.default_rng(0).normal(size=image.shape)
    options = InversionOptions(negative="clip")
    fields = {
        "True": truth,
        "Retrieved": invert(image, source=np.ones_like(image), options=options).displacement,
        "Poisson": -np.array(np.gradient(poisson_invert(image))),
    }
    save_small(comparison_figure(fields, setup), HERE / "toroid.png", 1000)


def burner_picture(folder: Path) -> None:
    """A real shadowgram with its real reference beam."""
    shot = read(folder / SHOT).binned(2)
    reference = read(folder / "Image_00000.bmp").binned(2)
    inversion = invert(shot.image, source=reference.image)
    figure = report_figure(inversion, title="Plume of an alcohol burner")
    save_small(figure, HERE / "burner.png", 1300)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = HERE.parents[1] / "shared" / "data"
    parser.add_argument("--data", type=Path, default=default)
    toroid_picture()
    folder = parser.parse_args().data / "burner" / "data"
    if folder.is_dir():
        burner_picture(folder)
    else:
        print(f"no burner shadowgrams in {folder}: docs/burner.png stays as it is")


if __name__ == "__main__":
    main()
