"""One thread for all tests: the tensors are small, and threads of two processes would wait for each other."""

import torch

torch.set_num_threads(1)
