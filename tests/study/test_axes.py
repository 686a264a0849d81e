import numpy as np
import pytest

from estbench.errors import StudyError
from estbench.study import axes

Q = ("filter", "process_noise_scale")


@pytest.mark.parametrize(
    ("spec", "values"),
    [
        ("0.1,1,10", (0.1, 1, 10)),
        ("[0.1, 1]", (0.1, 1)),
        ("exact,naive", ("exact", "naive")),
        ("lin:0:1:3", (0.0, 0.5, 1.0)),
        ("log:0.01:100:5", (0.01, 0.1, 1.0, 10.0, 100.0)),
    ],
)
def test_values(spec, values):
    ((axis),) = axes.grid([axes.parse(f"filter.process_noise_scale={spec}")])
    assert axis.names == Q
    if isinstance(values[0], str):
        assert axis.values == values
    else:
        np.testing.assert_allclose(np.array(axis.values), values, rtol=1e-14)
        assert (axis.values[0], axis.values[-1]) == (values[0], values[-1])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("filter.process_noise_scale", "not of the form KEY=SPEC"),
        ("filter.process_noise_scale=", "not of the form KEY=SPEC"),
        ("filter.process_noise_scale=lin:2:1:3", "from 2 to 1 is empty"),
        ("filter.process_noise_scale=log:0:1:3", "a log range starts above 0"),
        ("filter.process_noise_scale=log:a:1:3", "is no range"),
        ("filter.process_noise_scale=lin:0:1:0", "use a count of at least 1"),
        ("filter.process_noise_scale=lin:0:1", "the range has no count"),
        ("filter.process_noise_scale=0.1:10", "use lin:0.1:10 or log:0.1:10"),
        ("filter.process_noise_scale=1,,2", "a value is missing"),
        ("filter.process_noise_scale=1,2,1", "the value 1 is given twice"),
    ],
)
def test_mistakes(text, message):
    with pytest.raises(StudyError, match=message):
        axes.grid([axes.parse(text)])


def test_no_key_and_a_key_twice():
    with pytest.raises(StudyError, match="no key is varied"):
        axes.grid([])
    with pytest.raises(StudyError, match="is varied twice"):
        axes.grid([axes.parse("a.b=1,2"), axes.parse("a.b=3,4")])


@pytest.mark.parametrize("sample", ["sobol", "latin"])
def test_a_design_fills_its_ranges(sample):
    specs = [axes.parse("a=lin:2:4"), axes.parse("b=log:0.01:100"), axes.parse("c=x,y")]
    found = axes.points(specs, sample, 16, seed=3)
    a, b = (np.array(axis.values) for axis in found[:2])
    assert len(a) == len(b) == 16
    for share in ((a - 2) / 2, np.log(b / 0.01) / np.log(1e4)):  # one point in each sixteenth
        assert sorted((share * 16).astype(int)) == list(range(16))
    assert sorted(found[2].values) == ["x"] * 8 + ["y"] * 8
    assert axes.points(specs, sample, 16, seed=3) == found
    assert axes.points(specs, sample, 16, seed=4) != found


def test_designs_that_are_refused():
    with pytest.raises(StudyError, match="use sobol or latin"):
        axes.points([axes.parse("a=lin:0:1")], "random", 4, 0)
    with pytest.raises(StudyError, match="points is 0"):
        axes.points([axes.parse("a=lin:0:1")], "latin", 0, 0)
