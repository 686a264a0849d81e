"""The command line: what it writes, and one clear line for every mistake."""

import contextlib
import importlib
import pkgutil
import sys

import pytest

import estbench.report
from estbench.commands import cli
from estbench.errors import MissingExtraError
from tests.report.conftest import needs_gl


def call(monkeypatch, capsys, *words):
    """Exit code, stdout and stderr of a command line."""
    monkeypatch.setattr(sys, "argv", ["estbench", *map(str, words)])
    try:
        cli.main()
        code = 0
    except SystemExit as stop:
        code = stop.code or 0
    out, err = capsys.readouterr()
    return code, out, err


def mistake(monkeypatch, capsys, *words):
    """The one line that a mistake gives."""
    code, _, err = call(monkeypatch, capsys, *words)
    lines = [line for line in err.splitlines() if line.startswith("estbench:")]
    assert code == 2
    assert len(lines) == 1
    assert "Traceback" not in err
    return lines[0]


def without(monkeypatch, package):
    """Hide a package, and forget the modules that imported it."""
    # All are imported first: one imported meanwhile would stay, bound to the forgotten ones.
    for module in pkgutil.iter_modules(estbench.report.__path__, "estbench.report."):
        with contextlib.suppress(MissingExtraError):
            importlib.import_module(module.name)
    for name in list(sys.modules):
        if name.partition(".")[0] == package or name.startswith("estbench.report."):
            monkeypatch.delitem(sys.modules, name)
            monkeypatch.delattr(estbench.report, name.rpartition(".")[2], raising=False)
    monkeypatch.setitem(sys.modules, package, None)


def test_report(store, monkeypatch, capsys, tmp_path):
    pytest.importorskip("plotly")
    path = tmp_path / "a.html"
    code, out, _ = call(monkeypatch, capsys, "report", store("two"), "-o", path, "--no-video")
    assert code == 0
    assert str(path) in out
    assert path.read_text().startswith("<!doctype html>")


def test_plot(store, monkeypatch, capsys, tmp_path):
    pytest.importorskip("matplotlib")
    path = tmp_path / "a.svg"
    code, _, _ = call(monkeypatch, capsys, "plot", store("bare"), "--what", "rmse", "-o", path)
    assert code == 0
    assert "<svg" in path.read_text()


@needs_gl
def test_video(store, monkeypatch, capsys, tmp_path):
    pytest.importorskip("PIL")
    words = ("--width", 64, "--height", 64, "--at", 0.5, "-o", tmp_path / "a.png")
    for source in (store("two"), store("bare"), "pendulum"):
        code, out, _ = call(monkeypatch, capsys, "video", source, "--run", 2, *words)
        assert code == 0
        assert "(1 frame)" in out


@pytest.mark.parametrize(
    ("package", "extra", "words"),
    [
        ("plotly", "report", ("report", "STORE")),
        ("jinja2", "report", ("report", "STORE")),
        ("matplotlib", "plot", ("plot", "STORE")),
        ("PIL", "video", ("video", "STORE", "-o", "a.gif")),
        ("imageio_ffmpeg", "video", ("video", "STORE", "-o", "a.mp4")),
    ],
)
def test_a_missing_extra_is_named(store, monkeypatch, capsys, package, extra, words):
    without(monkeypatch, package)
    words = [store("two") if word == "STORE" else word for word in words]
    line = mistake(monkeypatch, capsys, *words)
    assert f"pip install 'estbench[{extra}]'" in line


def test_no_extra_is_needed_for_the_other_commands(monkeypatch, capsys):
    for package in ("plotly", "jinja2", "matplotlib", "PIL", "imageio_ffmpeg"):
        without(monkeypatch, package)
    code, out, _ = call(monkeypatch, capsys, "list", "--json")
    assert code == 0
    assert "pendulum" in out


def test_mistakes(store, monkeypatch, capsys, tmp_path):
    for package in ("plotly", "matplotlib", "PIL"):
        pytest.importorskip(package)
    for words, expected in (
        (("report", tmp_path), "holds no data.zarr"),
        (("report", tmp_path / "none"), "holds no data.zarr"),
        # The path is refused before the folder is read, which is not there either.
        (("report", tmp_path / "none", "-o", tmp_path / "no" / "a.html"), "there is no folder"),
        (("plot", tmp_path / "none", "-o", tmp_path / "no" / "a.pdf"), "there is no folder"),
        (("video", "pendulm", "-o", tmp_path / "no" / "a.mp4"), "there is no folder"),
        (("report", store("two"), "-e", "kff"), "no estimator 'kff'"),
        (("report", store("two"), store("full")), "read stores of one robot together"),
        (("plot", store("bare"), "--what", "error"), "needs traces"),
        (("plot", store("two"), "--what", "nes"), "did you mean 'nees'"),
        (("video", store("two"), "--run", 50), "no finished run 50"),
        (("video", "pendulm"), "did you mean 'pendulum'"),
        (("video", store("two"), "-o", "a.avi"), "no such format"),
        (("video", store("two"), "--set", "simulation.seed=1"), "--set changes a scenario"),
        (("view", "pendulum", "-e", "kff"), "no estimator 'kff'"),
    ):
        assert expected in mistake(monkeypatch, capsys, *words)


def test_nothing_to_draw_with(store, monkeypatch, capsys, tmp_path):
    pytest.importorskip("plotly")
    pytest.importorskip("PIL")
    from estbench.report.rendering import render

    monkeypatch.setattr(render, "_candidates", lambda: [])
    monkeypatch.setattr(render.platform, "system", lambda: "Linux")
    line = mistake(monkeypatch, capsys, "video", "pendulum", "-o", tmp_path / "a.gif")
    assert "apt-get install libosmesa6" in line
    path = tmp_path / "a.html"
    code, _, err = call(monkeypatch, capsys, "report", store("two"), "-o", path)
    assert code == 0  # the report does without pictures, and says so
    assert "no picture of the robot" in err
    assert "There are no videos: nothing can be drawn here" in path.read_text()
