"""The manifest, and the imports that it causes."""

from importlib.metadata import entry_points
from pathlib import Path

import napari_shadowinv
from napari_shadowinv.io import formats

ROOT = Path(napari_shadowinv.__file__).parent


def test_it_is_valid_and_each_command_can_be_imported(manifest):
    manifest.validate_imports()
    assert manifest.name == "napari-shadowinv"
    (entry,) = entry_points(group="napari.manifest", name=manifest.name)
    assert entry.value == "napari_shadowinv:napari.yaml"


# The manifest leaves them out, so that nobody has to choose a reader.
OPENED_BY_NAPARI = formats.SCAN_SUFFIXES | {".npy", formats.TABLE.suffix}


def test_its_readers_and_writers_are_those_of_the_registry(manifest):
    contributions = manifest.contributions
    (reader,) = contributions.readers
    readable = {end for each in formats.FORMATS if each.title for end in each.suffixes}
    patterns = {f"*{suffix}" for suffix in readable - OPENED_BY_NAPARI}
    assert sorted(reader.filename_patterns) == sorted(patterns)
    # A store is a folder, and folders are offered whatever their name.
    assert reader.accepts_directories
    written = [suffix for writer in contributions.writers for suffix in writer.filename_extensions]
    writers = {each.suffix for each in formats.FORMATS if each.result_writer}
    assert sorted(written) == sorted(writers)


def test_napari_itself_opens_what_is_left_to_it():
    import napari_builtins
    from npe2 import PluginManifest

    builtins = PluginManifest.from_file(Path(napari_builtins.__file__).with_name("builtins.yaml"))
    patterns = {
        name for reader in builtins.contributions.readers for name in reader.filename_patterns
    }
    assert {f"*{suffix}" for suffix in OPENED_BY_NAPARI} <= patterns


def test_its_menus_exist_and_are_short(manifest):
    from napari._app_model.constants._menus import MenuId

    menus = manifest.contributions.menus
    layers = ("measure", "filter", "transform", "register")
    assert set(menus) == {f"napari/layers/{name}" for name in layers}
    assert not set(menus) - {str(menu) for menu in MenuId.contributables()}
    assert max(map(len, menus.values())) <= 4


def test_every_command_is_used_and_every_use_is_a_command(manifest):
    contributions = manifest.contributions
    ids = {command.id for command in contributions.commands}
    used = [
        *(item.command for item in contributions.readers),
        *(item.command for item in contributions.writers),
        *(item.command for item in contributions.widgets or ()),
        *(item.command for item in contributions.sample_data),
        *(item.command for items in contributions.menus.values() for item in items),
    ]
    assert ids == set(used)


def test_manifest_reader_and_public_function_stay_light(alone, tmp_path):
    for name in ("foreign.h5", "foreign.mat", "foreign.tif"):
        (tmp_path / name).write_bytes(b"\x89HDF\r\n\x1a\n" + b"\0" * 90)
    heavy = alone(
        f"""
import sys
from npe2 import PluginManifest

def print_heavy(*names):
    print([name for name in sys.modules if name in names])

PluginManifest.from_file({str(ROOT / "napari.yaml")!r})
from napari_shadowinv._napari.reader import get_reader
assert get_reader("foreign.h5") is None
assert get_reader("paper.pdf") is None
get_reader("foreign.mat"), get_reader("foreign.tif"), get_reader(".")
print_heavy("qtpy", "PyQt6", "PySide6", "numba", "napari", "dask")
import napari_shadowinv
from napari_shadowinv.io import formats
napari_shadowinv.add_to_viewer
print_heavy("napari", "qtpy", "dask")
"""
    )
    assert heavy.split() == ["[]", "[]"]


def test_the_package_works_where_napari_is_not_installed(alone):
    printed = alone(
        """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("napari", "qtpy", "PyQt6", "PySide6", "superqt", "magicgui"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
import numpy as np
import napari_shadowinv as nsi

inversion = nsi.invert(np.ones((20, 20)))
nsi.write("blank.shadowinv", inversion)
print(nsi.read("blank.shadowinv").sizes["site"])

from napari_shadowinv._napari.layers import inversion_layers
from typer.testing import CliRunner
from napari_shadowinv.cli import app

answer = CliRunner().invoke(app, ["info", "blank.shadowinv"])
assert answer.exit_code == 0, answer.output
try:
    nsi.add_to_viewer(object(), inversion)
except ModuleNotFoundError as error:
    print(error.name)
"""
    )
    assert printed.split() == ["400", "napari"]
