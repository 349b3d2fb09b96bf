"""The solvers that are compared, and the packages and codes that are not."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]


@dataclass(frozen=True)
class Environment:
    """What an environment installs; later alternatives are tried when the first does not install.

    `python` is the least minor version of Python 3 that the package runs on.
    """

    alternatives: tuple[tuple[str, ...], ...]
    python: int = 11


@dataclass(frozen=True)
class Solver:
    """A solver: its environment, its module in `solvers`, and its settings in words."""

    name: str
    environment: str
    module: str
    settings: str


OURS = "napari-shadowinv"
LINEAR = "Poisson (SciPy)"
EXACT = f"{OURS}, accuracy 0.001"
KASIM = "power diagrams by L-BFGS (Kasim et al.)"
STAND_IN = "grid Monge–Ampère (stand-in for PROBLEM)"

ENVIRONMENTS = {
    "ours": Environment((("--editable", str(REPOSITORY)),)),
    "pysdot": Environment((("pysdot", "scipy"), ("--prefer-binary", "pysdot", "scipy"))),
    "sdot": Environment((("sdot", "jax"),), python=12),
    "sunbear": Environment((("sunbear",),)),
    "pot": Environment((("POT",),)),
    "ott": Environment((("ott-jax",),)),
    "geomloss": Environment((("geomloss", "pykeops", "torch"),)),
    "multiscaleot": Environment((("MultiScaleOT", "numpy", "scipy"),)),
}

SOLVERS = (
    Solver(OURS, "ours", "ours", "default options"),
    Solver(EXACT, "ours", "ours_exact", "`accuracy=0.001`"),
    Solver(f"{OURS}, free boundary", "ours", "ours_free", "`boundary='free'`, `flux='known'`"),
    Solver(
        KASIM,
        "ours",
        "ours_lbfgs",
        "the algorithm of 2017 with this package's compiled geometry, so not the time of its "
        "MATLAB code: `solver='lbfgs'`, `stages='single'`, `readout='centroid'`, a site a pixel",
    ),
    Solver(LINEAR, "ours", "poisson", "∇²φ = I/I₀ − 1 by cosine transforms"),
    Solver(
        STAND_IN,
        "ours",
        "grid_monge_ampere",
        "parabolic iteration, central differences, from 32 px on to twice as many, until the mean "
        "square of the logarithm is 1e-8, has stalled for 3000 steps, or 80 % of the time is up",
    ),
    Solver(
        "sunbear",
        "sunbear",
        "sunbear_package",
        "Kasim's Monge–Ampère solver of 2019, its defaults, `max_time` 80 % of the limit; its "
        "potential is fixed at the border",
    ),
    Solver(
        "pysdot",
        "pysdot",
        "pysdot_package",
        "a site in the centre of each pixel, masses to 0.1 %, centroids",
    ),
    Solver(
        "sdot",
        "sdot",
        "sdot_package",
        "a site 0.001 px off the centre of each pixel, masses to 0.1 %, centroids",
    ),
    Solver("POT, exact", "pot", "pot_exact", "`ot.emd` between pixels, mean landing place"),
    Solver(
        "POT, Sinkhorn",
        "pot",
        "pot_sinkhorn",
        "`ot.sinkhorn` between pixels, ε = 1 px², stop at 1e-6 or after 5000 steps",
    ),
    Solver(
        "OTT, Sinkhorn",
        "ott",
        "ott_sinkhorn",
        "grid geometry, ε = 1 px² reached from 100 px², threshold 1e-4, double precision",
    ),
    Solver(
        "geomloss, Sinkhorn",
        "geomloss",
        "geomloss_sinkhorn",
        "`sinkhorn_divergence` of images, blur 1 px (the least that works), `scaling=0.99`, not "
        "debiased",
    ),
    Solver(
        "MultiScaleOT",
        "multiscaleot",
        "multiscaleot_package",
        "sparse multi-scale Sinkhorn, ε = 1 px², error goal 1e-4; built from source with the "
        "system's library Eigen",
    ),
)

LEFT_OUT = {
    "oliker-prussner-method": "solves the Monge–Ampère equation, but has no image to land on",
    "prad": "only traces particles",
    "flash-sinkhorn, curegot": "made for graphics processors",
    "InvertDeflectPy, PROBLEM, invert-shadowgraphy": "not in the package index",
}

PUBLISHED = (
    (
        "invert-shadowgraphy (power diagrams, L-BFGS, MATLAB)",
        "200 × 200 px: 2–3 h on 32 cores",
        "Kasim et al., Phys. Rev. E 95, 023306 (2017), arXiv:1607.04179",
    ),
    (
        "the same, its demonstration",
        "50 × 50 px: about 10 minutes on its author's computer",
        "comment in its repository, mfkasim1/invert-shadowgraphy",
    ),
    (
        "PROBLEM (Monge–Ampère)",
        "none was found",
        "Bott et al., J. Plasma Phys. 83, 905830614 (2017); repository flash-center/PROBLEM",
    ),
)
