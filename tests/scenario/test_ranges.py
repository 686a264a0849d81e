"""Values of a wrong type, or that no robot has, are refused with their key; others are not."""

import pytest

from estbench.errors import ScenarioError
from estbench.scenario.load import load


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("simulation.duration='1'", r"simulation\.duration: .*valid number, got '1'"),
        ("simulation.duration=true", r"simulation\.duration: .*got True"),
        ("simulation.runs=10.0", r"simulation\.runs: .*valid integer, got 10\.0"),
        ("simulation.runs=true", r"simulation\.runs: .*got True"),
        ("initial.std=true", r"initial\.std: Input should be a valid number, got True$"),
        ("initial.std={hinge='1'}", r"pendulum: initial\.std\.hinge: .*number, got '1'$"),
        ("process_noise.schedule=[['1', 2]]", r"pendulum: process_noise\.schedule\.0\.0: .*'1'$"),
        ("channels.encoder.enabled=1", r"channels\.encoder\.enabled"),
        ("model.timestep=1e-9", r"model\.timestep: .*1e-09"),
        ("filter.timestep=1e-12", r"filter\.timestep: "),
        ("simulation.duration=1e300", r"simulation\.duration: .*1000000000, got 1e\+300"),
        ("channels.encoder.noise=1e-200", r"channels\.encoder\.noise: use 0 or a magnitude from"),
        ("channels.encoder.noise=[1e200]", r"channels\.encoder\.noise\.0: use 0 or a magnitude"),
        ("channels.encoder.noise_density=1e-300", r"channels\.encoder\.noise_density: use 0"),
        ("filter.process_noise_scale=1e300", r"filter\.process_noise_scale: use 0 or a magnitude"),
        ("process_noise.density={'*'=1e-90}", r"process_noise\.density\.\*: use 0 or a magnitude"),
        ("initial.cov=[[1.0, 0.0], [0.0, 1e-90]]", r"initial\.cov: entry \(1, 1\) is 1e-90; use 0"),
        ("process_noise.matrix=[[1, 2], [3]]", r"process_noise\.matrix: rows of 2, 1 entries"),
        ('filter.set."body_mass.pole"=1e99', r"filter\.set\.body_mass\.pole: use 0 or a magnitude"),
        ("channels.encoder.latency=1e12", r"channels\.encoder\.latency: .*1000000000"),
        ("simulation.runs=1\nfoo=2", r"has a line break; use one --set for each key"),
        ("simulation.runs\n=1", "has a line break"),
    ],
)
def test_it_is_refused(override, message):
    with pytest.raises(ScenarioError, match=message) as caught:
        load("pendulum", [override])
    assert len(str(caught.value).splitlines()) == 1


def test_what_a_robot_can_have_is_read():
    scenario = load(
        "pendulum",
        [
            "simulation.duration=1", "initial.std=0", "channels.encoder.noise=1e-12",
            "process_noise.density=1e-24", "process_noise.schedule=[[1, 2], [9.0, 3.5]]",
            "initial.cov=[[1.0, 1e-99], [1e-99, 1.0]]", "filter.process_noise_scale=1e12",
        ],
    )  # fmt: skip
    assert scenario.simulation.duration == 1.0
    assert scenario.process_noise.schedule == [(1.0, 2.0), (9.0, 3.5)]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("filter.set.body_mass.link1=2", r'filter\.set: quote a key with a dot: set\."body_mass\.'),
        (
            "truth.draw.body_mass.link1.std=2",
            r'truth\.draw: quote a .*: draw\."body_mass\.link1',
        ),
        (
            "filter.set.body_mas.link1=2",
            r"no model field 'body_mas' \(did you mean 'body_mass'.*; quote a key with a dot",
        ),
    ],
)
def test_a_key_with_a_dot_without_quotes_is_explained(override, message):
    with pytest.raises(ScenarioError, match=message):
        load("pendulum", [override])
