import os
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request

import mujoco
import numpy as np
import pytest

from estbench.errors import EstbenchError
from estbench.experiment import setup
from estbench.report.rendering import loopback, player, replay, scene, view, window
from estbench.report.rendering.player import Player, Settings

DENSITY = "channels.encoder.noise_density=0.001"


@pytest.fixture
def playing():
    made = Player("pendulum", "ekf", 3, ["simulation.duration=0.5"])
    yield made
    made.close()


def wait(playing):
    end = time.monotonic() + 20
    while playing.busy and time.monotonic() < end:
        playing.advance(0.0)
        time.sleep(0.01)
    assert not playing.busy


def test_time_passes_and_pauses(playing):
    playing.advance(0.25)
    assert playing.step == 25
    playing.command("pause")
    playing.advance(0.1)
    assert playing.step == 25
    playing.command("on")
    assert playing.time == pytest.approx(0.25 + player.FRAME)
    playing.command("back")
    playing.command("pause")
    playing.command("restart")
    assert playing.time == 0
    assert "run 3" in playing.lines()[0]
    playing.command("")  # any other key


def test_q_changes_the_estimate_but_not_the_truth(playing):
    before = playing.replay
    playing.advance(0.2)
    for _ in range(2):
        playing.command("q+")
    wait(playing)
    assert playing.settings == Settings(3, 1.0, 4.0)
    np.testing.assert_array_equal(playing.replay.truth, before.truth)
    assert np.trace(playing.replay.cov[-1]) > np.trace(before.cov[-1])
    assert playing.time == 0.2
    assert "Q x 4" in playing.lines()[3]


def test_noise_is_scaled_in_robot_and_filter(playing):
    prepared = setup.build(
        player.scaled(playing._scenario, playing._channels, Settings(0, noise=2.0))
    )
    for channel in prepared.channels:
        np.testing.assert_allclose(channel.cov, 4 * playing._channels[channel.name])
    playing.command("noise+")
    wait(playing)
    low, high = playing.replay.band
    assert playing.settings.noise == 2.0
    assert low < playing.replay.nees[1:].mean() < high


def test_noise_is_scaled_where_the_scenario_gives_a_density():
    made = Player("pendulum", "ekf", 0, ["simulation.duration=0.1", DENSITY])
    try:
        louder = setup.build(player.scaled(made._scenario, made._channels, Settings(0, noise=2.0)))
    finally:
        made.close()
    for channel in louder.channels:
        np.testing.assert_allclose(channel.cov, 4 * made._channels[channel.name], rtol=1e-12)


def test_the_next_run_follows(playing):
    playing.advance(1.0)
    wait(playing)
    assert (playing.replay.run, playing.time) == (4, 0.0)
    expected = replay.replay("pendulum", 4, "ekf", ["simulation.duration=0.5"])
    np.testing.assert_array_equal(playing.replay.estimate, expected.estimate)


def test_a_run_that_cannot_be_simulated_is_said(playing, monkeypatch):
    def fail(*_):
        raise EstbenchError("no such thing")

    monkeypatch.setattr(playing, "_simulate", fail)
    playing.command("q-")
    wait(playing)
    assert playing.lines()[-1] == "no such thing"
    assert playing.paused
    assert playing.settings.q == 1.0


def test_the_ghost_of_the_view_is_the_estimate(playing):
    playing.advance(0.3)
    model, estimate = playing.replay.model, playing.replay.estimate[playing.step]
    seen = mujoco.MjvScene(model, 100)
    view.Ghost(model).update(playing, seen)
    moving = [g for g in range(model.ngeom) if model.body_weldid[model.geom_bodyid[g]] != 0]
    assert seen.ngeom == len(moving) + 1
    data = mujoco.MjData(model)
    scene.pose(model, data, estimate)
    for i, g in enumerate(moving):
        np.testing.assert_allclose(seen.geoms[i].pos, data.geom_xpos[g], atol=1e-6)


def test_bad_input(monkeypatch):
    with pytest.raises(EstbenchError, match="numbered from 0"):
        view.watch("pendulum", run=-1)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(window.WindowError, match="without --window the view is served"):
        view.watch("pendulum", window=True)


def test_the_page_is_served_on_loopback_only(playing, capfd):
    pytest.importorskip("mujoco.studio.web_viewer")
    from mujoco.studio.web import web_server

    original = web_server.bind_public_socket
    bound = []

    def served():
        with loopback.only():
            sock = web_server.bind_public_socket("::", 0)
            bound.append(sock.getsockname())
            sock.close()

    thread = threading.Thread(target=served)
    thread.start()
    thread.join()
    assert bound[0][0] == "127.0.0.1"
    assert web_server.bind_public_socket is original


def test_two_viewers_that_start_at_once_take_two_ports(monkeypatch):
    """Another viewer takes the port between this one's binding it and its listening on it."""
    pytest.importorskip("mujoco.studio.web_viewer")
    from mujoco.studio.web import web_server

    original, others = web_server.bind_public_socket, []

    def overtaken(host, port=0):
        sock = original(host, port)
        if not others:
            others.append(original(host, sock.getsockname()[1]))
            others[0].listen()
        return sock

    monkeypatch.setattr(web_server, "bind_public_socket", overtaken)
    with loopback.only():
        mine = web_server.bind_public_socket("::")
        port = others[0].getsockname()[1]
        assert mine.getsockname()[1] > port
        with pytest.raises(RuntimeError, match=f"{port} is already in use"):
            web_server.bind_public_socket("::", port)
    for sock in (mine, *others):
        sock.close()


@pytest.mark.parametrize(
    ("headers", "answered"),
    [
        ({"Host": "127.0.0.1:8080"}, True), ({"Host": "localhost"}, True),
        ({"Host": "[::1]:80", "Origin": "http://localhost:8080"}, True), ({}, False),
        ({"Host": "evil.example:8080"}, False), ({"Host": "127.0.0.1.evil.example"}, False),
        ({"Host": "127.0.0.1", "Origin": "http://evil.example"}, False),
        ({"Host": "127.0.0.1", "Origin": "null"}, False), ({"Host": "["}, False),
    ],
)  # fmt: skip
def test_only_names_of_loopback_are_answered(headers, answered):
    assert loopback.allowed(headers) == answered


def fetch(url):
    """The page; its socket listens before the server answers."""
    with urllib.request.urlopen(url, timeout=30) as answer:
        return answer.read(5000)


def test_the_page_answers(tmp_path):
    pytest.importorskip("mujoco.studio.web_viewer")
    program = (
        "from estbench.commands.cli import main; import sys; "
        "sys.argv = ['estbench', 'view', 'pendulum', '-e', 'ekf']; main()"
    )
    command = [sys.executable, "-c", program]
    environment = {k: v for k, v in os.environ.items() if "DISPLAY" not in k}
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=environment, cwd=tmp_path
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert "http://127.0.0.1:" in line
        url = line.split()[2]
        assert b"<html" in fetch(url)
        for path in ("", "state"):  # the page, and a websocket at the same port
            named = urllib.request.Request(url + path, headers={"Host": "evil.example"})
            with pytest.raises(urllib.error.HTTPError, match="403"):
                fetch(named)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
    finally:
        process.kill()
