"""Columns: every one that a run writes is defined once."""

from __future__ import annotations

import pandas as pd
import pytest
from columns import COLUMNS, column, definitions

pytest.importorskip("tyro")

from report import summary

from tests.benchmarks.test_report import compared


def test_every_column_of_a_summary_is_defined():
    text = definitions(summary(compared(), 1).columns)
    assert text.count("\n") == len(summary(compared(), 1).columns)
    assert "- `success_std`: success: standard deviation over training seeds\n" in text


def test_what_is_not_defined_is_refused_and_what_a_task_measures_is_known():
    assert column("episode_coverage")[1].startswith("what the task measures")
    for name in ("nonsense", "nonsense_std"):
        with pytest.raises(KeyError, match=name):
            column(name)


@pytest.mark.parametrize("name", COLUMNS)
def test_every_definition_has_words_and_a_format_that_works(name):
    form, words = COLUMNS[name]
    assert len(words) > 3
    value = 1 if form in ("", "d") else pd.Series([0.5]).mean()
    assert format(value, form)
