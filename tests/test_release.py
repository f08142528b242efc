"""The files of a release agree: one version, commands that exist, workflows that can be read."""

import re
import tomllib
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def test_the_version_is_the_same_everywhere():
    plugin = tomllib.loads((ROOT / "plugins" / "lerobot_policy_warmprior" / "pyproject.toml").read_text())
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    released = re.findall(r"^## \[(\d[\w.]*)\] - \d{4}-\d\d-\d\d$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert PROJECT["version"] == plugin["project"]["version"] == citation["version"] == released[0]


def test_workflows_run_commands_that_exist():
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M)
    for path in WORKFLOWS:
        jobs = yaml.safe_load(path.read_text())["jobs"]
        commands = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
        for command in commands:
            if command.startswith("make "):
                assert command.split()[1] in targets, command
            elif not command.startswith("gh "):
                assert (ROOT / command).is_file(), command


def test_ci_covers_the_pythons_that_are_declared():
    (ci,) = (yaml.safe_load(path.read_text()) for path in WORKFLOWS if path.name == "ci.yml")
    declared = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    assert ci["jobs"]["test"]["strategy"]["matrix"]["python"] == declared
