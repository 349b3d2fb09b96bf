"""What is handed out: the wheel, its metadata, the citation. Nothing here needs the network."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from configparser import ConfigParser
from email import message_from_string
from email.message import Message
from importlib.metadata import requires
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest
import yaml

import napari_shadowinv
from napari_shadowinv import __version__

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "napari_shadowinv"


def loaded(path: Path) -> Any:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


# The wheel


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The files of a freshly built wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder)]
    done = subprocess.run([*command, str(ROOT)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    (path,) = folder.iterdir()
    assert path.name == f"napari_shadowinv-{__version__}-py3-none-any.whl"
    with ZipFile(path) as archive:
        return {
            name: archive.read(name).decode().replace("\r\n", "\n") for name in archive.namelist()
        }


@pytest.fixture(scope="module")
def about(wheel: dict[str, str]) -> dict[str, str]:
    """The files beside the package that describe it."""
    start = f"napari_shadowinv-{__version__}.dist-info/"
    return {
        name.removeprefix(start): text for name, text in wheel.items() if name.startswith(start)
    }


@pytest.fixture(scope="module")
def metadata(about: dict[str, str]) -> Message:
    return message_from_string(about["METADATA"])


def test_the_wheel_holds_the_package_and_nothing_else(wheel: dict[str, str]) -> None:
    files = {name for name in wheel if ".dist-info/" not in name}
    sources = {
        path.relative_to(PACKAGE.parent).as_posix()
        for path in PACKAGE.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert files == sources
    assert {"napari_shadowinv/napari.yaml", "napari_shadowinv/py.typed"} <= files
    assert wheel["napari_shadowinv/napari.yaml"] == (PACKAGE / "napari.yaml").read_text("utf-8")


def test_the_wheel_offers_the_command_and_the_plugin(
    wheel: dict[str, str], about: dict[str, str]
) -> None:
    entries = ConfigParser()
    entries.read_string(about["entry_points.txt"])
    assert dict(entries["console_scripts"]) == {"shadowinv": "napari_shadowinv.__main__:main"}
    assert dict(entries["napari.manifest"]) == {"napari-shadowinv": "napari_shadowinv:napari.yaml"}
    assert "\ndef main() -> None:\n" in wheel["napari_shadowinv/__main__.py"]


def test_the_version_has_one_place(metadata: Message) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert "version" not in project
    assert "version" in project["dynamic"]
    assert metadata["Version"] == napari_shadowinv.__version__
    assert re.fullmatch(r"\d+\.\d+\.\d+((a|b|rc|\.dev)\d+)?", __version__)


HEAVY = "numba xarray matplotlib skimage h5py tifffile imageio dask distributed scipy.optimize"
WINDOWS = "napari qtpy PyQt6 PySide6"
LIGHT = {
    "import napari_shadowinv; napari_shadowinv.__version__": f"numpy scipy {HEAVY} {WINDOWS}",
    "from napari_shadowinv.io import read, write": f"scipy {HEAVY} {WINDOWS}",
    "from napari_shadowinv.cli import app": f"scipy.fft zarr {HEAVY} {WINDOWS}",
}


@pytest.mark.parametrize("code", LIGHT)
def test_what_is_often_imported_is_light(code: str) -> None:
    script = f"{code}\nimport sys; print({{*{LIGHT[code].split()}}} & {{*sys.modules}})"
    path = os.pathsep.join([*filter(None, sys.path), str(ROOT / "tests")])
    environment = {**os.environ, "PYTHONPATH": path}
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.stdout.strip() == "set()", done.stderr


def test_the_wheel_describes_itself(about: dict[str, str], metadata: Message) -> None:
    assert metadata["Name"] == "napari-shadowinv"
    assert 0 < len(metadata["Summary"]) < 200
    assert metadata["License-Expression"] == "BSD-3-Clause"
    assert about["licenses/LICENSE"] == (ROOT / "LICENSE").read_text("utf-8")
    assert metadata["Description-Content-Type"] == "text/markdown"
    assert metadata.get_payload() == (ROOT / "README.md").read_text("utf-8")
    assert metadata["Requires-Python"] == ">=3.11"
    classifiers = metadata.get_all("Classifier", [])
    assert "Framework :: napari" in classifiers
    assert "Typing :: Typed" in classifiers
    assert not [name for name in classifiers if name.startswith("License ::")]
    trove_classifiers = pytest.importorskip("trove_classifiers")
    assert set(classifiers) <= trove_classifiers.classifiers


def names_in(needs: list[str]) -> set[str]:
    return {re.split(r"[^\w-]", need)[0].lower().replace("_", "-") for need in needs}


MODULES = {"PIL": "pillow", "skimage": "scikit-image"}  # whose names differ from their packages'


def test_the_page_of_dependencies_has_all_that_is_declared_and_imported(metadata: Message) -> None:
    page = (ROOT / "docs" / "dependencies.md").read_text("utf-8")
    rows = re.findall(
        r"^\| (?!package|extra)([a-z][\w-]+) \| .* \| ([\w, -]*)\|$", page, re.MULTILINE
    )
    brought_by = {name: names_in(text.split(", ")) - {""} for name, text in rows}
    needs = metadata.get_all("Requires-Dist", [])
    required = names_in([need for need in needs if "extra ==" not in need])
    assert brought_by.keys() == required
    # napari is no requirement of the core.
    assert "numpy" in required
    assert not {"napari", "qtpy", "pyqt6", "pyside6", "pytest"} & required
    for name, brought in brought_by.items():
        assert brought <= names_in(requires(name) or []), name
    imported = {
        MODULES.get(name, name.replace("_", "-"))
        for path in PACKAGE.rglob("*.py")
        if "_napari" not in path.parts
        for name in re.findall(
            r"^ *(?:from|import) ([\w]+)(?: import|\.| as|$)", path.read_text("utf-8"), re.MULTILINE
        )
        if name not in {*sys.stdlib_module_names, "napari_shadowinv"}
    }
    optional = imported - brought_by.keys() - set().union(*brought_by.values())
    assert optional <= {"distributed", "imageio-ffmpeg", "pooch"}
    assert all(name in page for name in optional)


# The citation


def test_the_citation_is_of_this_version_and_names_the_paper() -> None:
    """`make lint` checks its format."""
    citation = loaded(ROOT / "CITATION.cff")
    assert (citation["title"], citation["version"]) == ("napari-shadowinv", __version__)
    assert citation["license"] == "BSD-3-Clause"
    assert citation["authors"] == [{"name": "napari-shadowinv contributors"}]
    (paper,) = citation["references"]
    assert {"type", "title", "authors"} <= set(paper)
    for author in paper["authors"]:
        assert set(author) == {"family-names", "given-names"}
    names = ", ".join(author["family-names"] for author in paper["authors"])
    assert names == (
        "Kasim, Ceurvorst, Ratan, Sadler, Chen, Sävert, Trines, Bingham, Burrows, Kaluza, Norreys"
    )
    assert paper["identifiers"][0]["value"] == "arXiv:1607.04179"
    assert paper["title"].startswith("Quantitative shadowgraphy and proton radiography")


# The plugin's page


def test_the_manifest_says_where_the_plugin_belongs() -> None:
    manifest = loaded(PACKAGE / "napari.yaml")
    assert manifest["visibility"] == "public"
    schema = pytest.importorskip("npe2.manifest.schema")
    assert manifest["categories"]
    assert set(manifest["categories"]) <= {str(category) for category in schema.Category}


def test_the_project_has_its_addresses(metadata: Message) -> None:
    labels = {url.split(", ")[0] for url in metadata.get_all("Project-URL", [])}
    assert labels == {"Source", "Issues", "Documentation", "Changelog", "Paper"}


# Archives, documentation, conda, containers


def test_all_archives_have_the_same_keywords_and_licence(metadata: Message) -> None:
    citation = loaded(ROOT / "CITATION.cff")
    archive = json.loads((ROOT / ".zenodo.json").read_text("utf-8"))
    assert citation["keywords"] == archive["keywords"]
    assert sorted(citation["keywords"]) == metadata["Keywords"].split(",")
    assert archive["license"] == citation["license"] == metadata["License-Expression"]
    assert archive["creators"] == citation["authors"]
    assert (archive["title"], archive["upload_type"]) == (citation["title"], "software")


def test_read_the_docs_builds_what_make_docs_builds() -> None:
    settings = loaded(ROOT / ".readthedocs.yaml")
    rule = re.search(r"sphinx-build (.*) docs build/docs", (ROOT / "Makefile").read_text("utf-8"))
    assert rule is not None
    assert ("-W" in rule[1].split()) == settings["sphinx"]["fail_on_warning"]
    assert settings["sphinx"]["configuration"] == "docs/conf.py"
    (install,) = settings["python"]["install"]
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert set(install["extra_requirements"]) <= set(extras["optional-dependencies"])
    python = settings["build"]["tools"]["python"]
    assert f"Programming Language :: Python :: {python}" in extras["classifiers"]


CONDA_NAMES = {"dask": "dask-core", "matplotlib": "matplotlib-base"}  # without windows and servers
OF_EXTRAS = {"h5netcdf[h5py]": "h5py", "tifffile[codecs]": "imagecodecs"}  # conda has no extras


def test_the_conda_recipe_requires_what_the_wheel_requires(metadata: Message) -> None:
    recipe = loaded(ROOT / "conda" / "recipe.yaml")
    needs = {f"python {metadata['Requires-Python']}"}
    for need in metadata.get_all("Requires-Dist", []):
        match = re.fullmatch(r"([\w-]+)(?:\[.*\])?(>=[\d.]+)", need)
        if match:
            needs |= {OF_EXTRAS[name] for name in OF_EXTRAS if need.startswith(name)}
            needs.add(f"{CONDA_NAMES.get(match[1].lower(), match[1].lower())} {match[2]}")
    context = recipe["context"]
    run = recipe["requirements"]["run"]
    run = {text.replace("${{ python_min }}", context["python_min"]) for text in run}
    assert {text.replace("-", "_") for text in run} == {text.replace("-", "_") for text in needs}
    assert context["version"] == __version__
    (command,) = recipe["build"]["python"]["entry_points"]
    assert command == "shadowinv = napari_shadowinv.__main__:main"


def test_both_containers_install_the_same_files_in_the_same_way() -> None:
    docker = (ROOT / "containers" / "Dockerfile").read_text("utf-8")
    apptainer = (ROOT / "containers" / "shadowinv.def").read_text("utf-8")
    (copied,) = re.findall(r"^%files\n((?: +.*\n)+)", apptainer, re.MULTILINE)
    sources = {line.split()[0] for line in copied.splitlines()}
    copies = re.findall(r"^COPY (.*) \S+$", docker, re.MULTILINE)
    assert {name for names in copies for name in names.split()} == sources
    assert all((ROOT / source).exists() for source in sources)
    assert re.findall(r"^FROM (.*)$", docker, re.MULTILINE) == re.findall(
        r"^From: (.*)$", apptainer, re.MULTILINE
    )
    for definition in (docker, apptainer):
        assert "sh /src/containers/install" in definition
