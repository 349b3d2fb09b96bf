"""Make the pictures of napari's window that the README and docs/batch.md show.

    xvfb-run -a -s "-screen 0 2560x1440x24" python docs/make_screenshots.py [--data ../shared/data]

Each is a window of 1280 × 800 pixels as a user sees it. The burner shadowgrams (see the
README's credits) are looked for in the data folder and left out where they are absent.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from contextlib import chdir
from pathlib import Path

import numpy as np
from PIL import Image
from qtpy.QtWidgets import QApplication

import napari
from napari_shadowinv import InversionOptions, add_inversion, invert
from napari_shadowinv._napari.layer_metadata import setup_of
from napari_shadowinv.stack import read_shot

HERE = Path(__file__).parent / "pictures"
PLUGIN = "napari-shadowinv"
FRAMES, SHOWN = 6, 2


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
    settle(3.0)
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


def stack_window(folder: Path) -> None:
    """A run over real shadowgrams without a reference: the widget, and a shot's field."""
    viewer = new_window("alcohol burner")
    shots = [read_shot(path, channel="mean", factor=4) for path in frames(folder)]
    viewer.add_image(np.stack(shots), name="burner")
    _, widget = viewer.window.add_plugin_dock_widget(PLUGIN, "Invert stack")
    widget.source.picker.set_kind("polynomial")
    widget.cleaning.picker.set_kind("hot_pixels")
    widget.cleaning.folded.expand()
    with tempfile.TemporaryDirectory() as scratch, chdir(scratch):
        widget.store.edit.setText("burner.shadowinv.zarr")
        widget.panel.button.click()
        while widget.panel.runner.running or widget.results.busy:
            settle(0.2)
        viewer.dims.set_current_step(0, SHOWN)
        photograph(viewer, "napari-stack.png")


def frames(folder: Path) -> list[Path]:
    return sorted(folder.glob("Image_2*.bmp"))[:FRAMES]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=HERE.parents[2] / "shared" / "data")
    folder = parser.parse_args().data / "burner" / "data"
    HERE.mkdir(exist_ok=True)
    toroid_window()
    if frames(folder):
        stack_window(folder)
    else:
        print(f"no burner shadowgrams in {folder}: their picture is left out")


if __name__ == "__main__":
    main()
