"""One environment for each package, made once and kept: `prepare`."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from compare.catalogue import Environment

_TELLING = re.compile(r"fatal:|CMake Error|not found|No matching distribution|\berror:", re.I)
_MOST_CHARACTERS = 160


@dataclass(frozen=True)
class Prepared:
    """An environment's interpreter, or the reason why there is none; earlier failures as notes."""

    python: str
    failure: str = ""
    note: str = ""


def prepare(name: str, environment: Environment, folder: Path) -> Prepared:
    """Make an environment unless a run before has made it or has failed to."""
    record = folder / f"{name}.json"
    if record.exists():
        return Prepared(**json.loads(record.read_text()))
    folder.mkdir(parents=True, exist_ok=True)
    prepared = _install(environment, folder / name)
    record.write_text(json.dumps(asdict(prepared)))
    return prepared


def _install(environment: Environment, place: Path) -> Prepared:
    base = find_python(environment.python)
    if base is None:
        return Prepared("", f"needs Python 3.{environment.python} or later, which is not here")
    subprocess.run([base, "-m", "venv", "--clear", str(place)], check=True)
    python = str(place / ("Scripts" if os.name == "nt" else "bin") / "python")
    failures: list[str] = []
    for requirements in environment.alternatives:
        done = subprocess.run(
            [python, "-m", "pip", "install", "--quiet", *requirements],
            capture_output=True,
            text=True,
        )
        if done.returncode == 0:
            return Prepared(python, note="; ".join(failures))
        package = next(word for word in requirements if not word.startswith("--"))
        failures.append(f"`pip install {package}`: {telling_line(done.stderr)}")
    return Prepared("", failures[0])


def telling_line(output: str) -> str:
    """Line of an installation's output that says best why it failed."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    telling = [line for line in lines if _TELLING.search(line) and "subprocess" not in line]
    line = (telling or lines or ["no message"])[0]
    return re.sub(r"\S*/(pip-\S+?)/", "", line)[:_MOST_CHARACTERS]


def find_python(minor: int) -> str | None:
    """Interpreter of Python 3 of at least a minor version; that which runs this if it will do."""
    if sys.version_info >= (3, minor):
        return sys.executable
    candidates = [shutil.which(f"python3.{number}") for number in range(minor, minor + 4)]
    if uv := shutil.which("uv", path=f"{Path(sys.executable).parent}{os.pathsep}{os.defpath}"):
        listing = subprocess.run(
            [uv, "python", "find", f">=3.{minor}"], capture_output=True, text=True
        )
        candidates.append(listing.stdout.strip())
    for candidate in filter(None, candidates):
        done = subprocess.run([candidate, "-c", "import venv, ensurepip"], capture_output=True)
        if done.returncode == 0:
            return candidate
    return None
