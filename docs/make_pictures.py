"""Make the pictures that the README and the page on fits show.

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

from napari_shadowinv import (
    InversionOptions,
    ProtonSetup,
    fit,
    invert,
    poisson_invert,
    read,
    synthetic_image,
)
from napari_shadowinv.physics.phantoms import toroid
from napari_shadowinv.plotting import (
    comparison_figure,
    fit_figure,
    report_figure,
)
from napari_shadowinv.shot import shots_of

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
    setup = ProtonSetup.example()
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
    shot = read(folder / SHOT).bin_pixels(2)
    reference = read(folder / "Image_00000.bmp").bin_pixels(2)
    inversion = invert(shot.image, source=reference.image)
    figure = report_figure(inversion, title="Plume of an alcohol burner")
    save_small(figure, HERE / "burner.png", 1300)


def fit_picture() -> None:
    """Two folded radiographs, and the field and the beam that explain both."""
    low = ProtonSetup.example()
    high = low.model_copy(update={"energy": 30.0})
    truth = toroid((200, 200), low, 290.0, 30e-6).displacement
    y, x = np.indices((200, 200))
    beam = 1 + 0.25 * np.cos(y / 60) * np.sin(x / 45 + 1)
    rng = np.random.default_rng(0)
    images = [
        synthetic_image(strength * truth, beam) + 0.05 * rng.normal(size=beam.shape)
        for strength in (1, low.momentum / high.momentum)
    ]
    found = fit(shots_of(images, setup=[low, high], source="unknown", noise=0.05))
    save_small(fit_figure(found, title="Two energies, beam unknown"), HERE / "fit.png", 1300)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = HERE.parents[1] / "shared" / "data"
    parser.add_argument("--data", type=Path, default=default)
    toroid_picture()
    fit_picture()
    folder = parser.parse_args().data / "burner" / "data"
    if folder.is_dir():
        burner_picture(folder)
    else:
        print(f"no burner shadowgrams in {folder}: docs/burner.png stays as it is")


if __name__ == "__main__":
    main()
