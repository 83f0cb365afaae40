"""Triton kernels are used where they apply and have proved themselves, and else plain torch."""

import dataclasses
import re
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from torch import Tensor
from torch.utils._pytree import tree_map_only

from tests.fields.test_lookup import scattered, stacks
from tests.rendering import test_composite, test_march
from xplanes import backend
from xplanes.baselines import products
from xplanes.errors import DeviceError
from xplanes.fields import lookup
from xplanes.fields.xplanes import PLANE_SETS
from xplanes.rendering import compositing, marching

pytest.importorskip("triton", reason="triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


def there(tensors):
    return [tensor.to(DEVICE) for tensor in tensors]


def looked_up():
    places = there((*stacks("six", torch.float32, channels=2), *scattered(5, torch.float32)))
    given = (*places, PLANE_SETS["six"])
    return lookup.plane_features(*given), lookup.plane_features_reference(*given)


def composited():
    given = there(test_composite.rays_of(dtype=torch.float32))
    return compositing.composite(*given), compositing.composite_reference(*given)


def marched():
    grid = test_march.grid_of().to(DEVICE)
    rays = there(test_march.rays_of(5, torch.float32))
    expected = test_march.twin(rays, grid, occlusion=0.001)
    found = marching.march(
        marching.Rays(*rays), grid, step=test_march.STEP, occlusion=0.001, room=90
    )
    return [
        [samples.cells[: len(expected)], samples.distances[: len(expected)]]
        for samples in (found, expected)
    ]


def multiplied():
    torch.manual_seed(0)
    planes = products.PlaneProducts(2, 4, (1,), 3, low=0.1, high=0.5).to(DEVICE)
    tensors = [planes.scales[0][name] for name in planes.names]
    places = torch.tensor([[0.0, 0.0, 0.0, -0.4]], device=DEVICE).expand(5, -1)
    found = planes(torch.zeros(5, 3, device=DEVICE), torch.full((5,), 0.3, device=DEVICE))
    return found, products.plane_product_reference(tensors, places, planes.names)


CASES = {
    "plane lookup (2 channels, torch.float32)": (lookup, "plane_features_gpu", looked_up),
    "compositing (torch.float32)": (compositing, "composite_gpu", composited),
    "marching (torch.float32)": (marching, "march_gpu", marched),
    "products of planes (2 channels, torch.float32)": (products, "plane_product_gpu", multiplied),
}
"""By the name of the work: where its kernels are chosen, and what they come to beside the twin."""


@pytest.fixture(params=CASES)
def work(request, monkeypatch):
    """Tensors of this machine are taken for ones on a GPU."""
    module, *rest = CASES[request.param]
    monkeypatch.setattr(module, "cpu_loops", lambda tensor: False)
    monkeypatch.setattr(module, "gpu_kernels", lambda tensor: True)
    monkeypatch.setattr(backend, "_refused", set())
    module._kernels_hold.cache_clear()
    yield request.param, module, *rest
    module._kernels_hold.cache_clear()


def test_kernels_that_prove_themselves_are_used(work, monkeypatch, caplog):
    _, module, name, outcome = work
    calls = Mock(side_effect=getattr(module, name))
    monkeypatch.setattr(module, name, calls)
    for _ in range(2):
        with torch.inference_mode():
            ours, theirs = outcome()
        torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=1e-5)
    assert calls.call_count == 3  # One trial, two uses.
    assert not caplog.records


def spoiled(found):
    """Numbers that are wrong by a hundredth."""
    if dataclasses.is_dataclass(found):
        return dataclasses.replace(found, distances=1.01 * found.distances)
    return tree_map_only(Tensor, lambda tensor: 1.01 * tensor, found)


@pytest.mark.parametrize("fault", ["raises", "wrong values"])
def test_kernels_that_fail_their_trial_are_not_used(work, monkeypatch, caplog, fault):
    what, module, name, outcome = work
    kernels = getattr(module, name)

    def broken(*given, **named):
        if fault == "raises":
            raise RuntimeError("no compiler\nsecond line")
        return spoiled(kernels(*given, **named))

    monkeypatch.setattr(module, name, broken)
    for _ in range(2):
        torch.testing.assert_close(*outcome(), atol=0, rtol=0)
    (record,) = caplog.records
    message = record.getMessage()
    assert what in message
    assert "XPLANES_GPU_KERNELS=0" in message
    assert ("no compiler" in message) == (fault == "raises")
    assert "second line" not in message
    assert backend._refused == {what}


def test_a_gpu_that_is_lost_in_a_trial_is_not_asked_again(work, monkeypatch):
    broken = Mock(side_effect=RuntimeError("an illegal memory access was encountered"))
    what, module, name, outcome = work
    monkeypatch.setattr(module, name, broken)
    monkeypatch.setattr(backend, "synchronize", broken)
    words = rf"stopped responding.*{re.escape(what)}.*illegal memory.*XPLANES_GPU_KERNELS=0"
    with pytest.raises(DeviceError, match=words):
        outcome()


def test_when_kernels_apply(monkeypatch):
    on_gpu = SimpleNamespace(device=torch.device("cuda", 0))
    assert backend.gpu_kernels(on_gpu)
    assert not backend.gpu_kernels(torch.empty(1))
    torch.use_deterministic_algorithms(True)
    try:
        assert not backend.gpu_kernels(on_gpu)
    finally:
        torch.use_deterministic_algorithms(False)
    monkeypatch.setenv("XPLANES_GPU_KERNELS", "0")
    assert not backend.gpu_kernels(on_gpu)
