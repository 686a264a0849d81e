"""The path of a file that is to be written."""

import os

import pytest

from estbench.errors import StoreError
from estbench.tables.destination import check_file


def test_where_a_file_can_be_written(tmp_path):
    check_file(tmp_path / "a.png")
    (tmp_path / "a.png").write_text("")
    check_file(tmp_path / "a.png")
    with pytest.raises(
        StoreError, match=r"a\.html cannot be written: there is no folder .*no; make"
    ):
        check_file(tmp_path / "no" / "a.html")
    with pytest.raises(StoreError, match=r"no folder .*a\.png; .* another --out"):
        check_file(tmp_path / "a.png" / "b.png")
    with pytest.raises(StoreError, match="it is a folder; choose a file in it by --out"):
        check_file(tmp_path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_where_writing_is_not_allowed(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(StoreError, match="Permission denied; choose another --out"):
        check_file(tmp_path / "a.png")
