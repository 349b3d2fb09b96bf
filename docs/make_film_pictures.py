"""Make the picture of docs/tutorials/film-pack.md.

    python docs/make_film_pictures.py FOLDER

FOLDER holds the films of shot 019, as the page says. Runs the pack of the page.
"""

from __future__ import annotations

import argparse
import io
import re
import tempfile
from pathlib import Path

from _drawing import HERE
from matplotlib.figure import Figure
from PIL import Image

from napari_shadowinv.pipeline import read_pack, run_film
from napari_shadowinv.plotting import pack_figure

WIDTH, COLOURS = 1400, 256


def pack_of_page(folder: Path, data: Path) -> Path:
    """Write the page's pack into a folder that sees the data."""
    text = (HERE / "tutorials" / "film-pack.md").read_text(encoding="utf-8")
    for file in data.iterdir():
        (folder / file.name).symlink_to(file.resolve())
    tables, packs = (
        re.findall(rf"```{kind}\n(.*?)```", text, re.DOTALL) for kind in ("text", "toml")
    )
    (folder / "films.csv").write_text(tables[0], encoding="utf-8")
    (folder / "pack.toml").write_text(packs[0], encoding="utf-8")
    return folder / "pack.toml"


def save_with_few_colours(figure: Figure, path: Path) -> None:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=200)
    picture = Image.open(buffer).convert("RGB")
    height = round(WIDTH * picture.height / picture.width)
    small = picture.resize((WIDTH, height), Image.Resampling.LANCZOS)
    small.quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"wrote {path}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder with the films")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        doses = run_film(read_pack(pack_of_page(Path(scratch), arguments.data)))
    figure = pack_figure(doses, title="pack.toml")
    save_with_few_colours(figure, HERE / "pictures" / "film-pack.png")


if __name__ == "__main__":
    main()
