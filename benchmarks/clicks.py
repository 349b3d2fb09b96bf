"""What a user clicks from an opened pair of images and a setup file to a field in T m.

    xvfb-run -a -s "-screen 0 2560x1440x24" python benchmarks/clicks.py

A real window is clicked by the mouse: each menu, button, choice and field that is typed into
counts as one. The pair and the setup are files, and no session came before.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from qtpy.QtCore import QPoint, QSettings, Qt, QTimer
from qtpy.QtTest import QTest
from qtpy.QtWidgets import QApplication, QFileDialog, QLineEdit, QMenu, QWidget

import napari
from napari_shadowinv import ProtonSetup
from napari_shadowinv._napari.layer_metadata import role_of, unit_of
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import toroid

SETUP = """kind = "proton"
energy = 14.7
source_object_distance = "1.3 mm"
object_image_distance = "20 mm"
pixel_size = "1.5 um"
"""
PATIENCE_S = 90.0


def write_files(folder: Path) -> tuple[Path, Path, Path]:
    """Write a shot, its reference and the setup."""
    rng = np.random.default_rng(1)
    image = synthetic_image(toroid((200, 200), ProtonSetup.example(), 97, 30e-6).displacement)
    files = folder / "shot_0012.tif", folder / "reference.tif", folder / "setup.toml"
    for path, flux in zip(files, (image, np.ones_like(image)), strict=False):
        tifffile.imwrite(path, rng.poisson(2000 * flux).astype(np.uint16))
    files[2].write_text(SETUP)
    return files


class Mouse:
    """Clicks widgets at places on the screen, and lists what was clicked."""

    def __init__(self) -> None:
        self.clicked: list[str] = []

    def click(self, widget: QWidget, name: str, at: QPoint | None = None) -> None:
        assert widget.isVisible(), name
        self.clicked.append(name)
        place = widget.rect().center() if at is None else at
        QTest.mouseClick(widget, Qt.MouseButton.LeftButton, pos=place)

    def choose(self, menu: Any, title: str) -> QMenu | None:
        """Click an entry of an open menu or of the menu bar; return the menu that opens."""
        entry = next(a for a in menu.actions() if a.text().replace("&", "") == title)
        self.click(menu, f"menu {title}", menu.actionGeometry(entry).center())
        settle(0.3)
        return entry.menu()

    def answer(self, path: Path) -> None:
        """Type a name into the dialog that is open, and confirm it."""
        dialog: Any = QApplication.activeModalWidget()
        assert isinstance(dialog, QFileDialog)
        dialog.findChild(QLineEdit).setText(str(path))
        self.clicked.append(f"type {path.name}")
        button = next(b for b in buttons_of(dialog) if b.text().replace("&", "") == "Open")
        self.click(button, "button Open")


def buttons_of(dialog: Any) -> list[Any]:
    from qtpy.QtWidgets import QPushButton

    return list(dialog.findChildren(QPushButton))


def settle(seconds: float) -> None:
    wait_for(lambda: False, seconds)


def wait_for(condition: Callable[[], bool], seconds: float = PATIENCE_S) -> None:
    """Let the window work until a condition holds."""
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        QApplication.processEvents()
        time.sleep(0.01)


def walk(viewer: Any, setup: Path) -> list[str]:
    """Click from the opened pair to the field."""
    mouse, main = Mouse(), viewer.window._qt_window
    plugins = mouse.choose(main.menuBar(), "Plugins")
    assert plugins is not None
    ours = mouse.choose(plugins, "Shadowinv")
    assert ours is not None
    mouse.choose(ours, "Invert (Shadowinv)")
    tool: Any = next(iter(viewer.window.dock_widgets.values()))
    wait_for(tool.isVisible)
    settle(0.5)
    load = tool.setup.load_button
    tool.area.ensureWidgetVisible(load)  # by the wheel
    QTimer.singleShot(1500, lambda: mouse.answer(setup))
    mouse.click(load, "button Load setup…")
    tool.area.ensureWidgetVisible(tool.panel.button)
    settle(0.3)
    mouse.click(tool.panel.button, "button Run")
    fields: list[Any] = []

    def has_field() -> bool:
        fields[:] = [layer for layer in viewer.layers if role_of(layer) == "field"]
        return bool(fields)

    wait_for(has_field)
    (field,) = fields
    assert unit_of(field).endswith("T·m"), unit_of(field)
    source = tool.source.layer
    print(f"image {tool.image.layer.name}, source {source.name if source else tool.source.kind}")
    print(f"{field.name}: largest {np.nanmax(field.data):.3g}")
    return mouse.clicked


def main() -> None:
    QApplication.setAttribute(Qt.ApplicationAttribute.AA_DontUseNativeDialogs)
    with tempfile.TemporaryDirectory() as folder:
        QSettings.setPath(QSettings.Format.IniFormat, QSettings.Scope.UserScope, folder)
        shot, reference, setup = write_files(Path(folder))
        viewer = napari.Viewer()
        viewer.window._qt_window.resize(1600, 1000)
        viewer.open([str(shot), str(reference)], plugin="napari")
        settle(1)
        clicked = walk(viewer, setup)
        for number, name in enumerate(clicked, 1):
            print(f"{number:2}  {name}")
        print(f"{len(clicked)} clicks")
        viewer.close()


if __name__ == "__main__":
    main()
