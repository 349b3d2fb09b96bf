"""Flags of the commands, and the sentences about their values."""

from functools import cache
from typing import Any

import pytest
from pydantic import BaseModel, ValidationError
from typer.main import get_command

from helpers.command_line import shadowinv
from napari_shadowinv.cli import app
from napari_shadowinv.cli._flags import _annotation_name, flag_names
from napari_shadowinv.options import FitChoices, FitOptions, Instrument, InversionOptions
from napari_shadowinv.pipeline.run_options import RunOptions, WatchOptions
from napari_shadowinv.preprocessing import ESTIMATES, FIT_STEPS, STEPS, Step

INVERSION = (InversionOptions, Instrument, *STEPS.values(), *ESTIMATES.values())
STORE = ("--out", "out.shadowinv.zarr")
COMMANDS: dict[str, tuple[tuple[str, ...], tuple[type[BaseModel], ...]]] = {
    "invert": (("shot.npy",), INVERSION),
    "fit": (("shot.npy",), (FitOptions, FitChoices, Instrument, *FIT_STEPS.values())),
    "batch": (("shot.npy", *STORE), (RunOptions, *INVERSION)),
    "watch": ((".", *STORE), (WatchOptions, *INVERSION)),
}
CANDIDATES: dict[str, tuple[Any, ...]] = {
    "int": (-1, 10**9),
    "float": (-1.0, 1e9, float("inf")),
    "str": ("nonsense",),
}


@cache
def kinds_of_flags(command: str) -> dict[str, str]:
    """Return the type of the value of each flag of a command."""
    parameters = get_command(app).commands[command].params  # type: ignore[attr-defined]
    options = [each for each in parameters if each.param_type_name == "option"]
    return {flag: _annotation_name(each) for each in options for flag in each.opts}


def bad_value(model: type[BaseModel], key: str, kind: str) -> Any:
    """Return a value that the model refuses, None if it takes all candidates."""
    for value in CANDIDATES.get(kind, ()):
        try:
            model.model_validate({key: value})
        except ValidationError as error:
            if any(key in details["loc"] for details in error.errors()):
                return value
    return None


def needed_flags(model: Any) -> dict[str, Any]:
    """Return the flags without which those of a step or an estimate are refused."""
    if issubclass(model, Step) and model.primary:
        primary = model.parameters()[model.primary]
        return {flag_names(model)[model.primary]: primary.get_default()}
    return {"--source-from": model.name()} if model in ESTIMATES.values() else {}


@pytest.mark.parametrize(
    ("command", "model"),
    [(command, model) for command, (_, models) in COMMANDS.items() for model in models],
)
def test_bad_values_are_named_by_their_flags(
    command: str, model: type[BaseModel], tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    kinds = kinds_of_flags(command)
    for key, flag in flag_names(model).items():
        value = bad_value(model, key, kinds.get(flag, ""))
        if value is None:
            continue
        flags = needed_flags(model) | {flag: value}
        texts = [text for pair in flags.items() for text in pair]
        result = shadowinv(command, *COMMANDS[command][0], *texts)
        assert result.exit_code == 2, result.output
        assert f"{flag} is " in result.stderr
        assert f"'{key}'" not in result.stderr


@pytest.mark.parametrize("command", COMMANDS)
def test_each_flag_with_a_number_is_of_a_model_or_of_the_command(command: str) -> None:
    named = {flag for model in COMMANDS[command][1] for flag in flag_names(model).values()}
    numbers = {flag for flag, kind in kinds_of_flags(command).items() if kind in ("int", "float")}
    assert numbers & named
    assert numbers <= named


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            "invert shot.npy --solver lbfgs --boundary free",
            "--solver is 'lbfgs' and --boundary is 'free', expected",
        ),
        (
            "invert shot.npy --noise-level 2 --units-per-quantum 3",
            "--noise-level is 2 and --units-per-quantum is 3, expected one",
        ),
        ("fit shot.npy --psf 1 --source-size 1e-6", "received --psf, a point spread in px, and"),
        (
            "invert shot.npy --options o.toml --n-sites 2",
            "--n-sites is 2: it must be at least 4; 'floor' in o.toml is 7: it",
        ),
        ("invert shot.npy --options o.toml --floor 8", "--floor is 8.0: it must be less than 1"),
    ],
)
def test_contradictions_name_flags_and_keys_of_files(
    arguments: str, sentence: str, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "o.toml").write_text("floor = 7\n")
    result = shadowinv(*arguments.split())
    assert result.exit_code == 2
    assert sentence in result.stderr
