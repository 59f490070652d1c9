"""Write tables as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any


def csv_table(header: Sequence[str], rows: Iterable[Iterable[Any]]) -> bytes:
    """
    :param header: names of the columns
    :param rows: one value for each column; ``None`` for an empty cell
    :return: the content of a CSV file, lines ending in ``\\n``
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue().encode()
