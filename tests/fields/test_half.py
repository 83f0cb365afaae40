"""Products in bfloat16 whose number of rows seldom changes."""

import pytest
import torch

from xplanes.baselines.networks import PaddedMLP
from xplanes.fields.decoder import ROWS, Decoder, half_rows

NETWORKS = {
    "decoder": lambda: Decoder(4, precision="bf16"),
    "padded": lambda: PaddedMLP([12, 64, 4], precision="bf16"),
}
COUNTS = [0, 1, ROWS - 1, ROWS, ROWS + 1, 1000, 40 * ROWS + 1]


def test_many_values_have_few_numbers_of_rows_and_little_is_filled_up():
    values, numbers = torch.zeros(2**17, 1), set()
    for count in (*COUNTS, *range(2**14, 2**17, 500)):
        rows = len(half_rows(values[:count]))
        assert rows % ROWS == 0, count
        assert 0 <= rows - count < max(ROWS, count / 16), count
        numbers |= {rows} if count >= 2**14 else set()
    assert len(numbers) <= 3 * 16 + 1


def outcome(network, features, count):
    """The first rows of what a network answers, and their gradients."""
    network.zero_grad()
    out = network(features.requires_grad_())
    if isinstance(out, tuple):
        out = torch.cat([out[0], out[1][:, None]], dim=1)
    out[:count].square().sum().backward()
    return out[:count], features.grad[:count], [p.grad.clone() for p in network.parameters()]


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("count", COUNTS)
def test_what_is_filled_up_changes_neither_values_nor_gradients(count, network):
    torch.manual_seed(0)
    made = NETWORKS[network]()
    features = torch.randn(1000, 12)
    few, whole = (outcome(made, f.clone(), count) for f in (features[:count], features))
    torch.testing.assert_close(few[0], whole[0], atol=0, rtol=0.01)
    torch.testing.assert_close(few[1], whole[1], atol=1e-3, rtol=0.02)
    for own, other in zip(few[2], whole[2], strict=True):
        tolerance = 0.02 * float(other.abs().max()) + 1e-6
        torch.testing.assert_close(own, other, atol=tolerance, rtol=0)
