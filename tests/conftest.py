import pytest
import torch as th


@pytest.fixture(autouse=True)
def one_thread():
    """As training processes do; also makes sums independent of the machine."""
    th.set_num_threads(1)
