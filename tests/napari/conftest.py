"""Tests of the plugin need napari; those with a window also a display."""

import copy
import functools
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("napari")

from napari.components import ViewerModel

import napari_shadowinv
from helpers.fits import doubtful_fit
from napari_shadowinv import InversionOptions, invert
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import ellipse_pair
from napari_shadowinv.pipeline import read_pack, run_film
from simulated_pack import simulate


@pytest.fixture(scope="session", autouse=True)
def _no_preferences(tmp_path_factory):
    """Keep the tests and the preferences of whoever runs them apart."""
    from napari import settings

    if hasattr(settings, "get_plugin_settings"):
        settings._clear_plugin_settings_cache()
        settings._CFG_PATH = str(tmp_path_factory.mktemp("napari") / "settings.yaml")


@pytest.fixture(scope="session", autouse=True)
def _manifests_parsed_once():
    """Keep the content of manifests, which each new window parses anew: a third of its time."""
    from npe2.manifest import _bases

    if not hasattr(_bases, "_load_yaml_no_duplicates"):
        return
    parse = functools.cache(_bases._load_yaml_no_duplicates)
    _bases._load_yaml_no_duplicates = lambda stream: copy.deepcopy(parse(stream.read()))


@pytest.fixture
def preferences():
    """The plugin's preferences, which have their defaults again after a test."""
    from napari import settings

    if not hasattr(settings, "get_plugin_settings"):
        pytest.skip("napari before 0.9 has no preferences of plugins")
    yield settings.get_plugin_settings("napari-shadowinv")
    settings.get_plugin_settings("napari-shadowinv").reset()


@pytest.fixture
def manifest():
    from npe2 import PluginManifest

    return PluginManifest.from_file(Path(napari_shadowinv.__file__).with_name("napari.yaml"))


@pytest.fixture
def viewer():
    """A viewer without a window, with this plugin as it is installed."""
    from npe2 import PluginManager

    PluginManager.instance().discover()
    return ViewerModel()


@pytest.fixture(scope="session")
def solved():
    """A small inversion that was really solved, of an object without symmetry, and determined."""
    image = synthetic_image(ellipse_pair((40, 52)).displacement)
    options = InversionOptions(n_sites=500, max_error=0.2)
    return invert(image, options=options, instrument={"beam_rms": 0.0})


@pytest.fixture(scope="session")
def doubtful():
    return doubtful_fit("B")


@pytest.fixture(scope="session")
def two_fields():
    return doubtful_fit("B", "E")


@pytest.fixture(scope="session")
def film_pack(tmp_path_factory):
    """Scans of three small films, and their pack file."""
    folder = tmp_path_factory.mktemp("films") / "trio"
    return simulate(folder, layers=3, shape=(80, 100), strata=4, seed=2)


@pytest.fixture(scope="session")
def pack_doses(film_pack):
    return run_film(read_pack(film_pack.pack))


@pytest.fixture
def messages(monkeypatch):
    """The texts of napari's notifications."""
    from napari.utils import notifications

    texts = []
    monkeypatch.setattr(
        notifications.notification_manager,
        "dispatch",
        lambda notification: texts.append(str(notification.message)),
    )
    return texts


@pytest.fixture
def in_loop(qtbot):
    """Call a function from within the event loop, as a menu does, and return its result."""
    from qtpy.QtCore import QTimer

    def call(function, *args):
        answers = []
        errors = []

        def answer():
            try:
                answers.append(function(*args))
            except Exception as error:
                errors.append(error)

        QTimer.singleShot(0, answer)
        qtbot.waitUntil(lambda: bool(answers or errors), timeout=60_000)
        if errors:
            raise errors[0]
        return answers[0]

    return call


@pytest.fixture
def alone(tmp_path):
    """Run Python code in a process of its own, and return what it printed."""

    def run(code):
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=300)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


@pytest.fixture
def noisy():
    """An image of counts with one hot pixel and a slope."""
    image = np.random.default_rng(3).normal(400, 4, (48, 60)) + np.linspace(0, 200, 60)
    image[10, 20] = 5000
    return image
