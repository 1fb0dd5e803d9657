"""Every row of the fault matrix is covered by a test that carries its mark, and every mark names a row."""

from __future__ import annotations

import pytest

from tests.fault_matrix import ROWS
from tools.fault_table import marked_tests

MARKED = marked_tests()


@pytest.mark.parametrize("row", ROWS)
def test_every_row_is_covered(row: str) -> None:
    assert MARKED.get(row), f"no test carries @pytest.mark.fault({row!r})"


def test_every_mark_names_a_row() -> None:
    assert not set(MARKED) - set(ROWS)
