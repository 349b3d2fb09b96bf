"""Mistakes of a user, window by window: one sentence, in a notification and below the button."""

import shutil

import numpy as np
import pytest
from qtpy.QtCore import Qt

from napari_shadowinv import OpticalSetup, ProtonSetup
from napari_shadowinv._napari import jobs
from napari_shadowinv._napari.layer_metadata import metadata_for
from napari_shadowinv._napari.layers import add_to_viewer
from napari_shadowinv._napari.simulate import Simulate
from napari_shadowinv._napari.widgets.analyse import Analyse
from napari_shadowinv._napari.widgets.film_pack import FilmPack
from napari_shadowinv._napari.widgets.fit_images import FitImages
from napari_shadowinv._napari.widgets.invert import Invert

FLAT = np.ones((20, 20))
EXAMPLE = ProtonSetup.example()


def of_a_shot(tool, viewer):
    yield "no image"
    grey = {"contrast_limits": (0, 1)}
    for words, data, how in (
        ("colour", np.ones((20, 20, 3)), {"rgb": True}),
        ("o store is selected", np.ones((3, 20, 20)), grey),
        ("NaN", np.nan * FLAT, grey),
    ):
        viewer.layers.clear()
        viewer.add_image(data, **how)
        yield words
    viewer.layers.clear()
    viewer.add_image(FLAT, name="shot")
    tool._draw_crop()
    tool.crop.layer.add_rectangles(np.array([[500, 500], [500, 600], [600, 600], [600, 500]]))
    yield "0 × 0 pixels"
    tool.crop.layer = None
    tool.source.set_kind("file")
    yield "o source file"


def of_many_shots(tool, viewer, folder):
    out = folder / "run.shadowinv.zarr"
    tool.store.folder.restore({"path": str(out)})
    (folder / "notes.txt").write_text("no folder")
    (folder / "pack.csv").write_text("file,energy\nfilm0.npy,9\n")
    np.save(folder / "film0.npy", FLAT)
    for kind, path, words in (
        ("files", "", "o files are selected"),
        ("folder", folder / "nowhere", "does not exist: expected a folder to watch"),
        ("folder", folder / "notes.txt", "expected a folder to watch"),
        ("folder", "", "o folder is selected"),
        ("table", folder / "pack.csv", "has an energy of 9 MeV and no setup"),
        ("table", "", "o table is selected"),
        ("table", "/no/pack.csv", "/no/pack.csv does not exist: expected a .csv file"),
        ("table", folder / "film0.npy", "film0.npy is no table: expected a .csv file"),
        ("table", folder, f"{folder} is no table: expected a .csv file"),
    ):
        tool.image.set_kind(kind)
        tool.image.form.restore({"path": str(path)})
        yield words
    assert not list(folder.glob("*.zarr"))


def of_a_fit(tool, viewer):
    def check(row, state=Qt.CheckState.Checked):
        tool.images.item(row, 0).setCheckState(state)

    shape, rng = (32, 40), np.random.default_rng(0)
    for name in ("one", "two"):
        viewer.add_image(rng.normal(1, 0.01, shape), name=name)
    yield "here is no setup"
    tool.setup.show_setup(EXAMPLE.model_dump())
    for row, words in ((1, "1 image is checked"), (0, "No images are checked")):
        check(row, Qt.CheckState.Unchecked)
        yield words
    check(0)
    check(1)
    for text, words in (
        ("fast", "nergy of 'two': received 'fast', expected a number in MeV"),
        ("-2", "he setup of 'two': 'Energy' is -2"),
    ):
        tool.images.item(1, 1).setText(text)
        yield words
    tool.images.item(1, 1).setText("6")
    viewer.add_image(np.ones((16, 20)), name="crop", metadata=metadata_for("shot", "", EXAMPLE))
    check(2)
    yield "'crop' has shape (16, 20), 'one' (32, 40)"
    check(2, Qt.CheckState.Unchecked)
    # What only the fit itself can see.
    viewer.layers["two"].data = np.full(shape, np.nan)
    yield "'two' has 1280 pixels that are NaN"
    viewer.layers["two"].data = viewer.layers["one"].data.copy()
    yield "'one' and 'two' are the same: give each image once"


def of_a_film_pack(tool, viewer, film_pack, folder):
    yield "No pack is selected"
    for path in (film_pack.pack, film_pack.folder / "HDV2.csv", film_pack.folder / "unexposed.tif"):
        shutil.copy(path, folder)
    tool.file.restore({"file": str(folder / film_pack.pack.name)})
    yield "film_01.tif does not exist"


def of_an_object(tool, viewer, folder):
    tool.object.set_kind("layer")
    yield "here is no result to start from"
    tool.object.set_kind("wakefield")
    assert tool.setup.setup() == OpticalSetup.example()
    tool.setup.set_kind("none")
    yield "select the setup 'light'"
    tool.object.set_kind("toroid")
    tool.task.set_kind("plan")
    for energies, size, words in (
        ("3; 15", "64 x 64", "'Energies' is '3; 15'"),
        ("", "64", "'Size (px)' is '64'"),
    ):
        tool.energies.setText(energies)
        tool.side.setText(size)
        yield words


def of_a_product(tool, viewer, solved):
    def choose(product, adds="", corners=()):
        tool.product.set_kind(product)
        if tool.product.kind != product:
            tool.product.set_kind("more")
            tool.more_products.set_kind(product)
        tool._draw()
        if adds:
            getattr(tool.shapes.layer, adds)(np.array(corners))

    yield "There is no result to measure"
    add_to_viewer(viewer, solved, EXAMPLE)
    tool.product.set_kind("flux")
    yield "There is no line or path for the flux across a line"
    choose("current", "add_lines", [[3.0, 3.0], [9.0, 9.0]])
    yield "There is no closed shape, such as an ellipse, for the"
    choose("azimuthal", "add_rectangles", [[5.0, 5.0], [15.0, 25.0]])
    yield "is no circle"


@pytest.mark.parametrize(
    ("kind", "mistakes", "names"),
    [
        (Invert, of_a_shot, ()),
        (Invert, of_many_shots, ("folder",)),
        (FitImages, of_a_fit, ()),
        (FilmPack, of_a_film_pack, ("film_pack", "folder")),
        (Simulate, of_an_object, ("folder",)),
        (Analyse, of_a_product, ("solved",)),
    ],
)
def test_a_mistake_is_one_sentence_and_leaves_nothing(
    request, opened, viewer, refused, tmp_path, kind, mistakes, names
):
    values = {n: tmp_path if n == "folder" else request.getfixturevalue(n) for n in names}
    tool = opened(kind)
    tool = getattr(tool, "products", tool)
    for words in mistakes(tool, viewer, **values):
        refused(tool, words)


def test_it_is_seen_below_the_button(window, open_widget, refused):
    tool = open_widget("Invert")
    refused(tool, "no image")
    status, button = tool.panel.status, tool.panel.button
    assert not status.visibleRegion().isEmpty()
    assert status.geometry().top() > button.geometry().bottom()
    assert status.wordWrap()
    assert status.textInteractionFlags() & Qt.TextInteractionFlag.TextSelectableByMouse


def test_a_fault_of_the_program_is_told_once(viewer, opened, wait, messages, monkeypatch):
    def broken(*_, **__):
        raise ZeroDivisionError("a fault of the program's")

    monkeypatch.setattr(jobs, "run", broken)
    viewer.add_image(FLAT)
    tool = opened(Invert)
    tool.panel.button.click()
    wait(lambda: bool(messages) and not tool.panel.running)
    assert len(messages) == 1
    for text in (messages[0], tool.panel.status.text()):
        assert "a fault of the program's" in text
    assert (tool.panel.button.text(), tool.panel.button.isEnabled()) == ("Run", True)
