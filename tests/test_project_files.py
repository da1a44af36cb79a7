"""Files for people and for other machines: they can be read, and what they name and call is there.

No container and no hosted CI runs here. What these tests show is that nothing in the files is misspelt or out of date.
"""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
TEMPLATES = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
TARGETS = set(re.findall(r"^([a-z0-9-]+):", (ROOT / "Makefile").read_text("utf-8"), re.M))


def read(name: str) -> dict[Any, Any]:
    """A YAML file of the repository."""
    found = yaml.safe_load((ROOT / name).read_text("utf-8"))
    assert isinstance(found, dict)
    return found


def made(text: str) -> set[str]:
    """The targets that a text has `make` build."""
    return set(re.findall(r"\bmake ([a-z0-9-]+)", re.sub(r"#.*", "", text)))


def test_the_citation_is_of_this_version() -> None:
    citation = read("CITATION.cff")
    assert citation["cff-version"] == "1.2.0"
    assert (citation["version"], citation["license"]) == (PROJECT["version"], PROJECT["license"])
    assert [author["name"] for author in citation["authors"]] == [author["name"] for author in PROJECT["authors"]]


def test_the_workflow_tests_the_pythons_that_the_package_names() -> None:
    jobs = read(".github/workflows/ci.yml")["jobs"]
    named = {c.rpartition(" ")[2] for c in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", c)}
    for job in ("test", "wheel-flies"):
        matrix = jobs[job]["strategy"]["matrix"]
        assert matrix["python"] == ["3.11", "3.12", "3.13", "3.14"]
        assert named == set(matrix["python"])
        assert matrix["os"] == ["ubuntu-latest", "macos-latest", "windows-latest"]
    assert PROJECT["requires-python"] == ">=" + min(named)


def test_the_workflow_calls_what_is_there() -> None:
    jobs = read(".github/workflows/ci.yml")["jobs"]
    steps = [step for job in jobs.values() for step in job["steps"]]
    assert all(("run" in step) != ("uses" in step) for step in steps)
    commands = "\n".join(step.get("run", "") for step in steps)
    assert made(commands) == {"lint", "docs", "test-lowest"}
    assert made(commands) <= TARGETS
    assert all((ROOT / path).exists() for path in re.findall(r"pytest (tests/\S+)", commands))
    assert all(need in jobs for job in jobs.values() for need in [job.get("needs", "wheel")])


def test_the_dockerfile_runs_the_two_commands() -> None:
    lines = (ROOT / "Dockerfile").read_text("utf-8").replace("\\\n", " ").splitlines()
    steps = [line.split(" ", 1) for line in lines if line and not line.startswith("#")]
    assert {word for word, _ in steps} <= {"FROM", "RUN", "ARG", "ENV", "WORKDIR", "COPY", "CMD"}
    assert ["RUN", "make sortie"] in steps
    assert json.loads(dict(steps)["CMD"]) == ["make", "test"]
    assert {"sortie", "test"} <= TARGETS
    assert re.search(r"python:3\.1[1-9]", dict(steps)["FROM"])


def test_the_devcontainer_installs_the_project() -> None:
    container = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text("utf-8"))
    assert made(container["postCreateCommand"]) == {"sortie"}
    assert (ROOT / ".devcontainer" / container["build"]["dockerfile"]).resolve() == ROOT / "Dockerfile"


@pytest.mark.parametrize("path", [path for path in TEMPLATES if path.stem != "config"], ids=lambda p: p.stem)
def test_an_issue_template_asks_each_question_once(path: Path) -> None:
    template = yaml.safe_load(path.read_text("utf-8"))
    assert template.keys() == {"name", "description", "labels", "body"}
    assert {field["type"] for field in template["body"]} <= {"textarea", "input"}
    names = [field["id"] for field in template["body"]]
    assert len(names) == len(set(names))
    assert all(field["attributes"]["label"] for field in template["body"])


@pytest.mark.parametrize(
    "place",
    [".github/workflows/ci.yml", ".devcontainer/devcontainer.json", "Dockerfile", "README.md", "CONTRIBUTING.md"],
)
def test_no_registry_is_named(place: str) -> None:
    """Who installs chooses where from."""
    assert (ROOT / place).is_file()
    hosts = r"https?://[^\s\"`]*/(?:whl|simple)\b|pytorch\.org|\b(?:mcr|ghcr|quay)\.[a-z]+"
    assert re.findall(hosts, (ROOT / place).read_text("utf-8")) == []
