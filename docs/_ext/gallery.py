"""How sphinx-gallery runs examples/: as scripts that write their picture into a folder."""

from __future__ import annotations

import ast
import shutil
import tempfile
from pathlib import Path
from typing import Any

from sphinx_gallery.scrapers import figure_rst

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data"
# Folder of the data that a script needs.
NEEDED = {"burner_strip": "burner/data", "donut": "donut", "rcf_layers": "rcf"}
OUT = Path(tempfile.mkdtemp(prefix="shadowinv-gallery-"))


class Arguments:
    """The command line of a script: a quick look, written to `OUT`."""

    def __repr__(self) -> str:
        return "Arguments"

    def __call__(self, gallery_conf: Any, script_vars: dict[str, Any]) -> list[str]:
        # The scripts tell in their help what they are; sphinx-gallery empties the docstring.
        told = ast.get_docstring(ast.parse(Path(script_vars["src_file"]).read_text("utf-8")))
        script_vars["example_globals"]["__doc__"] = told
        needed = NEEDED.get(Path(script_vars["src_file"]).stem)
        return [*([str(DATA / needed)] if needed else []), "--out", str(OUT), "--small"]


class Written:
    """Takes the pictures that a script has written since the last block."""

    def __repr__(self) -> str:
        return "Written"

    def __call__(self, block: Any, block_vars: dict[str, Any], gallery_conf: Any) -> str:
        found = []
        for picture in sorted(OUT.glob("*.png")):
            target = block_vars["image_path_iterator"].next()
            shutil.move(picture, target)
            found.append(target)
        return str(figure_rst(found, gallery_conf["src_dir"]))


_AVAILABLE = [
    script.stem
    for script in sorted((ROOT / "examples").glob("*.py"))
    if not script.stem.startswith("napari") and (DATA / NEEDED.get(script.stem, "")).is_dir()
]

sphinx_gallery_conf = {
    "examples_dirs": str(ROOT / "examples"),
    "gallery_dirs": "examples",
    "filename_pattern": rf"/({'|'.join(_AVAILABLE)})\.py$",
    "ignore_pattern": r"/(napari_.*|notebooks/.*)\.py$",
    "image_scrapers": [Written()],
    "reset_argv": Arguments(),
    "reset_modules": (),
    "nested_sections": False,
    "download_all_examples": False,
    "show_memory": False,
    "write_computation_times": False,
}
