"""Tables of studies, whose cells may be anything, as the tests read them."""

from __future__ import annotations

from typing import Any

from torchpose.studies.study import Table


def rows(table: Table) -> list[dict[str, Any]]:
    return table.rows
