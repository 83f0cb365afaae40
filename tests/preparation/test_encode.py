"""Frames to triplanes: each distinct frame once, resumable."""

import pytest
import torch

from tests.lrm.reduced import SIDES, reduced
from tests.lrm.reference import compare
from xplanes.errors import LRMError
from xplanes.lrm.checkpoint import build, fill
from xplanes.lrm.config import parse_config
from xplanes.lrm.images import square_crop
from xplanes.preparation.cache import StageCache
from xplanes.preparation.encode import encode, straight_alpha

CPU = torch.device("cpu")


def model_of(name="openlrm-1.1"):
    config, state = reduced(name)
    model = build(parse_config(config))
    fill(model, state)
    return model


def frames_of(count, size=20, seed=0):
    """Random pictures whose colours are multiplied by alpha. uint8 [T, H, W, 4]"""
    generator = torch.Generator().manual_seed(seed)
    whole = torch.rand(count, size, size, 4, generator=generator)
    whole[..., :3] *= whole[..., 3:]
    return (whole * 255).to(torch.uint8)


def run(model, frames, cache, batch=2, key="weights", **options):
    crop = square_crop(*frames.shape[1:3])
    return encode(model, key, frames, crop, cache, CPU, batch=batch, **options)


@pytest.mark.parametrize("name", SIDES)
def test_every_frame_gets_the_triplane_of_its_own_image(name):
    frames, model = frames_of(4)[[0, 1, 0, 2, 3, 1]], model_of(name)
    expected = [model.encode(model.prepare(straight_alpha(f[None])))[0] for f in frames]
    for batch in (1, 3, 8):
        encoded = run(model, frames, StageCache(None), batch)
        assert (encoded.distinct, encoded.cached) == (4, 0)
        assert encoded.seconds > 0
        for alone, triplane in zip(expected, encoded.triplanes, strict=True):
            compare(triplane, alone, atol=2e-5, rtol=1e-4, case=f"{name} in batches of {batch}")


def test_each_distinct_frame_is_encoded_once(tmp_path, monkeypatch):
    model, seen = model_of(), []
    original = model.encode
    monkeypatch.setattr(
        model, "encode", lambda images, *rest: seen.append(len(images)) or original(images, *rest)
    )
    frames, cache = frames_of(3)[[0, 0, 1, 1, 2, 0]], StageCache(tmp_path)
    first = run(model, frames, cache)
    assert sum(seen) == 3
    again = run(model, frames, cache)
    assert sum(seen) == 3
    assert (again.distinct, again.cached) == (3, 3)
    assert again.seconds == pytest.approx(first.seconds)
    assert torch.equal(again.triplanes, first.triplanes)
    run(model, frames, cache, key="other weights")
    assert sum(seen) == 6
    run(model, frames, StageCache(None))
    assert sum(seen) == 9


def test_an_interrupted_video_is_resumed(tmp_path, monkeypatch):
    model, frames, cache = model_of(), frames_of(5), StageCache(tmp_path)
    expected = run(model, frames, StageCache(None)).triplanes
    original, seen = model.encode, []

    def stop_at_third(images, *rest):
        if len(seen) == 2:
            raise KeyboardInterrupt
        seen.append(len(images))
        return original(images, *rest)

    monkeypatch.setattr(model, "encode", stop_at_third)
    with pytest.raises(KeyboardInterrupt):
        run(model, frames, cache)
    monkeypatch.setattr(model, "encode", original)
    finished = run(model, frames, cache)
    assert finished.cached == 4
    torch.testing.assert_close(finished.triplanes, expected, atol=2e-5, rtol=1e-4)


def test_alpha_is_taken_out_of_colours():
    straight = torch.rand(2, 4, 6, 6, generator=torch.Generator().manual_seed(1))
    straight[:, 3] = 0.5 + 0.5 * straight[:, 3]
    straight[0, 3, 0, 0] = 0
    premultiplied = torch.cat([straight[:, :3] * straight[:, 3:], straight[:, 3:]], dim=1)
    found = straight_alpha((premultiplied * 255).round().to(torch.uint8).movedim(1, -1))
    assert found[0, :, 0, 0].tolist() == [0, 0, 0, 0]
    straight[0, :3, 0, 0] = 0
    torch.testing.assert_close(found, straight, atol=0.01, rtol=0)


def test_bfloat16_is_kept_apart_and_close(tmp_path):
    model, frames, cache = model_of(), frames_of(3), StageCache(tmp_path)
    exact, rough = (run(model, frames, cache, bf16=bf16) for bf16 in (False, True))
    assert rough.cached == 0
    assert rough.triplanes.dtype == torch.float32
    gap = (rough.triplanes - exact.triplanes).norm() / exact.triplanes.norm()
    assert 0 < gap < 0.03


class Own(torch.nn.Module):
    """An LRM that somebody else wrote, with dropout and no thought of gradients."""

    def __init__(self, side=3):
        super().__init__()
        self.layer = torch.nn.Sequential(torch.nn.Linear(3, 6), torch.nn.Dropout())
        self.side = side

    def prepare(self, rgba):
        return rgba[:, :3]

    def encode(self, images):
        features = self.layer(images.mean((2, 3)))
        return features.view(-1, 3, 2, 1, 1).expand(-1, -1, -1, 3, self.side)


def test_an_lrm_of_ones_own_is_evaluated_not_trained():
    model, frames, cache = Own(), frames_of(3), StageCache(None)
    first, again = (run(model, frames, cache).triplanes for _ in range(2))
    assert torch.equal(first, again)
    assert not first.requires_grad
    with pytest.raises(LRMError, match=r"Own\.encode returns \[2, 3, 2, 3, 5\]: must be \[2, 3,"):
        run(Own(side=5), frames, cache)


def test_a_triplane_that_is_not_finite_is_refused_and_not_kept(tmp_path, monkeypatch):
    model, frames, cache = model_of(), frames_of(2), StageCache(tmp_path)
    original = model.encode
    with monkeypatch.context() as patch:
        patch.setattr(model, "encode", lambda images, *rest: original(images, *rest) * float("inf"))
        with pytest.raises(LRMError, match=r"NaN or infinity for frame 0"):
            run(model, frames, cache)
    assert run(model, frames, cache).cached == 0
