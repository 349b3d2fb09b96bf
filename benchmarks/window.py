"""What a window costs: the same inversion alone and beside napari's window.

    python benchmarks/window.py [--pixels 600] [--repeat 3]

The window is 1280 × 800 pixels, holds the shot and the widget *Invert*, and its Run button
is pressed. Without a graphics card (``xvfb-run -a -s "-screen 0 2560x1440x24"``, remote desktops)
the processor draws the window, and takes that time from the inversion. Processor time, which
other programs do not disturb, is told beside the time by the clock; each figure is the least of
the repetitions.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from qtpy.QtCore import QSettings
from qtpy.QtWidgets import QApplication

import napari
from napari_shadowinv import InversionOptions, ProtonSetup, Recipe, run
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import toroid
from napari_shadowinv.pipeline import Cache


def noisy_toroid(side: int) -> np.ndarray[Any, Any]:
    """The paper's toroid below caustics, with 5 % of noise."""
    setup = ProtonSetup.example().model_copy(update={"pixel_size": 1.5e-6 * 200 / side})
    image = synthetic_image(toroid((side, side), setup, 97, 30e-6).displacement)
    return np.maximum(image + np.random.default_rng(0).normal(0, 0.05, image.shape), 0)


@dataclass(frozen=True, order=True)
class Cost:
    """Seconds of all processors, seconds by the clock, and how often the window was drawn."""

    processor: float
    clock: float
    drawn: int = 0


def alone(shot: np.ndarray[Any, Any], n_sites: int) -> Cost:
    """Invert without a window."""
    options = InversionOptions(n_sites=n_sites)
    used, start = time.process_time(), time.perf_counter()
    run(Recipe(options=options), shot)
    return Cost(time.process_time() - used, time.perf_counter() - start)


class Window:
    """napari with a shot and the widget that inverts it."""

    def __init__(self, shot: np.ndarray[Any, Any], n_sites: int) -> None:
        self.viewer = napari.Viewer()
        self.viewer.window._qt_window.resize(1280, 800)
        self.viewer.add_image(shot, name="shot")
        _, self.tool = self.viewer.window.add_plugin_dock_widget("napari-shadowinv", "Invert")
        self.tool.options.restore({"n_sites": n_sites})
        self.drawn = 0
        self.viewer.window._qt_viewer.canvas.native.aboutToCompose.connect(self._on_draw)
        self.settle(2)

    def _on_draw(self) -> None:
        self.drawn += 1

    def run(self) -> Cost:
        """Press Run and wait for the answer, without its layers."""
        self.tool._cache = Cache()
        self.tool.show_result = lambda *_: None
        panel, ended = self.tool.panel, []
        panel.ended.connect(ended.append)
        self.drawn = 0
        used, start = time.process_time(), time.perf_counter()
        self.tool.panel.button.click()
        while not ended:
            QApplication.processEvents()
            time.sleep(0.005)
        cost = Cost(time.process_time() - used, time.perf_counter() - start, self.drawn)
        panel.ended.disconnect(ended.append)
        self.settle(0.5)
        return cost

    def settle(self, seconds: float) -> None:
        """Let the window draw itself."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            QApplication.processEvents()
            time.sleep(0.005)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pixels", type=int, default=600, help="side of the image")
    parser.add_argument("--n-sites", type=int, default=40_000)
    parser.add_argument("--repeat", type=int, default=3)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        QSettings.setPath(QSettings.Format.IniFormat, QSettings.Scope.UserScope, folder)
        shot = noisy_toroid(given.pixels)
        alone(shot, given.n_sites)  # compiles
        without = min(alone(shot, given.n_sites) for _ in range(given.repeat))
        window = Window(shot, given.n_sites)
        runs = [window.run() for _ in range(given.repeat)]
        beside = min(runs)
        print(
            f"{given.pixels}² px, {given.n_sites:,} sites, s of the processors (by the clock): "
            f"alone {without.processor:.2f} ({without.clock:.2f}), beside a window "
            f"{beside.processor:.2f} ({beside.clock:.2f}), "
            f"{beside.processor / without.processor:.2f} times as much; the window was drawn "
            f"{beside.drawn} times"
        )
        window.viewer.close()


if __name__ == "__main__":
    main()
