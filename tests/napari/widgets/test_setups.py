"""The setup of an image: its form, whose it is, and where it came from."""

import numpy as np
import pytest
from napari.layers import Image

from helpers.forms import enter
from helpers.image_files import save_pradformat
from napari_shadowinv import ProtonSetup
from napari_shadowinv._napari.layer_metadata import (
    metadata_for,
    role_of,
    setup_of,
    setup_origin_of,
    source_of,
)
from napari_shadowinv._napari.layers import add_to_viewer
from napari_shadowinv._napari.simulate import Simulate
from napari_shadowinv._napari.widgets._inputs import SetupPicker, fields_of
from napari_shadowinv._napari.widgets.fit_images import ImageTable
from napari_shadowinv._napari.widgets.invert import Invert
from napari_shadowinv.io import read_shot


@pytest.fixture
def plain(viewer, shot):
    """A shot that napari itself has opened."""
    return viewer.add_image(shot, name="plain")


@pytest.fixture
def picker(qtbot):
    widget = SetupPicker("test")
    qtbot.addWidget(widget)
    return widget


def typed(tool, energy):
    """Type a whole setup, field by field."""
    tool.setup.set_kind("proton")
    lengths = {"source_object_distance": 0.01, "object_image_distance": 1.0, "pixel_size": 2e-6}
    for name, value in {"energy": energy, **lengths}.items():
        enter(tool.setup.form.entries[name], value)


def test_a_setup_stays_with_the_image_that_it_came_with(viewer, opened, plain, shot, proton_setup):
    origin = {"setup_origin": "came with experiment.h5"}
    metadata = metadata_for("shot", "", proton_setup, **origin)
    of_a_file = viewer.add_image(shot, name="measured", metadata=metadata)
    tool = opened(Invert)
    for _ in range(2):
        tool.image.layer = of_a_file
        assert tool.setup.setup() == proton_setup
        assert tool.setup.note.text() == "Came with experiment.h5."
        tool.image.layer = plain
        assert tool.setup.setup() is None
        assert tool.setup.note.text() == ""
    # Nor is it at hand in the form, now or in the next session.
    tool.setup.set_kind("proton")
    assert tool.setup.form.is_empty
    tool.image.layer = of_a_file
    enter(tool.setup.form.entries["energy"], "3 MeV")
    assert setup_origin_of(of_a_file) == "came with experiment.h5, changed by hand"
    viewer.layers.clear()
    viewer.add_image(shot, name="another")
    later = opened(Invert)
    assert later.setup.setup() is None
    later.setup.set_kind("proton")
    assert later.setup.form.is_empty


def test_what_the_user_typed_is_at_hand_and_says_for_what(viewer, opened, plain, shot):
    tool = opened(Invert)
    typed(tool, 5.0)
    entered = tool.setup.setup()
    assert entered.pixel_size == pytest.approx(2e-6)
    assert setup_of(plain) == entered
    image = viewer.add_image(shot, name="other")
    tool.image.layer = image
    assert tool.setup.setup() is None
    assert setup_of(image) is None
    tool.setup.set_kind("proton")
    assert tool.setup.setup() == entered
    assert tool.setup.note.text() == "Typed for 'plain'."
    assert setup_origin_of(image) == "typed for 'plain'"
    # An image keeps what was chosen for it, none too.
    tool.image.layer = plain
    tool.setup.set_kind("none")
    tool.image.layer = image
    assert tool.setup.setup() == entered
    tool.image.layer = plain
    assert tool.setup.setup() is None

    viewer.layers.clear()
    new = viewer.add_image(shot, name="new")
    later = opened(Invert)
    assert later.setup.setup() is None
    later.setup.set_kind("proton")
    assert later.setup.setup() == entered
    assert setup_origin_of(new) == "typed for 'plain', in an earlier session"
    typed(later, 6.0)
    assert setup_origin_of(new) == "typed for 'new'"


def test_the_last_setup_is_selected_where_that_is_preferred(
    viewer, opened, plain, shot, preferences
):
    preferences.widgets.last_setup = True
    tool = opened(Invert)
    assert tool.setup.setup() is None  # there is no last one
    typed(tool, 5.0)
    entered = tool.setup.setup()
    viewer.layers.clear()
    new = viewer.add_image(shot, name="new")
    later = opened(Invert)
    assert later.setup.setup() == entered
    assert later.setup.note.text() == "Typed for 'plain', in an earlier session."
    # The image has no setup of its own before it is edited.
    assert setup_of(new) is None
    # None is a choice, too.
    later.setup.set_kind("none")
    assert opened(Invert).setup.setup() is None
    later.setup.set_kind("proton")
    preferences.widgets.last_setup = False
    viewer.layers.clear()
    viewer.add_image(shot, name="newest")
    assert opened(Invert).setup.setup() is None


def test_a_loaded_setup_goes_with_the_image_until_run(viewer, opened, plain, proton_setup):
    tool = opened(Invert)
    tool.setup.load(proton_setup.model_dump(exclude_none=True), "folder/tcc.toml")
    assert tool.setup.setup() == proton_setup
    assert tool.setup.note.text() == "Loaded from tcc.toml."
    enter(tool.setup.form.entries["energy"], 5.0)
    second = viewer.add_image(np.ones((20, 30)), name="other")
    tool.image.layer = second
    assert tool.setup.setup().energy == 5.0
    tool.request()
    assert setup_of(plain) is None
    assert setup_of(second).energy == 5.0
    assert setup_origin_of(second) == "loaded from tcc.toml, changed by hand"
    assert tool.setup.note.text() == "Loaded from tcc.toml, changed by hand."
    # From then on it is the setup of this image only.
    tool.image.layer = plain
    assert tool.setup.setup() is None


def test_other_files_do_not_inherit_a_setup(viewer, opened):
    tool = opened(Invert)
    tool.image.set_kind("files")
    typed(tool, 5.0)
    tool.image.form.restore({"path": "monday/*.tif"})
    assert tool.setup.setup() is not None
    tool.image.form.restore({"path": "tuesday/*.tif"})
    assert tool.setup.setup() is None
    tool.setup.set_kind("proton")
    assert tool.setup.setup() is not None
    assert tool.setup.origin == "typed"


def test_a_forward_model_takes_the_setup_of_a_potential_and_gives_it_back(
    viewer, opened, solved, proton_setup, run
):
    tool = opened(Simulate)
    assert tool.setup.setup() == ProtonSetup.example()
    assert tool.setup.note.text() == "Example from the paper."
    typed(tool, 7.0)
    entered = tool.setup.setup()
    add_to_viewer(viewer, solved, proton_setup, name="solved")
    tool.object.set_kind("layer")
    assert tool.setup.setup() == proton_setup
    tool.object.set_kind("toroid")
    assert tool.setup.setup() == entered
    later = opened(Simulate)
    assert later.setup.setup() == entered
    tool.side.setText("20 x 20")
    run(tool)
    (prediction,) = tool.results.layers
    assert role_of(prediction) == "shot"
    assert setup_of(prediction) == entered
    assert setup_origin_of(prediction).startswith("came with the forward model")
    assert source_of(prediction) is None
    # Opened in Invert, it is a file's setup like any other.
    assert opened(Invert).setup.setup() == entered


def test_the_form_shows_geometry_and_doubts(viewer, opened, plain, picker):
    tool, paper = opened(Invert), ProtonSetup.example()
    for setup, view in ((picker, "pixel 1.5 µm"), (tool.setup, "90 × 72 µm")):
        setup.show_setup(paper.model_dump())
        assert setup.geometry_label.text().startswith(f"{view} at the object, M = 16.4")
    doubt = tool.setup.warning_label
    assert doubt.text() == ""
    tool.setup.show_setup({**paper.model_dump(), "energy": 147.0})
    assert "147 MeV" in doubt.text()
    swapped = {"source_object_distance": 1.0, "object_image_distance": 0.01}
    tool.setup.show_setup({**paper.model_dump(), **swapped})
    assert "the magnification is 1.01" in doubt.text()


def test_sizes_in_the_file_complete_a_setup(tmp_path, picker):
    path = tmp_path / "shot.h5"
    save_pradformat(path, np.ones((8, 9)), pixel_width=2.5e-05, object_image_dist=0.1)
    geometry = read_shot(path).metadata["geometry"]
    assert geometry["detector_pixel_size"] == 2.5e-5
    metadata = metadata_for("shot", "", file={"geometry": geometry})
    picker.follow(Image(np.ones((8, 9)), name="shot", metadata=metadata))
    # A setup file needs not repeat it, and is not overruled.
    entries = {"kind": "proton", "energy": 14.7, "source_object_distance": 0.01}
    picker.load(entries, "setup.toml")
    assert picker.setup().detector_pixel_size == 2.5e-5
    picker.load({**entries, "pixel_size": 3e-6}, "setup.toml")
    assert picker.setup().detector_pixel_size is None
    assert picker.setup().pixel_size == 3e-6


def test_a_further_kind_has_its_form_fields_and_column(xray_setup, viewer, picker, qtbot):
    """That of CONTRIBUTING.md."""
    picker.show_setup(xray_setup.example().model_dump())
    assert picker.kind == "x-ray"
    assert picker.setup() == xray_setup.example()
    assert fields_of("x-ray") == {"electrons": ("electron density (phase ∝ λ²)", None)}
    viewer.add_image(np.ones((8, 8)), name="soft")
    table = ImageTable(viewer, lambda layer: True)
    qtbot.addWidget(table)
    table.show_beams("x-ray", 8.0)
    assert table.horizontalHeaderItem(1).text() == "Energy (keV)"
    assert table.item(0, 1).text() == "8"
