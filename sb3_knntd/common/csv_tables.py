"""Tables of results as CSV files."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any


def csv_table(header: Sequence[str], rows: Iterable[Iterable[Any]]) -> bytes:
    """
    :param header: names of the columns
    :param rows: as many values each; ``None`` leaves a cell empty
    :return: the content of a CSV file, lines ending in ``\\n``
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue().encode()
