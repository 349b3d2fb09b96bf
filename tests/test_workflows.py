"""The workflows: limits, references, matrices and commands; `make lint` checks their form."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / ".github" / "workflows"
NAMES = ("containers", "docs", "lint", "nightly", "release", "tests", "wheels")


def loaded(path: Path) -> Any:
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    if True in content:  # YAML 1.1 takes the key "on" for true
        content["on"] = content.pop(True)
    return content


def workflow(name: str) -> Any:
    return loaded(FOLDER / f"{name}.yml")


def listed(needs: str | list[str]) -> list[str]:
    return [needs] if isinstance(needs, str) else needs


def steps_of(name: str) -> list[Any]:
    return [step for job in workflow(name)["jobs"].values() for step in job.get("steps", ())]


@pytest.mark.parametrize("name", NAMES)
def test_a_workflow_ends_in_time_reads_alone_and_finds_its_files(name: str) -> None:
    """Keys, needs, matrices and contexts are checked by `make lint`."""
    content = workflow(name)
    assert (content["name"], content["permissions"]) == (name, {"contents": "read"})
    for job in content["jobs"].values():
        if "uses" in job:
            assert "workflow_call" in loaded(ROOT / job["uses"])["on"]
        else:
            assert "timeout-minutes" in job
    scripts = re.findall(r"\.ci/[\w-]+", (FOLDER / f"{name}.yml").read_text("utf-8"))
    assert [path for path in scripts if not (ROOT / path).is_file()] == []

    def artifacts(job: Any, action: str) -> set[str]:
        steps = job.get("steps", ())
        if "uses" in job:
            called = loaded(ROOT / job["uses"])["jobs"].values()
            steps = [step for inner in called for step in inner["steps"]]
        uses = f"actions/{action}-artifact@"
        used = (step for step in steps if step.get("uses", "").startswith(uses))
        return {step["with"]["name"] for step in used}

    # What a job downloads was uploaded by one before.
    for job in content["jobs"].values():
        if "uses" not in job:
            before = [content["jobs"][need] for need in listed(job.get("needs", []))]
            ready = {name for needed in before for name in artifacts(needed, "upload")}
            assert artifacts(job, "download") <= ready


def test_the_tests_run_on_every_system_python_and_binding() -> None:
    job = workflow("tests")["jobs"]["tests"]
    matrix = job["strategy"]["matrix"]
    classifiers = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"][
        "classifiers"
    ]
    pythons = [
        match[1] for name in classifiers if (match := re.search(r"Python :: (3\.\d+)$", name))
    ]
    assert set(matrix["os"]) == {"ubuntu-latest", "macos-latest", "windows-latest"}
    assert matrix["python"] == pythons
    assert matrix["qt"] == ["pyqt6", "pyside6"]
    assert len(matrix) == 3
    assert job["env"] == dict.fromkeys(("QT_API", "PYTEST_QT_API"), "${{ matrix.qt }}")


def test_an_action_has_one_commit_in_all_workflows_and_its_version_beside_it() -> None:
    text = "".join(path.read_text("utf-8") for path in FOLDER.iterdir())
    # A tag can be moved, a commit cannot.
    pins = re.findall(r"uses: ([\w-]+/[\w-]+)@([0-9a-f]{40}) # v\d+\.\d+", text)
    assert len(set(pins)) == len(dict(pins)) == 6
    assert text.count("uses: ") == len(pins) + text.count("uses: ./.github")


def test_the_containers_are_built_and_run_as_the_documentation_says() -> None:
    runs = "\n".join(step.get("run", "") for step in steps_of("containers"))
    page = (ROOT / "docs" / "batch.md").read_text("utf-8")
    (section,) = re.findall(r"### In a container\n(.*?)\n##", page, re.DOTALL)
    commands = re.findall(r"^    (.*)$", section, re.MULTILINE)
    assert len(commands) == 4
    for command in commands:
        assert command in runs


def test_a_release_is_published_for_a_tag_and_without_a_secret() -> None:
    content = workflow("release")
    assert content["on"] == {"push": {"tags": ["v*"]}}
    publish = content["jobs"]["publish"]
    assert publish["permissions"] == {"id-token": "write"}
    assert set(publish["needs"]) == {"version", "wheels"}
    assert publish["environment"]["name"] == "pypi"
    last = publish["steps"][-1]
    assert last["uses"].startswith("pypa/gh-action-pypi-publish@")
    assert "with" not in last
    assert "secrets." not in (FOLDER / "release.yml").read_text("utf-8")
    jobs = [job for name, job in content["jobs"].items() if name != "publish"]
    assert not any("permissions" in job for job in jobs)
