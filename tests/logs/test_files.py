"""The forms of log files, and what is wrong with them."""

import numpy as np
import pytest

from estbench.errors import LogError
from estbench.logs import files, inspect

NUMBERS = np.array([[0.0, 0.5, -1.25], [0.01, 1e-3, 2.0], [0.02, 7.0, 3.5]])


def written(path, text):
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("delimiter", "decimal", "head"),
    [
        (",", ".", "t,a,b"),
        ("\t", ".", "t\ta\tb"),
        (";", ",", "t;a;b"),
        ("|", ".", "t|a|b"),
        (" ", ".", "t a b"),
        (" ", ".", "# t a b"),
    ],
)
def test_delimiter_decimal_and_headings_are_found(tmp_path, delimiter, decimal, head):
    rows = [delimiter.join(repr(float(x)).replace(".", decimal) for x in row) for row in NUMBERS]
    (table,) = files.read(written(tmp_path / "log.txt", "\n".join([head, *rows, ""])))
    assert list(table.columns) == ["t", "a", "b"]
    assert np.array_equal(np.column_stack(list(table.columns.values())), NUMBERS)
    assert table.rows.tolist() == [2, 3, 4]


def test_without_headings_columns_have_numbers_and_empty_cells_are_nan(tmp_path):
    (table,) = files.read(written(tmp_path / "log.csv", "0,1,\n1,,3\n"))
    assert list(table.columns) == ["0", "1", "2"]
    assert np.isnan(table.columns["1"][1])
    assert np.isnan(table.columns["2"][0])


def test_npz(tmp_path):
    np.savez(tmp_path / "log.npz", t=NUMBERS[:, 0], q=NUMBERS[:, 1:], name=np.array("robot"))
    table = files.read(tmp_path / "log.npz")[0]
    assert list(table.columns) == ["t", "q[0]", "q[1]"]
    assert np.array_equal(table.columns["q[1]"], NUMBERS[:, 2])
    np.savez(tmp_path / "two.npz", a=np.zeros(3), b=np.zeros(4))
    with pytest.raises(LogError, match=r"differ in length \(a 3, b 4\)"):
        files.read(tmp_path / "two.npz")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "log.npz").read_bytes()[:200])
    with pytest.raises(LogError, match=r"cut\.npz is no npz file"):
        files.read(tmp_path / "cut.npz")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("t,a\n", "has headings and no row"),
        ("t,a,b\n0,1,2\n1,2\n", r"row 3 has 2 cells; expected 3 .* is it cut off"),
        ("t,a,a\n0,1,2\n", "two columns 'a'"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path, text, message):
    with pytest.raises(LogError, match=message):
        files.read(written(tmp_path / "log.csv", text))


def test_a_cell_that_is_no_number_matters_where_it_is_asked_for(tmp_path):
    (table,) = files.read(written(tmp_path / "log.csv", "t,a,b\n0,1,ok\n1,2,bad\n"))
    assert table.column("a", "log.time").tolist() == [1.0, 2.0]
    with pytest.raises(LogError, match=r"log\.csv, row 2: column 'b' has 'ok'; log\.x needs"):
        table.column("b", "log.x")
    with pytest.raises(LogError, match=r"no column 'c', which log\.x names"):
        table.column("c", "log.x")


def test_inspection_says_rates_gaps_and_order(tmp_path):
    t = np.array([0, 10, 20, 20, 70, 60, 80, 90, 100])  # ms
    angle = 90.0 * np.sin(t)
    rows = "\n".join(f"{a},{b}" for a, b in zip(t, angle))
    (table,) = files.read(written(tmp_path / "log.csv", f"stamp,joint_pos\n{rows}\n"))
    seen = inspect.stamps(table)
    assert seen is not None
    assert (seen.unit, seen.gaps, seen.equal, seen.backwards) == ("ms", 1, 1, 1)
    assert seen.span == pytest.approx(0.1)
    text = inspect.section([table])
    assert 'time = "stamp"\nunit = "ms"' in text
    assert '[log.channels.joint_pos]\ncolumns = ["joint_pos"]\nunit = "deg"' in text
