"""What the tests of comparisons share."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """The folder of a comparison that one worker finished; to be read alone."""
    pytest.importorskip("tyro")
    from tests.experiments.comparison_parts import comparison

    folder = tmp_path_factory.mktemp("undisturbed")
    comparison(folder, 1).run()
    return folder
