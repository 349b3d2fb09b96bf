"""Make the pictures of napari's window that the README, pages of docs and the tutorials show.

    QT_API=pyqt6 xvfb-run -a -s "-screen 0 2560x1440x24" python docs/make_screenshots.py [NAME ...]

NAME is a window below, such as `toroid` or `first`; all of them without one. Each picture shows
the window as a new user sees it, 1280 pixels wide. The burner shadowgrams (see the README's
credits) and the films of the tutorial are looked for in the data folder and left out where they
are absent.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path
from typing import Any

import napari.settings
import numpy as np
from make_film_pictures import pack_of_page
from napari._qt.dialogs.preferences_dialog import PreferencesDialog
from napari._qt.dialogs.qt_notification import NapariQtNotification
from PIL import Image, ImageDraw
from qtpy.QtCore import QPoint, QSettings
from qtpy.QtGui import QImage
from qtpy.QtWidgets import QApplication

import napari
from napari_shadowinv import ProtonSetup
from napari_shadowinv._napari.layer_metadata import metadata_for
from napari_shadowinv.io import read_shot
from napari_shadowinv.physics.phantoms import toroid
from napari_shadowinv.physics.projection import predict_image

HERE = Path(__file__).parent / "pictures"
PLUGIN = "napari-shadowinv"
LARGEST_FILE = 300_000  # bytes
FRAMES, SHOWN = 6, 2
ABOVE, BELOW = 190, 50  # px of the canvas that colour bar and scale bar take
MENU_X, MENU_Y = 90, 24  # px, of the menu *Layers* in the menu bar
MENU_PICTURE = (900, 400)  # px, upper left part of the window
NIGHT_ARROWS = 7.0  # their length, as the tutorial tells to type
TOUR_SIZE, TOUR_COLOURS = (1120, 700), 128
POINTER = ((0, 0), (0, 22), (5, 17), (9, 26), (13, 24), (9, 15), (16, 15))  # px
# What the tutorial tells to type.
PROTON_FIELDS = {
    "energy": 14.7,
    "source_object_distance": 1.3e-3,
    "object_image_distance": 20e-3,
    "detector_pixel_size": 24.57e-6,
}


def new_window(title: str, height: int = 800) -> napari.Viewer:
    """Open an empty window of the pictures' size."""
    viewer = napari.Viewer(title=title)
    viewer.window._qt_window.resize(1280, height)
    settle()
    return viewer


def settle(seconds: float = 1.0) -> None:
    """Let the window draw itself."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        QApplication.processEvents()
        time.sleep(0.02)


def fit(viewer: napari.Viewer) -> None:
    """Show the whole image, below the colour bar if there is one."""
    viewer.reset_view()
    if not any(
        getattr(layer, "colorbar", None) and layer.colorbar.visible for layer in viewer.layers
    ):
        return
    height = viewer.window._qt_viewer.canvas.size[0]
    low, high = viewer.layers.extent.world[:, -2]
    camera = viewer.scene.camera
    camera.zoom *= min(1.0, (height - ABOVE - BELOW) / ((high - low) * camera.zoom))
    top = (height - (high - low) * camera.zoom) / 2
    depth, y, x = camera.center
    camera.center = (depth, y - max(0.0, ABOVE - top) / camera.zoom, x)


def photograph(viewer: napari.Viewer, name: str, *, close: bool = True) -> None:
    """Save the window as it is seen, and close it."""
    settle()
    fit(viewer)
    # It may go on turning when a file has been opened.
    viewer.window._qt_window._activity_dialog.maybe_hide_progress_indicator()
    settle(3.0)
    for notification in viewer.window._qt_window.findChildren(NapariQtNotification):
        notification.close()  # it covers the scale bar
    settle(0.2)
    pixels = viewer.window.screenshot(canvas_only=False, flash=False)
    path = HERE / name
    picture = Image.fromarray(pixels[..., :3])
    picture.save(path, optimize=True)
    if path.stat().st_size > LARGEST_FILE:
        picture.quantize(256).save(path, optimize=True)
    print(f"wrote {path} {pixels.shape[1]}×{pixels.shape[0]}")
    if close:
        viewer.close()
        settle(0.2)


def open_widget(viewer: napari.Viewer, name: str) -> Any:
    """Open a widget of the plugin by its menu."""
    menu = viewer.window._qt_window.menuBar()
    for title in ("Plugins", "Shadowinv"):
        menu = next(a.menu() for a in menu.actions() if a.text().replace("&", "") == title)
        menu.aboutToShow.emit()
    title = f"{name} (Shadowinv)"
    next(entry for entry in menu.actions() if entry.text() == title).trigger()
    settle()
    return viewer.window.dock_widgets[title]


def press_run(widget: Any) -> None:
    """Press Run and wait until all layers are there."""
    widget.panel.button.click()
    settle(0.2)
    while widget.panel.running or (hasattr(widget, "results") and widget.results.busy):
        settle(0.2)
    settle()
    widget.area.verticalScrollBar().setValue(widget.panel.y())  # Run, and the report below it


def show_only(viewer: napari.Viewer, *titles: str) -> None:
    """Switch on the layers whose names begin with these titles, and off all others."""
    for layer in viewer.layers:
        layer.visible = layer.name.lstrip("✓±?✗ ").startswith(titles)


def toroid_window() -> None:
    """The paper's toroid with caustics: the widget, the field and its arrows."""
    viewer = new_window("toroid with caustics")
    *_, shot = viewer.open_sample(PLUGIN, "toroid_with_caustics")
    shot.name = "toroid"
    widget = open_widget(viewer, "Invert")
    press_run(widget)
    widget.area.verticalScrollBar().setValue(0)
    widget.area.ensureWidgetVisible(widget.panel.status)
    photograph(viewer, "napari-toroid.png")


def stack_window(folder: Path) -> None:
    """A run over real shadowgrams with their reference: the widget, and a shot's field."""
    viewer = new_window("alcohol burner", height=840)
    reference, *shots = (
        read_shot(path, channel="mean").bin_pixels(4).image
        for path in (folder / "Image_00000.bmp", *frames(folder))
    )
    viewer.add_image(reference, name="reference", visible=False)
    viewer.add_image(np.stack(shots), name="burner", axis_labels=("shot", "y", "x"))
    widget = open_widget(viewer, "Invert")
    widget.source.layer = viewer.layers["reference"]
    widget.steps.add("hot-pixels")
    widget.steps.folded.expand()
    with tempfile.TemporaryDirectory() as scratch, chdir(scratch):
        widget.store.folder.restore({"path": "burner.shadowinv.zarr"})
        press_run(widget)
        viewer.dims.set_current_step(0, SHOWN)
        photograph(viewer, "napari-stack.png")


def first_windows() -> None:
    """Tutorial: the sample and its widget, the field, and a line profile through both."""
    viewer = new_window("first shadowgram")
    viewer.open_sample(PLUGIN, "toroid")
    tool = open_widget(viewer, "Invert")
    photograph(viewer, "tutorial-first-shot.png", close=False)
    press_run(tool)
    photograph(viewer, "tutorial-first-field.png", close=False)
    show_only(viewer, "residual (% of mean)")
    viewer.layers.selection.active = viewer.layers["✓ residual (% of mean) – toroid"]
    photograph(viewer, "tutorial-first-residual.png", close=False)
    show_only(viewer, "|∫B×dz| (mT·m)")
    profile = open_widget(viewer, "Analyse")
    profile._draw()
    profile.lines.layer.add([[99.5, 5.0], [99.5, 194.0]], shape_type="line")
    photograph(viewer, "tutorial-first-profile.png")


def make_pair() -> None:
    """Write shot.tif and reference.tif as the tutorial on a radiograph does."""
    text = (HERE.parent / "tutorials" / "proton-radiograph.md").read_text(encoding="utf-8")
    (making,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    exec(compile(making, "proton-radiograph.md", "exec"), {})


class MovingPicture:
    """Pictures of a window, each with the time that it is shown and where the pointer is."""

    def __init__(self, viewer: napari.Viewer) -> None:
        self.viewer, self.pictures, self.times = viewer, [], []

    def add(self, seconds: float, at: Any = None) -> None:
        """Take a picture of the window, with the pointer on the middle of a widget."""
        settle(0.3)
        for notification in self.viewer.window._qt_window.findChildren(NapariQtNotification):
            notification.close()
        pixels = self.viewer.window.screenshot(canvas_only=False, flash=False)
        picture = Image.fromarray(pixels[..., :3])
        if at is not None:
            window = self.viewer.window._qt_window
            place = at.mapTo(window, at.rect().center())
            corners = [(place.x() + x, place.y() + y) for x, y in POINTER]
            ImageDraw.Draw(picture).polygon(corners, fill="white", outline="black", width=2)
        self.pictures.append(picture.resize(TOUR_SIZE, Image.Resampling.LANCZOS))
        self.times.append(round(1000 * seconds))

    def save(self, path: Path) -> None:
        """Save the pictures as a GIF that begins again at its end."""
        first, *others = (
            picture.quantize(TOUR_COLOURS, dither=Image.Dither.NONE) for picture in self.pictures
        )
        first.save(path, save_all=True, append_images=others, duration=self.times, loop=0)
        size = path.stat().st_size / 1e6
        print(f"wrote {path}, {sum(self.times) / 1000:.1f} s, {size:.2f} MB")


def tour() -> None:
    """The README's twelve seconds: open a pair with its setup, Run, a line across the field."""
    with tempfile.TemporaryDirectory() as scratch, chdir(scratch):
        make_pair()
        viewer = new_window("napari")
        film = MovingPicture(viewer)
        viewer.open(["reference.tif", "shot.tif"])
        film.add(1.4)
        tool = open_widget(viewer, "Invert")
        film.add(1.2, tool.image)
        tool.setup.set_kind("proton")
        film.add(1.0, tool.setup)
        tool.setup.form.restore(PROTON_FIELDS)
        tool.setup.changed.emit()
        film.add(1.2, tool.setup.form)
        tool.area.ensureWidgetVisible(tool.panel)
        film.add(0.9, tool.panel.button)
        press_run(tool)
        fit(viewer)
        film.add(2.6)
        analyse = open_widget(viewer, "Analyse")
        analyse.tabs.setCurrentWidget(analyse.products)
        analyse.products.product.set_kind("profile")
        analyse.products._draw()
        analyse.products.shapes.layer.add([[99.5, 20.0], [99.5, 180.0]], shape_type="line")
        analyse.products.shapes.layer.mode = "pan_zoom"
        film.add(1.2, analyse.products.panel.button)
        analyse.products.panel.button.click()
        while analyse.products.panel.running:
            settle(0.2)
        film.add(3.2)
        film.save(HERE / "tour.gif")
        viewer.close()


def proton_windows() -> None:
    """Tutorial: a radiograph from a file, its geometry typed by hand, its caustics."""
    with tempfile.TemporaryDirectory() as scratch, chdir(scratch):
        make_pair()
        viewer = new_window("proton radiograph")
        viewer.open(["shot.tif", "reference.tif"])
        tool = open_widget(viewer, "Invert")
        tool.setup.set_kind("proton")
        fields = tool.setup.form
        fields.restore(PROTON_FIELDS)
        tool.setup.changed.emit()
        photograph(viewer, "tutorial-proton-setup.png", close=False)
        press_run(tool)
        viewer.layers["✓ caustics – shot"].visible = True
        photograph(viewer, "tutorial-proton-field.png")


def source_windows() -> None:
    """Tutorial: an estimated beam, and the field that it gives."""
    viewer = new_window("no reference image", height=880)
    viewer.open_sample(PLUGIN, "four_toroids")
    tool = open_widget(viewer, "Invert")
    tool.source.set_kind("polynomial")
    tool.show_source.click()
    while tool.panel.running:
        settle(0.2)
    settle()
    photograph(viewer, "tutorial-source-estimate.png", close=False)
    press_run(tool)
    for title, text in tool.report.rows:
        print(f"{title}: {text}")
    photograph(viewer, "tutorial-source-field.png")


def night_window() -> None:
    """Tutorial: a run of shots, inverted into a store."""
    viewer = new_window("a night's stack", height=880)
    viewer.open_sample(PLUGIN, "wakefield_run")
    tool = open_widget(viewer, "Invert")
    with tempfile.TemporaryDirectory() as scratch, chdir(scratch):
        tool.steps.add("high-pass")
        tool.store.folder.restore({"path": "night.shadowinv.zarr"})
        press_run(tool)
        print(tool.panel.status.text(), [layer.name for layer in viewer.layers])
        viewer.dims.set_current_step(0, 10)
        settle(3.0)
        viewer.layers["displacement arrows – night"].length = NIGHT_ARROWS
        photograph(viewer, "tutorial-night.png")


def fit_window() -> None:
    """Two films of one toroid: the widget, its verdict and the field."""
    viewer = new_window("two energies", height=860)
    setup = ProtonSetup.example()
    truth = toroid((96, 96), setup, 90.0, 16e-6).displacement
    for seed, energy in enumerate((14.7, 30.0)):
        film = setup.model_copy(update={"energy": energy})
        counts = np.random.default_rng(seed).poisson(1000 * predict_image(truth, setup, film))
        name, metadata = f"{energy:g} MeV", metadata_for("shot", "counts", film)
        viewer.add_image(counts.astype(float), name=name, metadata=metadata)
    widget = open_widget(viewer, "Fit several images")
    widget.source.set_kind("unknown")
    widget.choices.restore({"noise": "poisson"})
    press_run(widget)
    print(widget.view.verdict.text())
    photograph(viewer, "napari-fit.png")


def film_window() -> None:
    """A simulated film pack: the widget, the fluence at one film, and the spectrum of a region."""
    sys.path.insert(0, str(HERE.parents[1] / "benchmarks"))
    from simulated_pack import simulate

    with tempfile.TemporaryDirectory() as scratch, chdir(scratch):
        truth = simulate(Path("eight-films"))
        viewer = new_window("film pack", height=840)
        widget = open_widget(viewer, "Film pack")
        widget.file.restore({"file": str(truth.pack)})
        press_run(widget)
        viewer.dims.set_current_step(0, 4)
        widget._draw_region()
        height, width = truth.scene.shape
        region = [[0.55 * height, 0.1 * width], [0.9 * height, 0.4 * width]]
        widget.regions.layer.add_rectangles(region)
        widget.regions.layer.mode = "pan_zoom"
        viewer.layers.selection.active = widget.packs.layer
        photograph(viewer, "napari-film.png")


def real_film_windows(data: Path) -> None:
    """Tutorial: the real pack, and the corners of a film on its scan."""
    with tempfile.TemporaryDirectory() as scratch, chdir(scratch):
        folder = Path("shot-019")
        folder.mkdir()
        pack = pack_of_page(folder, data)
        viewer = new_window("seventeen films", height=840)
        widget = open_widget(viewer, "Film pack")
        widget.file.restore({"file": str(pack)})
        press_run(widget)
        viewer.dims.set_current_step(0, 6)
        viewer.layers.selection.active = widget.packs.layer
        photograph(viewer, "tutorial-film-run.png", close=False)
        widget.show_corners.click()
        settle()
        photograph(viewer, "tutorial-film-corners.png")


def two_energies_window() -> None:
    """Tutorial: the sample at two energies, fitted with its beam."""
    viewer = new_window("two energies instead of a reference beam", height=880)
    viewer.open_sample(PLUGIN, "two_energies")
    widget = open_widget(viewer, "Fit several images")
    widget.source.set_kind("unknown")
    widget.choices.restore({"noise": "poisson"})
    press_run(widget)
    print(widget.view.verdict.text())
    widget.area.verticalScrollBar().setValue(0)
    photograph(viewer, "tutorial-two-energies.png")


def photograph_menus(viewer: napari.Viewer, name: str, *titles: str) -> None:
    """Save the upper left of the window with the entries of some submenus of *Layers* unfolded."""
    window = viewer.window._qt_window
    window.move(0, 0)
    settle()
    pictures = []
    for title in titles:
        menu = viewer.window.layers_menu
        menu.popup(viewer.window.main_menu.mapToGlobal(QPoint(MENU_X, MENU_Y)))
        settle()
        (entry,) = [each for each in menu.actions() if each.text().replace("&", "") == title]
        menu.setActiveAction(entry)
        entry.menu().popup(menu.mapToGlobal(menu.actionGeometry(entry).topRight()))
        settle()
        image = QApplication.primaryScreen().grabWindow(0, 0, 0, *MENU_PICTURE).toImage()
        pixels = image.convertToFormat(QImage.Format.Format_RGB888)
        stride, height = pixels.bytesPerLine(), pixels.height()
        rows = np.frombuffer(pixels.constBits().asarray(stride * height), np.uint8)
        pictures.append(rows.reshape(height, stride)[:, : 3 * pixels.width()])
        entry.menu().close()
        menu.close()
    stack = np.concatenate(pictures).reshape(-1, MENU_PICTURE[0], 3)
    Image.fromarray(stack).quantize(256).save(HERE / name, optimize=True)
    print(f"wrote {HERE / name} {stack.shape[1]}×{stack.shape[0]}")


def menus_window() -> None:
    """The menus with entries of the plugin."""
    viewer = new_window("menus", height=560)
    viewer.open_sample(PLUGIN, "toroid")
    settle()
    photograph_menus(viewer, "napari-menus.png", "Filter", "Transform")
    viewer.close()


def preferences_window() -> None:
    """The plugin's page of napari's preferences."""
    viewer = new_window("preferences")
    dialog = PreferencesDialog(viewer.window._qt_window)
    rows = [dialog._list.item(row).text() for row in range(dialog._list.count())]
    dialog._list.setCurrentRow(rows.index("Shadowinv"))
    dialog.resize(1065, 620)
    dialog.show()
    settle(2.0)
    path = HERE / "napari-preferences.png"
    dialog.grab().save(str(path))
    Image.open(path).convert("RGB").quantize(256).save(path, optimize=True)
    print(f"wrote {path}")
    dialog.close()
    viewer.close()


def make_as_new_user(make: Callable[[], None]) -> None:
    """Make pictures with widgets that remember nothing, and change no settings of one's own."""
    with tempfile.TemporaryDirectory() as settings:
        QSettings.setPath(QSettings.Format.IniFormat, QSettings.Scope.UserScope, settings)
        napari.settings._clear_plugin_settings_cache()
        napari.settings._CFG_PATH = f"{settings}/settings.yaml"
        make()


def frames(folder: Path) -> list[Path]:
    return sorted(folder.glob("Image_2*.bmp"))[:FRAMES]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="windows; all of them without a name")
    parser.add_argument("--data", type=Path, default=HERE.parents[2] / "shared" / "data")
    options = parser.parse_args()
    HERE.mkdir(exist_ok=True)
    burner, films = options.data / "burner" / "data", options.data / "rcf"
    of_data = {
        "burner": (frames(burner), lambda: stack_window(burner)),
        "real-film": (films.is_dir(), lambda: real_film_windows(films)),
    }
    for name, make in WINDOWS.items():
        if not options.names or name in options.names:
            make_as_new_user(make)
    for name, (there, make) in of_data.items():
        if options.names and name not in options.names:
            continue
        if there:
            make_as_new_user(make)
        else:
            print(f"no data for {name} in {options.data}: its pictures are left out")


WINDOWS = {
    "toroid": toroid_window,
    "tour": tour,
    "first": first_windows,
    "proton": proton_windows,
    "source": source_windows,
    "night": night_window,
    "fit": fit_window,
    "film": film_window,
    "two-energies": two_energies_window,
    "menus": menus_window,
    "preferences": preferences_window,
}

if __name__ == "__main__":
    main()
