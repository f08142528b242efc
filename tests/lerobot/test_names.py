"""Names and tasks as datasets have them."""

import numpy as np
import pytest

from warmprior.lerobot.names import unseen_tasks

TWO = ["task, one of 2"]


@pytest.mark.parametrize(
    ("episodes", "unseen"),
    [
        ([np.array(["lift"], object), ["lift"], "lift"], []),
        ([np.array(["lift", "push"], object)], TWO),
        ([("lift",), ("push", "lift")], TWO),
        ([["lift"], None, [None], []], []),
        (["lift", None, "push"], TWO),
        ([None, None], []),
    ],
)
def test_tasks_are_counted_by_their_texts_however_they_are_stored(episodes, unseen):
    assert unseen_tasks(episodes) == unseen
