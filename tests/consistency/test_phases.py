import numpy as np

from estbench.consistency.fields import PHASES
from estbench.consistency.phases import EVENTS, by_phase, events, phases

T, F = True, False


def test_events_are_at_the_first_instant_of_the_new_state():
    touching = np.array([T, T, F, F, T, T, T])[:, None, None]
    slipping = np.array([F, T, F, F, T, F, T])[:, None, None]
    limited = np.array([F, F, F, T, T, F, F])[:, None, None]
    found = events(touching, slipping, limited)[:, 0]
    at = {name: np.flatnonzero(found[:, i]).tolist() for i, name in enumerate(EVENTS)}
    # The slip of instant 4 is part of its touch-down.
    assert at == {"touch-down": [4], "lift-off": [2], "slip": [1, 6], "limit": [3, 5]}


def test_bodies_count_each():
    touching = np.zeros((3, 1, 2), bool)
    touching[1:, 0, 0] = touching[:2, 0, 1] = True
    found = events(touching, np.zeros_like(touching), np.zeros((3, 1, 0), bool))[:, 0]
    np.testing.assert_array_equal(found[:, :2], [[F, F], [T, F], [F, T]])


def test_each_instant_is_in_one_phase_by_a_loop():
    rng = np.random.default_rng(3)
    times = np.zeros(61)
    times[1:] = np.cumsum(rng.uniform(0.005, 0.02, 60))
    touching, event = rng.random((61, 8)) < 0.5, rng.random((61, 8)) < 0.06
    found, window = phases(times, touching, event, 0.03), 0.03
    np.testing.assert_array_equal(found.sum(axis=-1), 1)
    for run in range(8):
        at = times[event[:, run]]
        for k, t in enumerate(times):
            near = any(abs(t - other) <= window for other in at)
            wanted = 2 if near else int(touching[k, run])
            assert found[k, run].argmax() == wanted


def test_the_window_counts_whole_steps_and_zero_is_the_event_alone():
    times = np.arange(8) / 10
    event = (np.arange(8) == 4)[:, None]
    none = np.zeros((8, 1), bool)
    for steps in (0, 1, 3):
        found = phases(times, none, event, steps * 0.1)[:, 0, 2]
        assert np.flatnonzero(found).tolist() == list(range(4 - steps, min(8, 5 + steps)))


def record(runs=40, n=3, seed=0):
    rng = np.random.default_rng(seed)
    steps = np.repeat([[5, 10, 15]], runs, axis=0)
    steps[0] = 0, 15, 15
    anees, mse = 1 + 0.1 * rng.random((runs, 3)), rng.random((runs, 3, n))
    anees[0, 0], mse[0, 0] = np.nan, np.nan
    anis = anees.copy()
    anis[1, 0] = np.nan  # nothing arrived
    diverged = np.zeros(runs, bool)
    diverged[-1] = True
    anees[-1] = 1e6
    return {"phase_steps": steps, "anees_by_phase": anees, "anis_by_phase": anis,
            "mse_by_phase": mse, "diverged": diverged}  # fmt: skip


def test_statistics_are_over_the_runs_that_have_the_phase_and_did_not_diverge():
    found = record()
    flight, stance, event = by_phase(found, ("m", "m", "rad"), 0.95)
    assert [p.name for p in (flight, stance, event)] == list(PHASES)
    np.testing.assert_allclose(flight.share, 39 * 5 / (40 * 30))
    np.testing.assert_allclose(flight.values[0].value, found["anees_by_phase"][1:-1, 0].mean())
    np.testing.assert_allclose(flight.values[1].value, found["anis_by_phase"][2:-1, 0].mean())
    square = found["mse_by_phase"][:-1, 2]
    np.testing.assert_allclose(event.rmse["m"].value ** 2, square[:, :2].sum(axis=1).mean())
    np.testing.assert_allclose(event.rmse["rad"].value ** 2, square[:, 2].mean())
    np.testing.assert_allclose(stance.values[0].value, found["anees_by_phase"][:-1, 1].mean())


def test_one_phase_alone_is_no_table():
    found = record()
    found["phase_steps"] = np.repeat([[30, 0, 0]], 40, axis=0)
    assert by_phase(found, ("m", "m", "rad"), 0.95) == ()
    del found["phase_steps"]  # a store of an earlier version
    assert by_phase(found, ("m", "m", "rad"), 0.95) == ()
