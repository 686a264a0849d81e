import pytest
from rich.console import Console

import estbench
from estbench.scenario.load import resolve
from estbench.tables.columns import Column, Table, fit, tabulate

NAME = "an_estimator/with_a_long_name"
KEY = (Column("name", (NAME, "ekf"), "left"),)


def numbers(count, width=8):
    return tuple((Column(f"c{i}", ("1" * width, "2")),) for i in range(count))


def shown(renderable, width):
    console = Console(width=width, no_color=True, force_terminal=False, highlight=False)
    with console.capture() as capture:
        console.print(renderable)
    return [line.rstrip() for line in capture.get().splitlines()]


@pytest.mark.parametrize("width", [60, 80, 100, 200])
def test_every_line_fits_and_every_cell_is_whole(width):
    lines = shown(Table(KEY, numbers(12)), width)
    assert max(map(len, lines)) <= width
    tables = sum(line.startswith("name") for line in lines)
    assert tables == -(-12 // ((width - len(NAME)) // 10))
    assert sum(NAME in line for line in lines) == tables
    assert sum(line.count("1" * 8) for line in lines) == 12


def test_what_fits_to_the_last_column_is_one_table():
    width = len(NAME) + 3 * 10
    assert len(fit(KEY, numbers(3), width)) == 1
    assert len(fit(KEY, numbers(3), width - 1)) == 2


def test_a_group_is_not_parted():
    pairs = tuple(a + b for a, b in zip(numbers(4), numbers(4)))
    tables = fit(KEY, pairs, len(NAME) + 35)
    assert [len(t) - 1 for t in tables] == [2, 2, 2, 2]


def test_a_heading_is_narrow_only_where_that_saves_a_table():
    cost = Column("long heading", ("1", "2"), narrow="long\nheading")
    groups = (*numbers(2), (cost,))
    full = len(NAME) + 2 * 10 + 2 + len("long heading")
    (wide,), (narrow,) = fit(KEY, groups, full), fit(KEY, groups, full - 5)
    assert (wide[-1].heading, narrow[-1].heading) == (cost.heading, cost.narrow)
    assert [t[-1].heading for t in fit(KEY, groups, full - 6)] == ["c1", cost.heading]
    assert max(map(len, shown(Table(KEY, groups), full - 5))) <= full - 5


def test_a_name_that_is_wider_than_the_screen_is_folded_and_not_cut():
    long = (Column("name", ("x" * 150,), "left"),)
    lines = shown(Table(long, ((Column("value", ("7",)),),)), 100)
    assert max(map(len, lines)) <= 100
    assert sum(line.count("x") for line in lines) == 150


def test_long_labels_in_the_tables_of_results():
    labels = {"filterpy_ekf": "ekf", "quadrature_of_order_three": "ghkf", "my_own_filter_2": "ukf"}
    scenario = resolve("pendulum", runs=20, duration=0.5)
    estimators = {label: {"type": kind} for label, kind in labels.items()}
    lines = str(estbench.run(scenario.model_copy(update={"estimators": estimators})))
    assert max(map(len, lines.splitlines())) <= 100
    for label in labels:
        rows = [line for line in lines.splitlines() if line.startswith(label)]
        assert rows
        assert lines.count(label) == len(rows) + 1  # and the heading of its errors


def test_a_table_whose_last_column_is_of_words_is_shown():
    lines = shown(tabulate("words", ("<a", "b", "<c"), [("x", "1", "last")]), 40)
    assert [line.split() for line in lines[::2]] == [["a", "b", "c"], ["x", "1", "last"]]
