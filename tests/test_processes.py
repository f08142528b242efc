import torch

from tests.processes import apart
from warmprior.io.workers import torch_threads


def test_a_forked_process_does_not_wait_for_threads_that_it_lacks():
    with torch_threads(2):
        assert apart(torch.get_num_threads)() == 1
