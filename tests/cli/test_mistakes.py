"""Mistakes of each command: one sentence that names them, an exit code, and nothing written."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import xarray as xr
from scipy.io import savemat

from helpers.command_line import refused
from helpers.exact_fields import SETUP
from napari_shadowinv import invert, write
from napari_shadowinv.fitting import Fit
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob

LENGTHS = 'kind = "proton"\nsource_object_distance = 0.01\nobject_image_distance = 0.3\n'
LENGTHS += "pixel_size = 1e-5\n"
CIRCLE = "'current center=23.5,23.5 radius=8'"
STORE = "--out x.shadowinv.zarr"

MISTAKES: dict[str, str | tuple[str, ...]] = {
    # outputs
    "invert shot.npy --out a.png --figure a.png": "a.png",
    "invert shot.npy --figure a.toml --save-recipe a.toml": "a.toml",
    "invert shot.npy --out nowhere/a.shadowinv": "folder nowhere does not exist",
    "invert shot.npy --figure nowhere/a.png": "folder nowhere does not exist",
    "invert shot.npy --out a.xlsx": ".xlsx",
    "invert shot.npy --out a.h5": "needs a setup of kind 'proton'",
    "invert shot.npy --out .": "is a folder",
    "invert shot.npy --out ring.shadowinv": ("ring.shadowinv exists", "--overwrite"),
    "invert shot.npy --figure beam.png": "beam.png exists",
    "invert own.npy --mask own.png --overwrite": ("own.png", "both read and written"),
    "invert own.npy --recipe picture.toml --overwrite": ("own.png", "both read and written"),
    "invert shot.npy --recipe keys.toml --save-recipe keys.toml --overwrite": "keys.toml",
    "invert shot.npy --save-recipe shot.npy --overwrite": ("shot.npy", ".toml"),
    "forward ring.shadowinv --out ring.shadowinv --overwrite": "ring.shadowinv cannot be written",
    f"analyse ring.shadowinv {CIRCLE} --out ring.shadowinv --overwrite": "both read and written",
    f"analyse ring.shadowinv {CIRCLE} --csv a.txt": "a.txt",
    "fit a.tif --source beam.png --figure beam.png --overwrite": "beam.png is both read and writ",
    "fit a.tif --mask beam.png --figure beam.png --overwrite": "beam.png is both read and written",
    "fit a.tif --figure beam.png": ("beam.png exists", "--overwrite"),
    "fit a.tif --out fit.csv": ("expected one of .h5", ".shadowinv"),
    "fit a.tif --out fit.h5": ("pradformat", "needs a setup"),
    "fit a.tif b.tif --energies 3,5 --setup lengths.toml --set fit.fields=B,E --out fit.h5": (
        "holds one field, received B and E"
    ),
    "fit a.tif --out new.shadowinv --figure setup.toml": (".toml", "expected one of"),
    "plan blob --out plan.txt": "plan.txt cannot be written",
    "demo --out shot.npy": "shot.npy cannot be created as a folder",
    "batch shots/*.npy --out a.zarr": "ends with .shadowinv.zarr",
    # inputs
    "invert missing.tif": "missing.tif does not exist",
    "invert .": "is a folder",
    "invert shot.npy --source missing.tif": "missing.tif does not exist",
    "invert shot.npy --source small.npy": "(20, 20)",
    "invert shot.npy --mask small.npy": "small.npy",
    "invert shot.npy --source shot.npy": "the source is the image itself",
    "invert zero.npy": "zero.npy: image has no positive pixel",
    "invert ring.shadowinv --out again.shadowinv": "is a result",
    "invert shot.npy::shot": "neither a MATLAB nor an HDF5 file",
    "invert shots.mat": ("shots.mat", "::shot", "shot"),
    "info shots.mat": ("shots.mat", "::shot", "'shot' (24×32"),
    "info shots.mat::shop": ("shots.mat", "'shop'", "beam"),
    "invert shots.h5": ("shots.h5", "::day/beam", "day/shot"),
    "info shots.h5": ("shots.h5", "::day/beam", "'day/shot' (24×32"),
    "info shots.h5::shop": ("shots.h5", "'shop'", "day/beam"),
    "info shots.h5::day": ("no array 'day'", "day/beam"),
    "info missing.tif": "missing.tif",
    "info shots --verify": "is not a stack of shots",
    "info none.shadowinv.zarr": "none.shadowinv.zarr does not exist",
    "export shots --format csv": "is not a stack of shots",
    "forward missing.tif": "missing.tif",
    "forward shot.npy": "expected the result",
    "forward ring.shadowinv --source small.npy": "(20, 20)",
    "forward two.shadowinv": "the fields B and E",
    "analyse shot.npy contrast": "expected the result",
    "rerun bare.shadowinv": ("bare.shadowinv", "has no provenance"),
    "rerun lengths.toml": "lengths.toml is a text file",
    **{f"{name} damaged.shadowinv": "damaged.shadowinv" for name in ("forward", "info", "rerun")},
    "fit a.tif --source nothing.tif": "nothing.tif does not exist",
    "fit a.tif --source small.npy": "a.tif: source has shape (20, 20)",
    "plan missing.shadowinv": "missing.shadowinv",
    "film lost.toml": "lost.toml does not exist: expected a TOML file",
    f"batch no/*.tif {STORE}": "no file matches no/*.tif",
    f"batch shots/*.npy {STORE} --source x.tif": "not exist",
    f"watch nowhere {STORE}": "does not exist: expected a folder",
    f"watch shot.npy {STORE}": "is a file: expected a folder",
    f"watch shots {STORE} --source none.tif": "none.tif",
    # flags and keys
    "invert shot.npy --bin 0": ("--step 'bin 0'", "'factor' is '0'"),
    "invert shot.npy --bin 20": "by 20",
    "invert shot.npy --accuracy 3": "--accuracy is 3",
    "invert shot.npy --instrument film,filn": "--instrument is 'film,filn': did you mean",
    "invert shot.npy --instrument film,camera": "expected one detector and one beam",
    "invert shot.npy --set options.margin=4": "options.margin: it needs --boundary free",
    "invert shot.npy --set options.n_sites=3": "options.n_sites is '3'",
    "invert shot.npy --set options.n_sites=1000000000000": "1,000,000,000,000 sites",
    "invert shot.npy --set options.solver=lbfgs --boundary free": (
        "options.solver is 'lbfgs' and --boundary is 'free', expected"
    ),
    "invert shot.npy --set options.noise_level=2 --set options.units_per_quantum=3": (
        "options.noise_level is 2 and options.units_per_quantum is 3, expected one"
    ),
    "invert shot.npy --set options.tolernce=1": "options.tolernce: did you mean options.tolerance?",
    "invert shot.npy --set tolerance=1": "tolerance: did you mean options.tolerance?",
    "invert shot.npy --set option.beam_rms=1": "did you mean instrument.beam_rms?",
    "invert shot.npy --set zzz=1": "expected a key that begins with options., instrument.",
    "invert shot.npy --set options.tolerance": "expected KEY=VALUE",
    "invert shot.npy --source-from gausian": "--source-from is 'gausian': did you mean 'gaussian'",
    "invert shot.npy --source-from gaussian --source shot.npy": "choose one of them",
    "invert shot.npy --source-from 'gaussian degree=3'": "'gaussian degree=3': unknown key",
    "invert shot.npy --source-from kriged": "without a source mask",
    "invert shot.npy --step 'low-pas 3'": "--step is 'low-pas 3': did you mean 'low-pass'",
    "invert shot.npy --step 'low-pass 3 4'": "expected name=value instead of '4'",
    "invert shot.npy --step 'butterworth 9 kind=band'": "kind=band': 'kind' is 'band'",
    "invert shot.npy --step 'low-pass -1'": "'width' is '-1': ",
    "invert shot.npy --recipe mask.toml": "nowhere.png",
    "fit a.tif --source unknown": ("one image", "(--set fit.options.ambiguous=true)"),
    "fit a.tif b.tif": "neither strengths nor setups",
    "fit a.tif b.tif --energies 3": "2 images and 1 values of --energies",
    "fit a.tif b.tif --energies 3,5": ("an energy of 3 MeV and no setup", "--setup"),
    "fit a.tif b.tif --setup lengths.toml": "'energy' is missing",
    "fit a.tif --set fit.psf=1 --set fit.resolution=1e-5": (
        "fit.psf, a point spread in px, and fit.resolution in m"
    ),
    "fit a.tif --set fit.resolution=1e-5": ("no setup", "(--set fit.psf)"),
    "fit a.tif --set fit.options.boundary=soft": (
        "fit.options.boundary is 'soft'",
        "'fading' or 'free'",
    ),
    "fit a.tif --set options.samples=2": "options.samples: did you mean fit.options.samples?",
    f"batch shot.npy {STORE} --workers 0": "--workers is 0",
    f"watch shots {STORE} --pattern inner/*.tif": "the pattern is 'inner/*.tif'",
    f"watch shots {STORE} --idle 0": "--idle is 0.0: it must be greater than 0",
    "forward ring.shadowinv --deflector plasma": "only one setup",
    "forward ring.shadowinv --set trace.counts=3": "trace.counts, which does not apply to ring.",
    "forward grid.nc": "there is no setup",
    "forward grid.nc --setup setup.toml --set view.beam=x --set view.right=x": "different axes",
    "forward grid.nc --setup setup.toml --set trace.source_size=1e-5": "use output 'counts'",
    "forward grid.nc --setup setup.toml --set trace.step=3": "trace.step is '3'",
    "forward grid.nc --setup setup.toml --deflector plasma": "leave it out",
    "forward grid.nc::4 --setup setup.toml": "::4, which does not apply",
    "analyse ring.shadowinv": "received no product, expected at least one: profile [label=TEXT]",
    "analyse ring.shadowinv 'fluxx 1,1 2,2'": "did you mean 'flux'?",
    f"analyse ring.shadowinv {CIRCLE} --unit furlong": "unit is 'furlong', expected one of T m",
    f"analyse ring.shadowinv {CIRCLE} --unit px": "not defined for a field in px",
    f"analyse ring.shadowinv {CIRCLE} --samples 2": "expected at least 20",
    "analyse ring.shadowinv 'profile 5,5 5,500'": "inside the image of 48 × 48 px",
    "analyse ring.shadowinv 'profile 5,5 5,9 width=-2'": "'width' is '-2'",
    "analyse ring.shadowinv 'flux 5,5 9,9 5,5'": "the flux across a closed line is zero",
    f"analyse ring.shadowinv {CIRCLE} --times 1e-9": "--shots and --times belong to a store",
    "plan torroid": "did you mean 'toroid'",
    "plan torroid:peak=1.5": "did you mean 'toroid'",
    "plan toroid": "particles",
    "plan blob --energies 3,15": "--energies is '3,15': it needs a setup",
    "plan toroid --setup setup.toml --energies 3;15": "separated by commas",
    "plan blob --size 200": "expected height and width",
    "plan blob --counts -1": "--counts is -1",
    "plan blob --set instrument.background=2": "instrument.background is '2'",
    "plan blob --deflector plasma": "does not apply to blob, a phantom",
    "plan grid.nc": "there is no setup",
    "plan grid.nc --setup setup.toml --deflector 'magnetic field'": "does not apply to grid.nc",
    "plan toroid --setup setup.toml --set view.beam=x --set view.right=y": (
        "received view.beam, view.right, which does not apply to toroid"
    ),
    "demo --noise -1": "--noise is -1",
    "demo --set options.n_sites=2": "options.n_sites",
}

# A command that ends with a file: contents of the file, and words of the sentences.
WRONG_FILES: dict[str, dict[str, str | tuple[str, ...]]] = {
    "invert shot.npy --setup a.toml": {
        f"energy = 0\n{LENGTHS}": "a.toml: 'energy' is 0",
        f"enerky = 1\n{LENGTHS}": "'enerky', did you mean",
        "energy = # MeV": "a.toml is not valid TOML",
    },
    "invert shot.npy --recipe a.toml": {
        "enerky = 14.7": "a.toml: unknown key 'enerky'",
        "[[steps]]\nstep = 'low-pass'\nwidth = 0": "'steps.0.width' is 0",
    },
    "fit a.tif --recipe a.toml": {
        '[[steps]]\nstep = "low-pass"\n': ("low-pass", "what the forward model is fitted to"),
        '[fit]\nbeam = "unknown"\n[source]\nmethod = "uniform"\n': "source and a fit with an unk",
        "[fit]\npsf = 1\nresolution = 1e-5\n": ("a.toml", "'fit.psf'", "'fit.resolution'"),
        "[fit]\nfield = 3\n": "'fit.field', did you mean 'fields'",
        "[fit.options]\nsamples = -2\n": "samples' is -2",
    },
    "fit a.csv": {
        "file,enrgy\na.tif,3\n": ("column 'enrgy'", "did you mean 'energy'?"),
        "file,noise\na.tif,loud\n": ("line 2", "'loud': expected 'poisson'"),
        "file,strength\na.tif,1\nb.tif,\n": "b.tif has no strength, other images",
        "file,source\na.tif,unknown\nb.tif,\n": "b.tif has no unknown source",
        "file,strength\na.tif,1\nb.tif,two\n": ("line 3", "'strength' is 'two'"),
        "file,strength\na.tif,1\nsmall.npy,2\n": "small.npy has shape (20, 20), a.tif (48, 56)",
        "file,strength,brightness\na.tif,1,1\nb.tif,2,0\n": ("line 3", "'brightness' is '0'"),
    },
    "fit --energies 3 a.csv": {
        "file\na.tif\n": "column 'energy'",
    },
    f"batch {STORE} a.csv": {
        "file\ngone.tif\n": ("none of 1 shots can be read", "gone.tif"),
        "energy\n5\n": "has no column 'file'",
        "file,enrgy\na.tif,5\n": "did you mean 'energy'?",
        "file,exclude\na.tif,maybe\n": ("line 2", "'exclude' is 'maybe'"),
        "file,exclude\na.tif,yes\nb.tif,1\n": (
            "a.csv excludes all of its 2 images",
            "column 'exclude'",
        ),
        "file,energy\na.tif,5\nb.tif,14.7\n": (
            "a.tif has an energy of 5 MeV and no setup",
            "--setup",
        ),
        "file,source\na.tif,unknown\n": ("line 2", "only a fit can find"),
        "file\ngone.npy\nlost.npy\n": "none of 2 shots can be read",
        "file\na.tif\na.tif\n": "a.tif twice",
        "file,setup\na.tif,no.toml\n": "no.toml",
    },
    "film a.toml": {
        "layers = 3": "'layers' is 3",
        "[[layers]\n": "is not valid TOML",
        '[[layers]]\nfilm = "EBT4"\n': "did you mean 'EBT3'?",
        '[[layers]]\nfilm = "EBT3"\n': "layer 1 has no file",
    },
}


@pytest.fixture(scope="module")
def inputs(
    tmp_path_factory: pytest.TempPathFactory,
    make_inversion: Callable[..., Inversion],
    make_fit: Callable[..., Fit],
) -> Path:
    """Images, fields, results and settings that are right."""
    folder = tmp_path_factory.mktemp("inputs")
    blob = gaussian_blob((24, 32), 6.0, 4.0, (10, 18))
    image = 100 * synthetic_image(blob.displacement)
    with chdir(folder):
        arrays = {"shot": image, "small": np.ones((20, 20)), "zero": np.zeros((24, 32))}
        arrays["own"] = image
        for name, array in arrays.items():
            np.save(f"{name}.npy", array)
        Path("shots").mkdir()
        np.save("shots/shot_0.npy", image)
        for name in "ab":
            wide = synthetic_image(gaussian_blob((48, 56), 25.0, 7.0).displacement)
            tifffile.imwrite(f"{name}.tif", 1000 * wide.astype(np.float32))
        for name, shape in (("own", (24, 32)), ("beam", (48, 56))):  # the content counts
            np.save(f"{name}.npy.npy", np.ones(shape))
            Path(f"{name}.npy.npy").rename(f"{name}.png")
        savemat("shots.mat", {"shot": image, "beam": image + 1})
        with h5py.File("shots.h5", "w") as file:
            file.update({"day/shot": image, "day/beam": image + 1})
        texts = {"lengths": LENGTHS, "setup": f"energy = 14.7\n{LENGTHS}", "keys": ""}
        texts |= {"mask": "mask = 'nowhere.png'", "picture": "mask = 'own.png'"}
        for name, text in texts.items():
            Path(f"{name}.toml").write_text(text)
        write("ring.shadowinv", make_inversion((48, 48)), setup=SETUP)
        write("bare.shadowinv", invert(np.ones((8, 8))))
        write("two.shadowinv", make_fit(names=("B", "E")))
        write("damaged.shadowinv", make_fit().to_dataset().assign_attrs(verdict="perhaps"))
        axes = {axis: (axis, np.linspace(-0.2, 0.2, 9), {"units": "mm"}) for axis in "zyx"}
        field = ("z", "y", "x"), np.ones((9, 9, 9)), {"units": "T"}
        components = {f"B{axis}": field for axis in "xyz"}
        xr.Dataset(components, axes).to_netcdf("grid.nc", engine="h5netcdf")
    return folder


@pytest.mark.parametrize("command", MISTAKES)
def test_a_mistake_is_one_sentence(
    inputs: Path, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(inputs)
    refused(*shlex.split(command), names=MISTAKES[command])


@pytest.mark.parametrize(
    ("command", "text"), [(name, text) for name, texts in WRONG_FILES.items() for text in texts]
)
def test_a_mistake_in_a_file_is_one_sentence(
    inputs: Path, command: str, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(inputs)
    Path(command.split()[-1]).write_text(text)
    refused(*command.split(), names=WRONG_FILES[command][text])
