"""Make the pictures of napari's window that the README shows.

    xvfb-run -a -s "-screen 0 2560x1440x24" python docs/make_screenshots.py [--data ../shared/data]

Each is a window of 1280 × 800 pixels as a user sees it. The burner shadowgrams (see the
README's credits) are looked for in the data folder and left out where they are absent.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from PIL import Image
from qtpy.QtWidgets import QApplication

import napari
from napari_shadowinv import InversionOptions, add_inversion, invert, read
from napari_shadowinv._napari.marks import setup_of
from napari_shadowinv._napari.shots import radiograph_layers

HERE = Path(__file__).parent / "pictures"
PLUGIN = "napari-shadowinv"
SHOT = "Image_20241017221829851.bmp"
REFERENCE = "Image_00000.bmp"


def new_window(title: str) -> napari.Viewer:
    """Open an empty window of the pictures' size."""
    viewer = napari.Viewer(title=title)
    viewer.window._qt_window.resize(1280, 800)
    return viewer


def settle(seconds: float = 1.0) -> None:
    """Let the window draw itself."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        QApplication.processEvents()
        time.sleep(0.02)


def photograph(viewer: napari.Viewer, name: str) -> None:
    """Save the window as it is seen, and close it."""
    viewer.reset_view()
    settle()
    pixels = viewer.window.screenshot(canvas_only=False, flash=False)
    path = HERE / name
    Image.fromarray(pixels[..., :3]).save(path, optimize=True)
    print(f"wrote {path} {pixels.shape[1]}×{pixels.shape[0]}")
    viewer.close()
    settle(0.2)


def toroid_window() -> None:
    """The paper's toroid with caustics: the widget, the field and its arrows."""
    viewer = new_window("toroid with caustics")
    (shot,) = viewer.open_sample(PLUGIN, "toroid_with_caustics")
    shot.name = "toroid"
    viewer.window.add_plugin_dock_widget(PLUGIN, "Invert shot")  # takes the selected shot
    inversion = invert(shot.data, options=InversionOptions(n_sites=10_000))
    add_inversion(viewer, inversion, setup_of(shot), name="toroid")
    photograph(viewer, "napari-toroid.png")


def burner_window(folder: Path) -> None:
    """A real shadowgram, its reference beam, and the deflection found."""
    viewer = new_window("alcohol burner")
    shot = read(folder / SHOT).binned(2)
    reference = read(folder / REFERENCE).binned(2)
    inversion = invert(shot.image, source=reference.image)
    for data, keywords, _ in radiograph_layers(shot, "burner 03"):
        viewer.add_image(data, **keywords)
    layers = add_inversion(viewer, inversion, name="burner 03")
    field = next(layer for layer in layers if layer.name.endswith("|d| (px)"))
    # A few pixels at the nozzle are far above the plume.
    field.contrast_limits = (0, float(np.percentile(field.data, 99.5)))
    photograph(viewer, "napari-burner.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=HERE.parents[2] / "shared" / "data")
    folder = parser.parse_args().data / "burner" / "data"
    HERE.mkdir(exist_ok=True)
    toroid_window()
    if (folder / SHOT).exists():
        burner_window(folder)
    else:
        print(f"no burner shadowgrams in {folder}: their picture is left out")


if __name__ == "__main__":
    main()
