"""Rows for matrix products in bfloat16."""

import torch
import torch.nn.functional as F
from torch import Tensor

ROWS = 256
"""On the CPU products have a multiple of so many rows.

There each number of rows has a kernel that is compiled at its first use, which takes longer than a
product, and the samples of every training step are another number.
"""


def half_rows(values: Tensor) -> Tensor:
    """The values in bfloat16, on the CPU with rows of zeros below. [N, C] -> [at least N, C]"""
    values = values.to(torch.bfloat16)
    if values.device.type != "cpu":
        return values
    return F.pad(values, (0, 0, 0, -len(values) % ROWS))
