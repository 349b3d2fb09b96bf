"""Flags of the commands, the keys that --set takes, and the sentences about their values."""

from typing import Any

import pytest
from pydantic import BaseModel, ValidationError
from typer.main import get_command
from typer.testing import CliRunner

from helpers.command_line import shadowinv
from napari_shadowinv.cli import app
from napari_shadowinv.cli._settings import FIT_SECTIONS, INVERSION_SECTIONS, Sections, keys_of
from napari_shadowinv.cli._stack_commands import BATCH_SECTIONS, WATCH_SECTIONS
from napari_shadowinv.options import FitOptions

STORE = ("--out", "out.shadowinv.zarr")
COMMANDS: dict[str, tuple[tuple[str, ...], Sections]] = {
    "invert": (("shot.npy",), INVERSION_SECTIONS),
    "fit": (("shot.npy",), {**FIT_SECTIONS, "fit.options": FitOptions}),
    "batch": (("shot.npy", *STORE), BATCH_SECTIONS),
    "watch": ((".", *STORE), WATCH_SECTIONS),
}
CANDIDATES = ("-1", "1e9", "inf", "nonsense")


def flags_of(command: Any) -> set[str]:
    options = [each for each in command.params if each.param_type_name == "option"]
    return {flag for each in options for flag in each.opts if flag.startswith("--")}


def completed(words: str) -> list[str]:
    """Return what a shell proposes for the last word."""
    environment = {
        "_SHADOWINV_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split()) - 1),
    }
    result = CliRunner().invoke(app, [], prog_name="shadowinv", env=environment)
    return result.output.splitlines()


def bad_value(model: type[BaseModel], key: str) -> str | None:
    """Return a value that the model refuses, None if it takes all candidates."""
    for value in CANDIDATES:
        try:
            model.model_validate({key: value})
        except ValidationError as error:
            if any(key in details["loc"] for details in error.errors()):
                return value
    return None


def test_a_command_has_at_most_20_flags_and_all_have_60() -> None:
    commands = get_command(app).commands  # type: ignore[attr-defined]
    assert len(commands) == 13
    flags = {name: flags_of(command) for name, command in commands.items()}
    assert {name: len(each) for name, each in flags.items() if len(each) > 20} == {}
    assert len(set.union(*flags.values())) <= 60


@pytest.mark.parametrize(
    ("command", "section"),
    [(command, section) for command, (_, sections) in COMMANDS.items() for section in sections],
)
def test_bad_values_are_named_by_their_keys(command: str, section: str) -> None:
    arguments, sections = COMMANDS[command]
    for key in sections[section].model_fields:
        value = bad_value(sections[section], key)
        if value is None or key == "options":
            continue
        result = shadowinv(command, *arguments, "--set", f"{section}.{key}={value}")
        assert result.exit_code == 2, result.output
        assert f"{section}.{key} is " in result.stderr


def test_commands_keys_steps_and_sources_are_completed() -> None:
    assert completed("shadowinv inv") == ["invert"]
    keys = {f"{key}=" for key in keys_of(INVERSION_SECTIONS)}
    assert keys <= set(completed("shadowinv invert shot.npy --set o")) | set(
        completed("shadowinv invert shot.npy --set i")
    )
    assert completed("shadowinv invert shot.npy --set options.tol") == ["options.tolerance="]
    assert completed("shadowinv fit a.npy --set fit.options.sam") == ["fit.options.samples="]
    assert completed("shadowinv invert shot.npy --step butter") == ["butterworth"]
    assert completed("shadowinv batch shot.npy --source-from poly") == ["polynomial"]
