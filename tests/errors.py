"""Errors by the facts that their sentence has to name, so that a better sentence breaks no test."""

import re
from contextlib import contextmanager

import pytest


@contextmanager
def raises(error, fact, *more):
    """The block raises this error, and its text has each of these facts as whole words."""
    with pytest.raises(error) as caught:
        yield caught
    text = str(caught.value)
    missing = [one for one in (fact, *more) if not re.search(_words(one), text)]
    assert not missing, f"{missing} missing in: {text}"


def _words(fact):
    return re.sub(r"^\b|\b$", r"\\b", re.escape(str(fact)))
