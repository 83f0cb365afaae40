"""The decoder: shapes, activations and margins, and its behaviour at extreme logits."""

import itertools

import numpy as np
import torch

from xplanes.fields import Decoder


def filled(channels=2, **options):
    torch.manual_seed(3)
    return Decoder(channels, **options)


def mlp(decoder, features, activation):
    """The layers in float64 NumPy."""
    hidden = features.double().numpy()
    for number, layer in enumerate(decoder.layers):
        weight, bias = (p.detach().double().numpy() for p in (layer.weight, layer.bias))
        hidden = hidden @ weight.T + bias
        if number + 1 < len(decoder.layers):
            hidden = activation(hidden)
    return hidden


ACTIVATIONS = {"relu": lambda x: np.maximum(x, 0), "silu": lambda x: x / (1 + np.exp(-x))}
DENSITIES = {"softplus": lambda x: np.log1p(np.exp(x - 1)), "exp": lambda x: np.exp(x - 1)}


def test_output_is_the_formula_of_the_public_models():
    for hidden, activation, density in itertools.product([0, 1, 3], ACTIVATIONS, DENSITIES):
        case = f"hidden={hidden}, activation={activation}, density={density}"
        decoder = filled(hidden=hidden, activation=activation, density=density, density_scale=7.0)
        features = torch.randn(30, 6)
        logits = mlp(decoder, features, ACTIVATIONS[activation])
        colour, found = (t.detach().numpy() for t in decoder(features))
        np.testing.assert_allclose(
            found, 7 * DENSITIES[density](logits[:, 0]), rtol=2e-5, err_msg=case
        )
        sigmoid = 1 / (1 + np.exp(-logits[:, 1:]))
        np.testing.assert_allclose(
            colour, sigmoid * (1 + 2 * 0.001) - 0.001, atol=2e-6, err_msg=case
        )


def test_margin_widens_the_colours_on_both_sides():
    for margin in [0.0, 0.001, 0.1]:
        decoder = Decoder(2, colour_margin=margin)
        logits = torch.tensor([[0.0, -200.0, 0.0, 200.0]], dtype=torch.float64)
        colour = decoder.activate(logits)[0][0]
        expected = torch.tensor([-margin, 0.5, 1 + margin], dtype=torch.float64)
        torch.testing.assert_close(colour, expected, msg=lambda m, c=margin: f"{c}: {m}")


def test_low_precision_logits_are_activated_in_float32():
    for density, dtype in itertools.product(
        DENSITIES, [torch.float16, torch.bfloat16, torch.float32, torch.float64]
    ):
        case = f"density={density}, dtype={dtype}"
        logits = torch.linspace(-6, 6, 40).view(10, 4).to(dtype)
        colour, found = Decoder(2, density=density).activate(logits)
        wanted = torch.float64 if dtype == torch.float64 else torch.float32
        assert colour.dtype == found.dtype == wanted, case
        exact = DENSITIES[density](logits[:, 0].double().numpy())
        np.testing.assert_allclose(found.numpy(), exact, rtol=1e-5, err_msg=case)


def test_extreme_logits_give_finite_densities_and_gradients():
    for density, logit in itertools.product(
        DENSITIES, [-1e30, -1e4, -90.0, 90.0, 130.0, 1e4, 1e30]
    ):
        case = f"density={density}, logit={logit}"
        logits = torch.tensor([[logit, logit, -logit, 0.0]], requires_grad=True)
        colour, found = Decoder(2, density=density, density_scale=25.0).activate(logits)
        assert colour.isfinite().all(), case
        assert found.isfinite().all(), case
        assert found >= 0, case
        (colour.sum() + found.sum()).backward()
        assert logits.grad.isfinite().all(), case


def test_bf16_multiplies_in_bfloat16_and_answers_in_float32():
    exact, rough = filled(width=16), filled(width=16, precision="bf16")
    features = torch.randn(64, 6, requires_grad=True)
    assert rough.logits(features).dtype == torch.bfloat16
    found = rough(features)
    for ours, theirs in zip(found, exact(features), strict=True):
        assert ours.dtype == torch.float32
        torch.testing.assert_close(ours, theirs, atol=0.02, rtol=0.02)
        assert not torch.equal(ours, theirs)
    sum(part.sum() for part in found).backward()
    for tensor in (features, *rough.parameters()):
        assert tensor.grad.dtype == torch.float32
        assert tensor.grad.abs().max() > 0


def test_activations_have_the_gradients_of_their_formulas():
    logits = torch.randn(5, 4, dtype=torch.float64, requires_grad=True)
    for density in DENSITIES:
        assert torch.autograd.gradcheck(Decoder(2, density=density).activate, logits)
