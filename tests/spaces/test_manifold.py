import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estbench.errors import DimensionError
from estbench.robots.layout import sensor_space, state_space
from estbench.spaces import rotation
from estbench.spaces.manifold import Manifold, carry, product
from tests.helpers import ZOO, random_cov, random_states, zoo_model

SPACES = {name: state_space(zoo_model(name)) for name in ZOO}
seeds = st.integers(0, 2**32 - 1)
every_model = pytest.mark.parametrize("name", ZOO)


def tangent(space, seed, shape=(), limit=0.99 * np.pi):
    """Random tangent vectors whose rotation vectors are shorter than `limit`, some of them tiny."""
    rng = np.random.default_rng(seed)
    delta = rng.uniform(-1, 1, (*shape, space.n)) * 10.0 ** rng.uniform(-9, 0)
    return delta * limit / np.sqrt(3.0)


def point(space, seed, shape=()):
    origin = np.zeros(space.nx)
    origin[space.quaternions[:, 0]] = 1.0
    rng = np.random.default_rng(seed)
    return space.plus(origin, 2.0 * rng.standard_normal((*shape, space.n)))


def flip(space, x):
    out = x.copy()
    for start in space.quaternions[:, 0]:
        out[..., start : start + 4] *= -1
    return out


@every_model
@given(seed=seeds)
def test_plus_is_mj_integrate_pos(name, seed):
    model, space = zoo_model(name), SPACES[name]
    x, delta = point(space, seed), tangent(space, seed, limit=6.0)
    qpos = x[: model.nq].copy()
    mujoco.mj_integratePos(model, qpos, delta[: model.nv], 1.0)
    out = space.plus(x, delta)
    np.testing.assert_allclose(out[: model.nq], qpos, atol=1e-12)
    np.testing.assert_allclose(out[model.nq :], x[model.nq :] + delta[model.nv :], atol=1e-12)


@every_model
@given(seed=seeds)
def test_minus_is_mj_differentiate_pos(name, seed):
    model, space = zoo_model(name), SPACES[name]
    x, y = point(space, seed), point(space, seed + 1)
    expected = np.empty(model.nv)
    mujoco.mj_differentiatePos(model, expected, 1.0, y[: model.nq], x[: model.nq])
    out = space.minus(x, y)
    np.testing.assert_allclose(out[: model.nv], expected, atol=1e-12)
    np.testing.assert_allclose(out[model.nv :], x[model.nq :] - y[model.nq :], atol=1e-12)


@every_model
@given(seed=seeds)
def test_axioms(name, seed):
    space = SPACES[name]
    x, y, delta = point(space, seed), point(space, seed + 1), tangent(space, seed)
    np.testing.assert_allclose(space.plus(x, np.zeros(space.n)), x, atol=1e-15)
    np.testing.assert_allclose(space.minus(space.plus(x, delta), x), delta, atol=1e-12)
    back = space.plus(x, space.minus(y, x))
    np.testing.assert_allclose(space.minus(back, y), 0, atol=1e-12)


@every_model
@given(seed=seeds)
def test_the_tangent_bounds_the_distance(name, seed):
    space, x = SPACES[name], point(SPACES[name], seed)
    a, b = tangent(space, seed, (2,))
    apart = np.linalg.norm(space.minus(space.plus(x, a), space.plus(x, b)))
    assert apart <= np.linalg.norm(a - b) * (1 + 1e-9) + 1e-12


@every_model
@given(seed=seeds)
def test_q_and_minus_q_are_one_state(name, seed):
    space, x, y = SPACES[name], point(SPACES[name], seed), point(SPACES[name], seed + 1)
    np.testing.assert_allclose(space.minus(flip(space, x), y), space.minus(x, y), atol=1e-12)
    np.testing.assert_allclose(space.minus(x, flip(space, y)), space.minus(x, y), atol=1e-12)


@every_model
@given(seed=seeds)
def test_reset_jacobian_against_differences(name, seed):
    space, x, delta, step = (
        SPACES[name],
        point(SPACES[name], seed),
        tangent(SPACES[name], seed),
        1e-6,
    )
    e = step * np.eye(space.n)
    end = space.plus(x, delta)
    up, down = (space.minus(space.plus(x, delta + s * e), end) for s in (1, -1))
    expected = (up - down).T / (2 * step)
    np.testing.assert_allclose(space.reset_jacobian(delta), expected, atol=1e-8)


@every_model
@given(seed=seeds)
def test_weighted_mean_balances_the_residuals(name, seed):
    space, rng = SPACES[name], np.random.default_rng(seed)
    center = point(space, seed)
    points = space.plus(center, 0.5 * rng.standard_normal((7, space.n)))
    weights = rng.uniform(0.1, 1.0, 7)
    weights /= weights.sum()
    mean = space.mean(points, weights)
    np.testing.assert_allclose(weights @ space.minus(points, mean), 0, atol=1e-11)
    stacked = space.mean(np.stack([points, points[::-1]]), np.stack([weights, weights[::-1]]))
    np.testing.assert_allclose(space.minus(stacked, mean), 0, atol=1e-10)


def test_mean_of_two_rotations_is_half_way_even_across_signs():
    space = SPACES["contact"]
    x = point(space, 0)
    delta = tangent(space, 1)
    points = np.stack([x, flip(space, space.plus(x, delta))])
    mean = space.mean(points, np.array([0.5, 0.5]))
    np.testing.assert_allclose(space.minus(mean, x), 0.5 * delta, atol=1e-12)


def test_mean_of_a_row_does_not_depend_on_its_neighbours():
    space, rng = SPACES["joints"], np.random.default_rng(0)
    weights = np.full(5, 0.2)
    near = space.plus(point(space, 0), 1e-3 * rng.standard_normal((5, space.n)))
    wide = space.plus(point(space, 1), 0.8 * rng.standard_normal((5, space.n)))
    both = space.mean(np.stack([near, wide]), weights)
    np.testing.assert_array_equal(both[0], space.mean(near[None], weights)[0])


def test_transport_conjugates_with_the_reset_jacobian():
    space, rng = SPACES["joints"], np.random.default_rng(0)
    cov, delta = random_cov(rng, space.n, 2), rng.standard_normal((2, space.n))
    J = space.reset_jacobian(delta)
    for i in range(2):
        expected = J[i] @ cov[i] @ J[i].T
        np.testing.assert_allclose(space.transport(cov, delta)[i], expected, atol=1e-12)
    assert not np.allclose(space.transport(cov, delta), cov)


def test_carry_against_differences():
    """(y ⊞ H e) ⊞ (c + C e), differenced in e, in the tangent at y ⊞ c."""
    space, rng = SPACES["joints"], np.random.default_rng(3)
    y, shift = point(space, 1, (2,)), tangent(space, 2, (2,)) + 0.3
    H, C = rng.standard_normal((2, space.n, 4))
    slope_H, slope_C = carry(space, shift, H, C)
    value = space.plus(y, shift)
    for column, e in enumerate(1e-6 * np.eye(4)):
        for slope, moved in (
            (slope_H, lambda s, e=e: space.plus(space.plus(y, s * H @ e), shift)),
            (slope_C, lambda s, e=e: space.plus(y, shift + s * C @ e)),
        ):
            ahead, behind = (space.minus(moved(s), value) for s in (1, -1))
            expected = (ahead - behind) / 2e-6
            np.testing.assert_allclose(slope[..., column], expected, atol=1e-7)


def test_broadcasting_over_leading_axes():
    model, space = zoo_model("joints"), SPACES["joints"]
    x, _ = random_states(model, 3)
    delta = np.random.default_rng(1).standard_normal((5, space.n))
    out = space.plus(x[:, None], delta)
    assert out.shape == (3, 5, space.nx)
    np.testing.assert_array_equal(out[2, 4], space.plus(x[2], delta[4]))
    np.testing.assert_array_equal(space.minus(out, x[:, None])[2, 4], space.minus(out[2, 4], x[2]))


def test_a_nan_point_stays_nan():
    model = zoo_model("joints")
    space = sensor_space(model, [2])  # framequat: a measurement space of one quaternion only
    good = np.array([[1.0, 0, 0, 0]])
    bad = np.full((1, 4), np.nan)
    assert np.isnan(space.minus(bad, good)).all()
    assert np.isnan(space.minus(good, bad)).all()
    assert np.isnan(space.plus(bad, np.zeros((1, 3)))).all()


def test_euclidean_is_flat_addition():
    space = Manifold.euclidean(2, ("a", "b"), ("m", "s"))
    x, delta = np.array([[1.0, 2.0]]), np.array([[0.5, -1.0]])
    assert space.flat
    assert (space.n, space.nx, space.index("b")) == (2, 2, 1)
    np.testing.assert_array_equal(space.plus(x, delta), [[1.5, 1.0]])
    np.testing.assert_array_equal(space.minus(x, delta), [[0.5, 3.0]])
    np.testing.assert_array_equal(
        space.mean(np.array([[0.0, 1], [4, 3]]), np.array([0.25, 0.75])), [3, 2.5]
    )
    np.testing.assert_array_equal(space.reset_jacobian(delta), np.eye(2)[None])


def test_names_and_units_of_the_state():
    space = SPACES["joints"]
    assert not space.flat
    assert (space.n, space.nx, len(space.quaternions)) == (22, 24, 2)
    units = dict(zip(space.names, space.units))
    assert units["lift"] == "m"
    assert units["swing.vel"] == "rad/s"
    assert units["root.vz"] == "m/s"
    assert units["root.rx"] == "rad"
    # A velocity stands where mj_integratePos takes it: root.wz turns root about its own z.
    x = np.zeros(space.nx)
    x[space.quaternions[:, 0]] = 1.0
    delta = np.zeros(space.n)
    delta[space.index("root.rz")] = 0.2
    turned = space.plus(x, delta)[space.quaternions[1, 0] :][:4]
    np.testing.assert_allclose(turned, rotation.exp(np.array([0, 0, 0.2])))
    assert SPACES["activations"].names[4:] == ("lag.act", "ramp.act")


def test_names_and_units_must_match():
    with pytest.raises(DimensionError, match="units 1"):
        Manifold(("a", "b"), ("m",))


# Angles


TURNED = Manifold(  # a line, a quaternion, an angle, a line, an angle
    tuple("arbcdef"), ("m", "rad", "rad", "rad", "rad", "m", "rad"), np.array([[1, 1]]), (4, 6)
)


@given(seed=seeds, turns=st.integers(-3, 3))
def test_differences_of_angles_go_the_short_way_round(seed, turns):
    x, delta = point(TURNED, seed), tangent(TURNED, seed)
    moved = TURNED.plus(x, delta)
    moved[[5, 7]] += 2 * np.pi * turns
    np.testing.assert_allclose(TURNED.minus(moved, x), delta, atol=1e-12)
    far = TURNED.plus(x, delta + np.pi * np.eye(7)[4])
    assert abs(TURNED.minus(far, x)[4]) <= np.pi + 1e-12


@given(seed=seeds, turns=st.integers(-3, 3))
def test_the_mean_of_angles_does_not_know_where_a_turn_begins(seed, turns):
    x = point(TURNED, seed)
    points = TURNED.plus(x, tangent(TURNED, seed, (9,), limit=1.0))
    weights = np.full(9, 1 / 9)
    before = TURNED.mean(points, weights)
    points[4:, [5, 7]] += 2 * np.pi * turns
    np.testing.assert_allclose(TURNED.minus(TURNED.mean(points, weights), before), 0, atol=1e-12)
    per_row = TURNED.mean(points[None], weights[None])[0]
    np.testing.assert_allclose(TURNED.minus(per_row, before), 0, atol=1e-12)


def test_angles_are_kept_in_a_product():
    both = product([Manifold.euclidean(2), TURNED, Manifold.euclidean(1, angles=[0])])
    assert both.angles == (6, 8, 9)
    assert TURNED.flat is False
    bearing = Manifold.euclidean(2, angles=[1])
    assert (bearing.flat, bearing.vector) == (True, False)
    np.testing.assert_allclose(bearing.minus(np.array([1.0, 3.1]), np.array([0.0, -3.1])),
                               [1.0, 6.2 - 2 * np.pi])  # fmt: skip


@pytest.mark.parametrize("angles", [(2,), (7,), (-1,), (4, 4)])
def test_angles_that_are_no_coordinates(angles):
    with pytest.raises(DimensionError, match=r"angles is .*use some of 0 to 6"):
        Manifold(TURNED.names, TURNED.units, TURNED.quaternions, angles)


def test_several_quaternions_are_computed_as_each_alone():
    rng = np.random.default_rng(3)
    ball = Manifold(("rx", "ry", "rz"), ("rad",) * 3, np.array([[0, 0]]))
    one = product([Manifold.euclidean(1), ball, Manifold.euclidean(2)])
    several = product([one, one, one])
    x = np.stack([one.plus(np.ones(one.nx), rng.standard_normal((5, 2, one.n))) for _ in range(3)])
    delta = rng.standard_normal((3, 5, 2, one.n))
    y = one.plus(x, delta)
    whole = [np.concatenate(list(part), axis=-1) for part in (x, y, delta)]
    np.testing.assert_allclose(several.plus(whole[0], whole[2]), whole[1], atol=1e-14)
    found = several.minus(whole[1], whole[0])
    apart = np.concatenate(list(one.minus(y, x)), axis=-1)
    np.testing.assert_allclose(found, apart, atol=1e-14)
    jacobian, cov = several.reset_jacobian(whole[2]), np.eye(several.n) + 0.5
    for i in range(3):
        block = slice(i * one.n, (i + 1) * one.n)
        expected = one.reset_jacobian(delta[i])
        np.testing.assert_allclose(jacobian[..., block, block], expected, atol=1e-14)
    moved = several.transport(np.broadcast_to(cov, jacobian.shape), whole[2])
    np.testing.assert_allclose(moved, jacobian @ cov @ jacobian.mT, atol=1e-13)
    for weights in (np.array([0.3, 0.7]), rng.dirichlet([1.0, 1.0], 5)):
        near = several.plus(whole[0][:, :1], 0.3 * whole[2])
        parts = [near[..., i * one.nx : (i + 1) * one.nx] for i in range(3)]
        expected = np.concatenate([one.mean(part, weights) for part in parts], axis=-1)
        np.testing.assert_allclose(several.mean(near, weights), expected, atol=1e-12)


def test_several_quaternions_of_a_row_do_not_depend_on_the_other_rows():
    rng = np.random.default_rng(4)
    ball = Manifold(("rx", "ry", "rz"), ("rad",) * 3, np.array([[0, 0]]))
    space = product([Manifold.euclidean(1), ball, ball, ball])
    rest = np.concatenate([[0.0], np.tile([1.0, 0.0, 0.0, 0.0], 3)])
    x = space.plus(rest, rng.standard_normal((50, space.n)))
    delta, points = (rng.standard_normal((50, *shape, space.n)) for shape in ((), (3,)))
    cov = points.mT @ points + np.eye(space.n)

    def computed(rows):
        near = space.plus(x[rows, None], points[rows])
        return (
            space.minus(space.plus(x[rows], delta[rows]), x[rows]),
            space.minus(near, x[rows, None]),
            space.mean(near, np.array([0.2, 0.3, 0.5])),
            space.transport(cov[rows], delta[rows]),
        )

    together = computed(slice(None))
    for i in range(50):
        for alone, among in zip(computed(slice(i, i + 1)), together):
            np.testing.assert_array_equal(alone[0], among[i])
