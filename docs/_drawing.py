"""What the pictures of these pages share: `show` a plane, `tidy` a plot, `save` the figure."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

HERE = Path(__file__).parent
WIDTH = 1500  # of a picture, in px
BLUE, ORANGE, DARK = "#1f77d0", "#e8711a", "#333333"

FloatArray = NDArray[np.float64]


def show(
    axes: Axes,
    plane: FloatArray,
    title: str,
    label: str,
    limits: tuple[float, float],
    cmap: str = "gray",
    extend: Literal["neither", "both"] = "neither",
) -> None:
    mapped = axes.imshow(plane, cmap=cmap, vmin=limits[0], vmax=limits[1])
    _label(axes, title, "x (px)", "y (px)")
    bar = axes.figure.colorbar(mapped, cax=axes.inset_axes((1.03, 0, 0.045, 1)), extend=extend)
    bar.set_label(label)


def tidy(axes: Axes, title: str, x_label: str, y_label: str, aspect: float) -> None:
    _label(axes, title, x_label, y_label)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_box_aspect(aspect)


def _label(axes: Axes, title: str, x_label: str, y_label: str) -> None:
    axes.set_title(title, loc="left", fontsize=11, fontweight="bold")
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)


def save(figure: Figure, name: str, footer: str = "") -> None:
    if footer:
        figure.supxlabel(footer, x=0.01, ha="left", fontsize=10.5, color=DARK)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150)
    picture = Image.open(buffer).convert("RGB")
    height = round(WIDTH * picture.height / picture.width)
    picture.resize((WIDTH, height), Image.Resampling.LANCZOS).save(HERE / name, optimize=True)
    print(f"wrote {HERE / name}")
