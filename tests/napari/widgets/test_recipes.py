"""Recipes: the list of steps, the placement of results, and files for window and command."""

import shlex

import numpy as np
import pytest
from napari.components import ViewerModel
from qtpy.QtWidgets import QApplication

from helpers.command_line import done, undrawn
from helpers.forms import enter
from helpers.jobs import run_job
from helpers.layers import layer_of
from helpers.results import provenance_in
from napari_shadowinv import InputError, Instrument, InversionOptions, read, write
from napari_shadowinv._napari.form import StepsSection
from napari_shadowinv._napari.layer_metadata import frame_of, metadata_for, role_of, setup_origin_of
from napari_shadowinv._napari.layers import add_to_viewer
from napari_shadowinv._napari.widgets import _files
from napari_shadowinv._napari.widgets.invert import Invert
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.io.store import read_stack
from napari_shadowinv.pipeline import read_recipe, write_recipe
from napari_shadowinv.pipeline import run as run_recipe
from napari_shadowinv.preprocessing import (
    STEPS,
    Bin,
    Crop,
    HotPixelFilter,
    LowPassFilter,
    MeasuredSource,
    PolynomialEstimate,
    Recipe,
    Rotate,
    UniformEstimate,
)
from napari_shadowinv.provenance import Provenance

FEW = InversionOptions(n_sites=300)


@pytest.fixture
def opened(opened):
    """Make a widget of a class, with few sites."""

    def make(kind=Invert):
        widget = opened(kind)
        widget.options.restore({"n_sites": 300})
        return widget

    return make


@pytest.fixture
def shot_file(shot, tmp_path):
    np.save(tmp_path / "shot.npy", shot)
    return tmp_path / "shot.npy"


@pytest.fixture
def image(viewer, shot_file):
    """The shot as a layer, read from its file."""
    (layer,) = viewer.open(str(shot_file), plugin="napari")
    return layer


def by_command(*arguments, out):
    """Run the command, and return the inversion that it writes."""
    done = undrawn(*arguments, "--out", out)
    assert done.exit_code == 0, done.output
    return Inversion.from_dataset(read(out))


def test_steps_are_added_moved_and_removed(qtbot):
    section = StepsSection()
    qtbot.addWidget(section)
    changes = []
    section.changed.connect(lambda: changes.append(None))
    assert section.folded.text() == "Steps: none"
    assert not section.folded.isExpanded()
    assert section.choice.choices == ("", *STEPS)
    for name in ("low-pass", "bin"):
        section.choice.value = name
    first, second = section.forms
    assert section.folded.text() == "Steps: low-pass (smooth), bin"
    assert set(second.form.entries) == {"factor"}
    enter(second.form.entries["factor"], 3)
    assert not first.up.isEnabled()
    second.up.click()
    assert section.steps() == (Bin(factor=3), LowPassFilter(width=1.0))
    assert section.forms == [second, first]
    assert not second.up.isEnabled()
    assert not first.down.isEnabled()
    second.folded.toggleButton().click()
    assert not second.folded.isExpanded()
    second.remove.click()
    first.remove.click()
    assert section.folded.text() == "Steps: none"
    assert section.steps() == ()
    assert len(changes) >= 6
    section.show_steps([Bin(factor=3)])
    assert section.steps() == (Bin(factor=3),)
    rows = section.add("crop").form.entries["y"]
    for text, rows_used in (("10:40", (10, 40)), ("10:", (10, None)), ("", (0, None))):
        enter(rows, text)
        assert section.steps()[1] == Crop(y=rows_used)
    enter(rows, "ten")
    with pytest.raises(InputError, match="such as 10:200"):
        section.steps()


PLACED = {
    "upright": {},
    "turned": {
        "rotate": 30, "shear": [0.2], "scale": (2, 3), "translate": (7, -4),
        "affine": [[1, 0.1, 5], [0, 1.2, 6], [0, 0, 1]],
    },
}  # fmt: skip


@pytest.mark.parametrize("place", PLACED)
@pytest.mark.parametrize(
    "steps",
    [
        (Bin(factor=3),),
        (Crop(y=(4, 40), x=(10, 57)),),
        (Rotate(angle=90),),
        (Rotate(angle=90), Crop(y=(3, None)), Bin(factor=2), Rotate(angle=180)),
    ],
)
def test_a_result_lies_on_its_image_after_all_steps(viewer, steps, place):
    image = viewer.add_image(np.ones((48, 60)), **PLACED[place])
    recipe = Recipe(steps=steps)
    matrix = recipe.matrix((48, 60))
    frame = frame_of(image).beneath(matrix)
    result = viewer.add_image(np.ones(recipe.shape_after((48, 60))), **frame.keywords())
    stacked = viewer.add_image(np.ones((2, 9, 9)), **frame.keywords(stacked=True))
    for y, x in ((0.0, 0.0), (11.0, 4.0), (3.0, 17.0)):
        expected = image.data_to_world((matrix @ [y, x, 1.0])[:2])
        np.testing.assert_allclose(result.data_to_world((y, x)), expected, atol=1e-9)
        np.testing.assert_allclose(stacked.data_to_world((1, y, x))[1:], expected, atol=1e-9)
    assert frame_of(image).beneath(np.eye(3)) == frame_of(image)


def test_a_result_of_larger_pixels_is_in_the_units_of_these(
    viewer, opened, run, image, shot, proton_setup
):
    tool = opened()
    tool.setup.show_setup(proton_setup.model_dump())
    tool.steps.show_steps((Bin(factor=2),))
    run(tool)
    recipe = Recipe(steps=(Bin(factor=2),), setup=proton_setup, options=FEW)
    alone = run_recipe(recipe, shot)
    fresh = ViewerModel()
    add_to_viewer(fresh, alone)
    mine, expected = (layer_of(each, "field") for each in (viewer, fresh))
    assert mine.name.replace(" – shot", "") == expected.name
    np.testing.assert_allclose(mine.data, expected.data)


@pytest.fixture
def filled(opened, image, proton_setup):
    """*Invert* with a crop, further steps, an estimated source and a setup."""
    tool = opened()
    tool._draw_crop()
    tool.crop.layer.add_rectangles(np.array([[4, 10], [4, 57], [43, 57], [43, 10]]))
    tool.steps.show_steps((HotPixelFilter(threshold=9.0), Bin(factor=2)))
    tool.source.show(PolynomialEstimate(degree=1))
    tool.setup.show_setup(proton_setup.model_dump())
    return tool


def paint(masks, *pixels):
    masks.paint()
    masks.layer.data[pixels] = 1


def test_the_command_does_what_the_window_saves(filled, image, run, shot_file, tmp_path):
    paint(filled.masks, np.s_[6:9], np.s_[12:15])
    paint(filled.source_masks, np.s_[12:30], np.s_[22:45])
    mine = run(filled)
    for layer in filled.results.layers:  # they lie on the image
        np.testing.assert_allclose(layer.data_to_world((0, 0)), image.data_to_world((4.5, 10.5)))
    filled.recipes.save(tmp_path / "how.toml")
    assert filled.panel.status.text() == f"Saved the recipe in {tmp_path / 'how.toml'}"
    written = {path.name for path in tmp_path.glob("how*")}
    assert written == {"how.toml", "how_mask.png", "how_source_mask.png"}
    recipe, out = tmp_path / "how.toml", tmp_path / "a.shadowinv"
    reloaded = by_command("invert", shot_file, "--recipe", recipe, out=out)
    np.testing.assert_array_equal(reloaded.displacement, mine.displacement)
    of_command, of_window = reloaded.provenance, mine.provenance
    assert of_command.recipe == of_window.recipe
    assert of_command.image.sha256 == of_window.image.sha256
    assert of_command.setup == of_window.setup
    pixels = [[mask.mask() for mask in each.masks] for each in (of_command, of_window)]
    np.testing.assert_array_equal(*pixels)


def test_copied_lines_make_the_same_result(filled, run, tmp_path):
    clipboard = QApplication.clipboard()
    clipboard.setText("")
    mine = run(filled)
    python, command = filled.recipes.menu().actions()[2:4]
    command.trigger()
    done(*shlex.split(clipboard.text())[1:], "--out", tmp_path / "by.shadowinv")
    by_command = read(tmp_path / "by.shadowinv")
    np.testing.assert_array_equal(by_command.displacement, mine.displacement)
    assert provenance_in(by_command).setup == mine.provenance.setup
    python.trigger()
    lines, names = clipboard.text(), {}
    assert len(lines.splitlines()) <= 8
    exec(lines, names)
    np.testing.assert_array_equal(names["inversion"].displacement, mine.displacement)
    assert names["recipe"] == mine.provenance.recipe
    assert names["inversion"].setup == mine.provenance.setup
    clipboard.setText("")
    paint(filled.masks, np.s_[6:9], np.s_[12:15])
    python.trigger()  # a mask in no file
    assert clipboard.text() == ""


def test_the_selected_result_is_repeated_from_its_files(
    viewer, opened, image, shot_file, run, wait, monkeypatch
):
    said = []
    monkeypatch.setattr(_files, "show_info", said.append)
    tool = opened(Invert)
    tool.options.restore({"n_sites": 200})
    tool.recipes.repeat()
    assert not tool.panel.running  # the image is no result
    run(tool)
    field = layer_of(viewer, "field")
    viewer.layers.selection.active = field
    tool.recipes.repeat()
    wait(lambda: bool(said))
    assert said == ["Difference: none: the same result, bit for bit. Changed: nothing"]
    first, second = [layer for layer in viewer.layers if role_of(layer) == "field"]
    assert second.name == first.name.replace("shot", "shot repeated")
    np.testing.assert_array_equal(first.data, second.data)
    np.testing.assert_array_equal(first.affine.affine_matrix, second.affine.affine_matrix)

    np.save(shot_file, 2 + np.load(shot_file))
    viewer.layers.selection.active = first
    tool.recipes.repeat()
    wait(lambda: len(said) == 2)
    assert f"the image {shot_file.name} differs" in said[1]


def test_the_window_does_what_the_command_saves(
    viewer, opened, image, shot, shot_file, tmp_path, proton_setup
):
    np.save(tmp_path / "beam.npy", 300 + 20 * np.linspace(0, 1, shot.shape[1]) + 0 * shot)
    (tmp_path / "setup.toml").write_text(
        'kind = "proton"\nenergy = 14.7\nsource_object_distance = 0.01\n'
        "object_image_distance = 1.0\npixel_size = 2e-6\n"
    )
    reloaded = by_command(
        "invert", shot_file, "--step=crop y=4:44 x=10:", "--bin", 2, "--step=low-pass 1.5",
        "--source", tmp_path / "beam.npy", "--setup", tmp_path / "setup.toml",
        "--set=options.n_sites=300", "--save-recipe", tmp_path / "how.toml",
        out=tmp_path / "a.shadowinv",
    )  # fmt: skip
    tool = opened()
    tool.recipes.load(tmp_path / "how.toml")
    assert tool.crop.layer.name == "crop – shot"
    assert tool.steps.steps() == (Bin(factor=2), LowPassFilter(width=1.5))
    assert tool.setup.setup().pixel_size == 2e-6
    tool.request()
    assert setup_origin_of(image) == "loaded from how.toml"
    mine = run_job(tool.request())
    np.testing.assert_array_equal(mine.displacement, reloaded.displacement)
    assert mine.provenance.recipe.steps[0] == Crop(y=(4, 44), x=(10, 60))
    assert mine.provenance.image.source.file == "beam.npy"
    assert mine.provenance.image.source.shape == shot.shape


def test_a_recipe_comes_back_from_its_file(viewer, opened, image, shot, tmp_path):
    tool = opened()
    recipe = Recipe(
        steps=(Bin(factor=2), Crop(x=(3, None)), Rotate(angle=-90)),
        source=MeasuredSource(file=tmp_path / "beams.h5", variable="second"),
        options=InversionOptions(n_sites=120, floor=2e-3),
        instrument=Instrument(detector="film", beam_source="TNSA", gamma=0.2, noise_correlation=1),
    )
    write_recipe(tmp_path / "in.toml", recipe)
    tool.recipes.load(tmp_path / "in.toml")
    assert tool.crop.layer is None
    tool.recipes.save(tmp_path / "out.toml")
    assert read_recipe(tmp_path / "out.toml") == recipe
    assert not list(tmp_path.glob("out_*"))
    # Another one leaves nothing of it behind.
    tool.masks.paint()
    write_recipe(tmp_path / "plain.toml", Recipe())
    tool.recipes.load(tmp_path / "plain.toml")
    assert tool.recipe() == Recipe(source=UniformEstimate())
    assert tool.masks.layer is None


def test_a_stack_is_inverted_by_a_saved_recipe(viewer, opened, shot, tmp_path, run):
    usable = np.ones(shot.shape, bool)
    usable[:4, :6] = False
    recipe = Recipe(steps=(Crop(y=(2, 46)), Bin(factor=2)), mask=tmp_path / "mask.png", options=FEW)
    write(tmp_path / "mask.png", usable.astype(float))
    write_recipe(tmp_path / "how.toml", recipe)
    stack = viewer.add_image(np.stack([shot, shot[::-1]]), name="shots", scale=(1, 2, 2))
    tool = opened()
    tool.recipes.load(tmp_path / "how.toml")
    assert tool.steps.steps() == recipe.steps
    tool.store.folder.restore({"path": str(tmp_path / "a.shadowinv.zarr")})
    run(tool)
    alone = run_recipe(recipe, shot[::-1])
    dataset = read_stack(tmp_path / "a.shadowinv.zarr")
    displacement = dataset["displacement"].values[1]
    np.testing.assert_allclose(displacement, alone.displacement, atol=1e-5)
    field = layer_of(viewer, "field")
    assert field.data.shape == (2, 22, 30)
    np.testing.assert_allclose(field.data_to_world((1, 0, 0)), stack.data_to_world((1, 2.5, 0.5)))
    provenance = Provenance.of(dataset.attrs, dataset.variables)
    assert provenance is not None
    np.testing.assert_array_equal(provenance.masks[0].mask(), usable)


NOT_SHOWN = (
    ("[[steps]]\nstep = 'binn'\n", "did you mean 'bin'"),
    ("mask = 'small.png'\n", "mask has shape (9, 9), image (48, 60)"),
    ("mask = 'gone.png'\n", "gone.png"),
    ("[[steps]]\nstep = 'crop'\ny = '3:4'\n", "contains 60 × 1 pixels"),
    ("[source]\nmethod = 'measured'\n", "the shot's file"),
    ("steps = [\n", "toml"),
)


def test_a_recipe_that_cannot_be_shown_changes_nothing(opened, image, tmp_path, refused):
    tool = opened()
    tool.steps.add("bin")
    before = tool.recipe()
    write(tmp_path / "small.png", np.eye(9))
    path = tmp_path / "how.toml"
    for text, words in NOT_SHOWN:
        path.write_text(text)
        refused(tool, words, lambda: tool.recipes.load(path))
        assert tool.recipe() == before


def test_the_menu_asks_for_a_file_and_replaces_none_beside_it(
    viewer, opened, image, tmp_path, choose, refused
):
    choose(tmp_path / "how.toml")
    tool = opened()
    load, save, *_ = tool.recipes.menu().actions()
    assert (load.text(), save.text()) == ("Load recipe…", "Save…")
    tool.steps.add("bin")
    paint(tool.masks, np.s_[2:4])
    (tmp_path / "how_mask.png").write_text("somebody's")
    refused(tool, "how_mask.png exists", save.trigger)
    assert not (tmp_path / "how.toml").exists()
    assert (tmp_path / "how_mask.png").read_text() == "somebody's"
    tool.masks.layer = None
    beam = viewer.add_image(image.data + 9.0, name="beam", metadata=metadata_for("source", ""))
    tool.source.layer = beam
    save.trigger()
    tool.steps.show_steps(())
    load.trigger()
    assert tool.steps.steps() == (Bin(),)
    # A source that is in no file is written beside the recipe.
    assert tool.recipe().source == MeasuredSource(file=tmp_path / "how_source.npy")
    np.testing.assert_array_equal(np.load(tmp_path / "how_source.npy"), beam.data)
