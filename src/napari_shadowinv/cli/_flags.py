"""Arguments and options that commands share, each with its name and help.

- what is read: `ImageFile`, `SourceFile`, `MaskFile`, `SetupFile`, `OptionsFile`, `StoreFolder`
- which part of it: `Channel`, `Variable`, `SourceVariable`, `Bin`, `ChosenShots`
- the inversion: `SiteCount`, `ClipNegative`, `Threads`, `Seed`, `Boundary`, `Margin`, `Flux`
- filters before it: `HotPixels`, `BackgroundDegree`, `HighPass`, `LowPass`, `Butterworth`,
  `ButterworthOrder`, `ButterworthKind`
- a source estimated from the image: `SourceFrom`, `SourceCentreY`, `SourceCentreX`,
  `SourceDegree`, `SourceWeight`, `SourceWidth`, `SourceMask`
- what is written: `Result`, `Figure`, `Overwrite`, `Quiet`, `QuietInversion`

`given` tells which of them a user gave.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from napari_shadowinv.io.formats import IMAGE_TITLES

_FILTERS = "Filters before the inversion"
_BOUNDARY = "Flux across the image edge (docs/boundary.md)"
_ESTIMATES = "Source estimated from the image (docs/sources.md)"


def given(**flags: Any) -> dict[str, Any]:
    """Flags that the user gave, by name."""
    return {name: value for name, value in flags.items() if value is not None}


ImageFile = Annotated[
    Path,
    Argument(
        help=f"{IMAGE_TITLES}; with --variable, any HDF5 file.",
        show_default=False,
    ),
]
StoreFolder = Annotated[
    Path, Argument(help="name.shadowinv.zarr, from shadowinv batch.", show_default=False)
]
SourceFile = Annotated[
    Path | None,
    Option("--source", help="Image of the undisturbed beam. Default: uniform."),
]
MaskFile = Annotated[
    Path | None,
    Option("--mask", help="Image of the same size, 0 at unusable pixels."),
]
SetupFile = Annotated[
    Path | None,
    Option("--setup", help="TOML file with the experimental geometry, for results in SI units."),
]
OptionsFile = Annotated[Path | None, Option("--options", help="TOML file with inversion options.")]
Channel = Annotated[
    str | None,
    Option(help="Channel of a colour image: red, green, blue, mean or an index from 0."),
]
Variable = Annotated[
    str | None,
    Option(
        "--variable",
        metavar="NAME",
        help="Name of the array in an HDF5 file, or in a MATLAB file with several images.",
    ),
]
SourceVariable = Annotated[
    str | None,
    Option(
        metavar="NAME",
        help=(
            "Name of the array with the undisturbed beam, in the --source file or else in the "
            "image file."
        ),
    ),
]
Bin = Annotated[int, Option("--bin", metavar="N", help="Bin N×N pixels first.")]
ChosenShots = Annotated[
    str | None,
    Option(
        "--shots",
        help=("Shots to use, counted from 0: 3, 3:20, ::10 or 1,4,9. Default: all finished shots."),
    ),
]

SiteCount = Annotated[int | None, Option(help="Number of sites. Default: one per pixel.")]
ClipNegative = Annotated[
    bool, Option("--clip-negative", help="Set negative pixels to zero and count them.")
]
Threads = Annotated[int | None, Option(help="Number of threads. Default: all cores.")]
Seed = Annotated[int | None, Option(help="Random seed for the site positions.")]
Boundary = Annotated[
    str | None,
    Option(
        help="'closed': no flux crosses the edge. 'free': flux may leave and enter.",
        rich_help_panel=_BOUNDARY,
    ),
]
Margin = Annotated[
    int | None,
    Option(
        metavar="PX",
        help="Free boundary: width of the strip beyond each edge from which flux may enter.",
        rich_help_panel=_BOUNDARY,
    ),
]
Flux = Annotated[
    str | None,
    Option(
        help=(
            "Free boundary: 'conserve' (units of image and source may differ), 'known' (same "
            "exposure) or 'fit'."
        ),
        rich_help_panel=_BOUNDARY,
    ),
]

HotPixels = Annotated[
    float | None,
    Option(
        metavar="DEVIATIONS",
        help=(
            "Replace hot and dead pixels that differ from the median of their neighbours by "
            "more than this many standard deviations of the noise; 6 suits most images. Applied "
            "before --bin."
        ),
        rich_help_panel=_FILTERS,
    ),
]
BackgroundDegree = Annotated[
    int | None,
    Option(
        metavar="DEGREE",
        help="Divide the image by a polynomial fitted to it, total degree 0 to 10.",
        rich_help_panel=_FILTERS,
    ),
]
HighPass = Annotated[
    float | None,
    Option(
        metavar="PX",
        help="Remove structures much larger than this width in px (after --bin).",
        rich_help_panel=_FILTERS,
    ),
]
LowPass = Annotated[
    float | None,
    Option(
        metavar="PX",
        help=(
            "Blur image and source with a Gaussian of this standard deviation in px (after --bin)."
        ),
        rich_help_panel=_FILTERS,
    ),
]
Butterworth = Annotated[
    float | None,
    Option(
        metavar="PX",
        help=(
            "Remove structures larger than this wavelength in px (after --bin), with a sharp "
            "cutoff."
        ),
        rich_help_panel=_FILTERS,
    ),
]
ButterworthOrder = Annotated[
    int | None,
    Option(
        metavar="N",
        help=(
            "Order of --butterworth: the amplitude falls as this power of the wavelength. "
            "Default: 2."
        ),
        rich_help_panel=_FILTERS,
    ),
]
ButterworthKind = Annotated[
    str | None,
    Option(
        help=(
            "Kind of --butterworth: 'high' removes larger structures (default), 'low' removes "
            "smaller ones, in both image and source."
        ),
        rich_help_panel=_FILTERS,
    ),
]

SourceFrom = Annotated[
    str | None,
    Option(
        metavar="ESTIMATE",
        help=(
            "Estimate the undisturbed beam from the (filtered) image: uniform, isotropic (a "
            "point source, needs --setup), gaussian, polynomial, low-pass, total-variation or "
            "interpolated."
        ),
        rich_help_panel=_ESTIMATES,
    ),
]
SourceCentreY = Annotated[
    float | None,
    Option(
        metavar="PX",
        help=(
            "For isotropic: row (after --bin) at which the detector faces the point source. "
            "Default: the image centre."
        ),
        rich_help_panel=_ESTIMATES,
    ),
]
SourceCentreX = Annotated[
    float | None,
    Option(
        metavar="PX",
        help=("For isotropic: column (after --bin) at which the detector faces the point source."),
        rich_help_panel=_ESTIMATES,
    ),
]
SourceDegree = Annotated[
    int | None,
    Option(
        help="For polynomial: total degree in y and x, 0 to 10. Default: 2.",
        rich_help_panel=_ESTIMATES,
    ),
]
SourceWeight = Annotated[
    float | None,
    Option(
        help=(
            "For total-variation: strength in px (after --bin); c·r/2 removes a disc of "
            "contrast c and radius r px. Default: 2."
        ),
        rich_help_panel=_ESTIMATES,
    ),
]
SourceWidth = Annotated[
    float | None,
    Option(
        help=(
            "For low-pass and interpolated: standard deviation of the blur in px (after --bin). "
            "Default for interpolated: 5."
        ),
        rich_help_panel=_ESTIMATES,
    ),
]
SourceMask = Annotated[
    Path | None,
    Option(
        help="Image of the same size, 0 where the object covers the beam.",
        rich_help_panel=_ESTIMATES,
    ),
]

Result = Annotated[
    Path | None,
    Option(
        help=(
            "Result file: .shadowinv (complete), .h5 (pradformat) or .csv (sites). Default: the "
            "image's name with .shadowinv, in the current folder."
        )
    ),
]
Figure = Annotated[
    Path | None,
    Option(help="Figure file: .png, .pdf or .svg. Default: a PNG next to the result."),
]
Overwrite = Annotated[bool, Option("--overwrite", help="Replace existing files.")]
Quiet = Annotated[bool, Option("--quiet", "-q", help="Print errors only.")]
QuietInversion = Annotated[bool, Option("--quiet", "-q", help="Print errors and warnings only.")]
