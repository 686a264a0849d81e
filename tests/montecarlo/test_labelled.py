import numpy as np
import pytest

import estbench


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    out = tmp_path_factory.mktemp("labelled") / "x"
    return estbench.run("pendulum", runs=4, duration=0.2, out=out)


def test_labelled_arrays_are_those_of_the_store(results):
    tree = results.to_xarray()
    stored = estbench.open_results(results.folder)
    for label in ("ekf", "ukf"):
        for name, values in tree[label].data_vars.items():
            if name == "cpu_time":
                continue  # measured: beside the store
            same = stored[label][name]
            if "batch" in same.dims:  # the store has one row for each batch
                same, values = same.sum("batch"), values.sum("batch")
            assert same.dims == values.dims
            np.testing.assert_array_equal(same.values, values.values)
            assert values.attrs["meaning"] == stored[label][name].attrs.get("meaning", None)
    assert tree["ekf/mse"].sel(coordinate="hinge.vel").sizes == {"run": 4}
    assert tree.attrs["versions"]["estbench"] == estbench.__version__
    assert tree["unit"].sel(coordinate="hinge.vel") == "rad/s"


def test_a_table_has_a_row_for_each_estimator_and_run(results):
    table = results.to_dataframe()
    assert table.index.names == ["estimator", "run"]
    assert len(table) == 8
    record = results.records["ukf"]
    np.testing.assert_array_equal(table.loc["ukf"]["anees"], record["anees"])
    np.testing.assert_allclose(
        table.loc[("ukf", 3), "rmse hinge"], np.sqrt(record["mse"][3, 0]), rtol=1e-15
    )
    assert (table["cpu_time"] > 0).all()
