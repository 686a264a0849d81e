"""Names of others steer neither the terminal nor a spreadsheet."""

import csv
import io

import pytest

from estbench.tables import names, units, writers
from estbench.tables.columns import Column, Table


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("pole.vel", "pole.vel"), ("größe σ²", "größe σ²"), ("a\x1b[31mb", r"a\x1b[31mb"),
        ("a\nb", r"a\nb"), ("a\u202eb", r"a\u202eb"), ("\x07", r"\x07"),
    ],
)  # fmt: skip
def test_control_characters_are_escaped_wherever_a_table_is_written(name, shown):
    assert names.visible(name) == shown
    keys = (Column("coordinate", (name,), "left"),)
    table = Table(keys, ((Column(name, ("1",)),),), title=name, note="two\nlines")
    for text in (writers.text([table]), writers.markdown([table]), writers.latex([table])):
        assert not {"\x1b", "\x07", "\u202e"} & set(text)
    assert table.rows == [(shown, "1")]
    assert "two\nlines" in writers.text([table])


@pytest.mark.parametrize("name", ["=1+1", "+x", "-x", "@SUM(A1)", "\tx", "x", "-1.5", "+1e3"])
def test_a_csv_cell_is_no_formula(name):
    text = writers.comma_separated(["name", "value"], [{"name": name, "value": -1.5}])
    (row,) = csv.DictReader(io.StringIO(text))
    formula = name in ("=1+1", "+x", "-x", "@SUM(A1)", "\tx")
    assert row == {"name": "'" * formula + name.replace("\t", "\\t"), "value": "-1.5"}


@pytest.mark.parametrize(
    ("unit", "density", "impulse"),
    [("m", "m²/s", "m² s"), ("rad/s", "rad²/s³", "rad²/s² s"), ("N m", "N² m²/s", "N² m² s")],
)
def test_units_of_densities(unit, density, impulse):
    assert (units.density(unit), units.impulse_density(unit)) == (density, impulse)
