"""Check errors by the facts that their sentence names, so that a better sentence breaks no test."""

import re
from contextlib import contextmanager

import pytest


@contextmanager
def raises(error, fact, *more):
    """Check that the block raises this error, with each of these facts as whole words in its text."""
    with pytest.raises(error) as caught:
        yield caught
    text = str(caught.value)
    lacks = missing(text, fact, *more)
    assert not lacks, f"{lacks} missing in: {text}"


def missing(text, *facts):
    """Return the facts that a text lacks as whole words; a number is not found inside another one."""
    return [fact for fact in facts if not re.search(_words(str(fact)), text)]


def _words(fact):
    assert fact, "an empty fact is in every text"
    # 3 is neither in -3 and 0.3 nor in 3.5.
    before = r"(?<![\w.-])" if fact[0].isdigit() else r"\b" if re.match(r"\w", fact) else ""
    after = r"(?!\w|\.\d)" if fact[-1].isdigit() else r"\b" if re.search(r"\w$", fact) else ""
    return before + re.escape(fact) + after


def refuses(call, error, fact, *more):
    """Check that a call raises this error, with these facts."""
    with raises(error, fact, *more):
        call()
