"""Points and rays of a triplane against plain formulas."""

import torch

from xplanes.fields.decoder import Decoder
from xplanes.fields.lookup import plane_features_reference
from xplanes.synthetic.pretraining.losses import (
    colour_loss,
    composite,
    occupancy_loss,
    ray_samples,
    triplane_logits,
)


def randn(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def test_points_are_read_as_the_field_reads_them():
    torch.manual_seed(0)
    decoder, planes = Decoder(5, width=16, hidden=2), randn(2, 3, 5, 6, 6)
    points = randn(2, 40, 3, seed=1).clamp(-1.1, 1.1)
    logits = triplane_logits(planes, decoder, points)
    for i in range(2):
        space = planes[i].permute(0, 2, 3, 1)
        features = plane_features_reference(space, None, points[i], torch.zeros(40), ())
        torch.testing.assert_close(logits[i], decoder.logits(features.flatten(1)))


def test_losses_are_of_the_opacity_of_one_step_and_of_colours_that_reach_beyond_their_range():
    logits, inside = 3 * randn(2, 50, 4), (randn(2, 50, seed=1) > 0).float()
    alpha = 1 - torch.exp(-torch.nn.functional.softplus(logits[..., 0] - 1))
    wanted = torch.nn.functional.binary_cross_entropy(alpha, inside)
    torch.testing.assert_close(occupancy_loss(logits, inside), wanted)
    decoder, colours = Decoder(2), randn(2, 50, 3, seed=1).sigmoid()
    predicted = decoder.activate(logits.flatten(0, 1))[0].unflatten(0, (2, 50))
    wanted = (predicted - colours).abs().mean()
    torch.testing.assert_close(colour_loss(logits, colours, decoder.colour_margin), wanted)


def test_samples_fill_the_box_and_crowd_around_the_hit():
    origins = torch.tensor([[[0.0, -3, 0], [0.2, -3, 0.1], [5.0, -3, 0], [0, -3, 0.9]]])
    directions = torch.tensor([0.0, 1, 0]).expand(1, 4, 3)
    hits = torch.tensor([[2.5, torch.inf, torch.inf, 3.95]])
    for samples in (8, 9, 32):
        jitter = torch.rand(1, 4, samples, generator=torch.Generator().manual_seed(0))
        distances, lengths = ray_samples(origins, directions, hits, half_side=1.0, jitter=jitter)
        assert (distances[0, :2].diff(dim=-1) >= 0).all(), samples
        assert (distances[0, :2] >= 2).all(), samples
        assert (distances[0, :2] <= 4).all(), samples
        torch.testing.assert_close(lengths.sum(dim=-1)[0], torch.tensor([2.0, 2, 0, 2]))
        # None is as long as two of the parts into which half of them divide the box.
        assert (lengths[0, :2] <= 4 / (samples // 2)).all(), samples
        near = (distances[0, 0] - 2.5).abs() <= 0.1 + 1e-6
        assert near.sum() >= samples - samples // 2, samples


def test_compositing_of_a_wall():
    density, lengths = torch.tensor([0.0, 50, 50, 50]), torch.tensor([1.0, 0.1, 0.1, 0.1])
    colours = torch.tensor([[0.1] * 3, [0.2] * 3, [0.3] * 3, [0.4] * 3])
    rendered, alpha = composite(density, colours, lengths)
    first, second, third = (1 - torch.exp(torch.tensor(-5.0))) * torch.exp(
        torch.tensor([0.0, -5, -10])
    )
    wanted = 0.2 * first + 0.3 * second + 0.4 * third + 1 - alpha
    torch.testing.assert_close(alpha, first + second + third)
    torch.testing.assert_close(rendered, wanted.expand(3))
