"""Files of JSON lines, and the errors that scripts report without a traceback."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from warmprior.io import script
from warmprior.io.files import check_regular


class PartialFailure(RuntimeError):
    """Raised if some of the work failed; the rest is done and saved."""


ERRORS = (*script.ERRORS, PartialFailure)
"""Errors that a user can mend; they are reported without a traceback."""


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Read a file of JSON objects, one per line; a ``ValueError`` names a damaged line."""
    check_regular(path)
    records = []
    for number, line in enumerate(path.read_bytes().splitlines(), 1):
        try:
            records.append(json.loads(line))
            if not isinstance(records[-1], dict):
                raise ValueError("it is no JSON object")
        except (ValueError, RecursionError) as error:
            raise ValueError(
                f"{path}, line {number} is damaged ({error}): remove that line, and continue with --resume"
            ) from error
    return records
