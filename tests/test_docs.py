"""Every block of the documentation runs.

```python blocks of one page run in order, in one namespace, or each by itself (`ALONE`).
In ```console and ```bash blocks the `estbench ...` commands run, `estbench run` cut short.
A ```toml block is a scenario or part of one.
A block after a line that ends in "`FILE`:" is that file, there for the page's commands.
A block preceded by `<!-- no-test -->` is skipped.
The commands of a page of `TOGETHER` run in order, in one folder.
"""

import doctest
import importlib
import pkgutil
import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest

import estbench
from estbench.commands import cli
from estbench.errors import MissingExtraError
from estbench.montecarlo import run as experiment
from estbench.scenario.schema import Scenario

ROOT = Path(__file__).parents[1]
PAGES = [p for p in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))) if p.is_file()]
ALONE = ("estimators.md",)
"""Pages of which each block runs by itself."""
TOGETHER = ("start.md",)
"""Pages of which each command needs those before it."""
FENCE = re.compile(
    r"^(?P<skip><!-- no-test -->\s*\n)?(?P<indent> *)```(?P<kind>\w*)[^\n]*\n(?P<text>.*?)^ *```",
    re.MULTILINE | re.DOTALL,
)
NAMED = re.compile(
    r"`(?P<name>[\w.]+\.(?:xml|toml))`:\n\n```(?:xml|toml)\n(?P<text>.*?)^```",
    re.MULTILINE | re.DOTALL,
)


def blocks(page, *kinds):
    """(line, text) of the page's blocks of those kinds."""
    text = page.read_text(encoding="utf-8")
    for block in FENCE.finditer(text):
        if block["kind"] in kinds and not block["skip"]:
            lines = block["text"].splitlines()
            inside = "\n".join(line.removeprefix(block["indent"]) for line in lines)
            yield text.count("\n", 0, block.start("text")), inside + "\n"


def commands(page):
    """Each `estbench` command: what follows `$ `, up to a comment, a pipe or the next command."""
    for kind in ("console", "bash", "sh"):
        for line, text in blocks(page, kind):
            for typed in text.replace("\\\n", " ").splitlines():
                if kind == "console" and not typed.startswith("$ "):
                    continue
                for part in re.split(r"&&|;|\|", typed.removeprefix("$ ")):
                    words = shlex.split(part, comments=True)
                    if words[:1] == ["estbench"]:
                        yield line, words


COMMANDS = [
    pytest.param(page, words, id=f"{page.name}:{line}: {shlex.join(words)}")
    for page in PAGES
    if page.name not in TOGETHER
    for line, words in commands(page)
]


def test_blocks_are_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "text\n```python\na = 1\n```\n<!-- no-test -->\n```python\n1 / 0\n```\n"
        "- item\n  ```python\n  if a:\n      b = 2\n  ```\n"
        "```console\n$ pip install . && estbench run cartpole -e 'a b' \\\n  --seed 1  # so\nout\n"
        "estbench not typed\n$ estbench list | head\n```\n```bash\nestbench check cartpole\n```\n"
    )
    assert list(blocks(page, "python")) == [(2, "a = 1\n"), (10, "if a:\n    b = 2\n")]
    assert [" ".join(words) for _, words in commands(page)] == [
        "estbench run cartpole -e a b --seed 1", "estbench list", "estbench check cartpole",
    ]  # fmt: skip


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_blocks(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    namespace = {"__name__": "__docs__"}
    for line, text in blocks(page, "python"):
        if page.name in ALONE:
            namespace = {"__name__": "__docs__"}
        exec(compile("\n" * line + text, str(page), "exec"), namespace)


@pytest.mark.parametrize(("page", "words"), COMMANDS)
def test_commands(page, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for file in NAMED.finditer(page.read_text(encoding="utf-8")):
        (tmp_path / file["name"]).write_text(file["text"], encoding="utf-8")
    short = ["--runs", "4", "--duration", "0.2"] if words[1] == "run" else []
    monkeypatch.setattr(sys, "argv", [*words, *short])
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    assert not exit_.value.code, capsys.readouterr().err


@pytest.mark.parametrize("page", [p for p in PAGES if p.name in TOGETHER], ids=lambda p: p.name)
def test_commands_together(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    found = [words for _, words in commands(page)]
    assert len(found) > 3
    for words in found:
        short = ["--runs", "3"] if words[1] in ("run", "tune") else []
        short += ["--duration", "0.2"] if short else []
        short += ["--iterations", "1"] if words[1] == "tune" else []
        monkeypatch.setattr(sys, "argv", [*words, *short])
        with pytest.raises(SystemExit) as exit_:
            cli.main()
        assert not exit_.value.code, (words, capsys.readouterr().err)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_toml_blocks(page):
    for _, text in blocks(page, "toml"):
        data = tomllib.loads(text)
        if "project" not in data:  # but a package's pyproject.toml
            scenario = {"name": "part", "model": {"path": "robot.xml"}} | data
            Scenario.model_validate(scenario)
            added = {name for name, c in scenario.get("channels", {}).items() if "add" in c}
            assert added <= set(scenario.get("sensors", added)), "added, and not in use"


def test_the_channels_of_the_documentation_are_those_of_a_robot(tmp_path, monkeypatch):
    """All that docs/sensors.md says of channels, at once, on the quadrotor."""
    page = ROOT / "docs" / "sensors.md"
    scenario = experiment.resolve("quadrotor", duration=1.0, runs=2).model_dump(exclude_none=True)
    for _, text in blocks(page, "toml"):
        for section, given in tomllib.loads(text).items():
            for key, value in given.items():
                merged = isinstance(value, dict) and section == "channels"
                scenario[section][key] = scenario[section].get(key, {}) | value if merged else value
    functions = next(text for _, text in blocks(page, "python") if "def thrust" in text)
    (tmp_path / "my_robot.py").write_text(functions)
    monkeypatch.chdir(tmp_path)
    results = estbench.run(Scenario.model_validate(scenario))
    assert {"ekf", "ukf", "with_bias"} == {s.label for s in results.summaries}
    assert not any(s.failures for s in results.summaries)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_to_files(page):
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert (page.parent / target).exists(), f"{page.name}: {target}"


def modules():
    found = (m.name for m in pkgutil.walk_packages(estbench.__path__, "estbench."))
    return ["estbench", *(name for name in found if not name.startswith("estbench.assets"))]


@pytest.mark.parametrize("name", modules())
def test_docstrings(name):
    try:
        module = importlib.import_module(name)
    except (ImportError, MissingExtraError) as error:
        pytest.skip(f"an optional dependency is missing: {error}")
    assert doctest.testmod(module).failed == 0
