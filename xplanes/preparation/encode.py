"""LRM encoding of the fixed-view video: one forward pass per distinct frame."""

import time
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from xplanes.errors import LRMError
from xplanes.lrm.images import Crop
from xplanes.lrm.model import LRM
from xplanes.preparation.cache import StageCache, fingerprint


@dataclass(frozen=True)
class Encoded:
    """Triplanes of a video.

    Attributes:
        triplanes: One per frame, on the CPU. [T, 3, C, H, H]
        distinct: Number of frames that differ.
        cached: Number of distinct frames that came from the cache.
        seconds: Time to encode the distinct frames, now or when they were cached.
    """

    triplanes: Tensor
    distinct: int
    cached: int
    seconds: float


@torch.no_grad()
def encode(
    model: LRM,
    key: str,
    frames: Tensor,
    crop: Crop,
    cache: StageCache,
    device: torch.device,
    *,
    batch: int,
    bf16: bool = False,
) -> Encoded:
    """Encode every distinct frame.

    Each triplane is cached as soon as it is computed, so that an interrupted run resumes where it
    stopped. Memory use is the result and one batch.

    Args:
        model: The model.
        key: Hash of its weights and sizes.
        frames: Premultiplied RGBA. uint8 [T, H, W, 4]
        crop: Crop that the model is given.
        cache: Cache of the triplanes.
        device: Device of the model.
        batch: Frames per batch.
        bf16: Use bfloat16 products.

    Raises:
        LRMError: If a triplane is not finite, or of another shape.
    """
    places: dict[str, list[int]] = {}
    for number, frame in enumerate(frames):
        places.setdefault(fingerprint(frame), []).append(number)
    shown = [crop.top, crop.left, crop.side, list(crop.kept or ())]

    def inputs(frame_key: str) -> list[Any]:
        return [key, frame_key, shown, device.type, bf16]

    found: dict[str, Tensor] = {}
    seconds, missing = 0.0, []
    for frame_key in places:
        stage = cache.find("triplane", inputs(frame_key))
        if stage is None:
            missing.append(frame_key)
        else:
            found[frame_key] = stage.content["triplane"]
            seconds += stage.seconds
    cached = len(found)
    if missing:
        model = model.to(device).eval()
    chunks = [missing[start : start + batch] for start in range(0, len(missing), batch)]
    # Only on a terminal: in a log file a progress bar would fill many lines.
    for chunk in tqdm(chunks, "triplanes", unit="batch", leave=False, disable=None):
        began = time.perf_counter()
        first = torch.tensor([places[frame_key][0] for frame_key in chunk])
        pictures = model.prepare(crop.apply(straight_alpha(frames[first])))
        with torch.autocast(device.type, torch.bfloat16, enabled=bf16):
            planes = model.encode(pictures.to(device)).float().cpu()
        shape = list(planes.shape)
        if len(shape) != 5 or shape[:2] != [len(chunk), 3] or shape[3] != shape[4]:
            raise LRMError(
                f"{type(model).__name__}.encode returns {shape}: must be [{len(chunk)}, 3, C, H, H]"
            )
        if not bool(planes.isfinite().all()):
            raise LRMError(
                f"the LRM predicts NaN or infinity for frame {int(first[0])} or a later one: its "
                f"weights are unusable{' in bfloat16; set lrm.precision=32' if bf16 else ''}"
            )
        share = (time.perf_counter() - began) / len(chunk)
        for frame_key, triplane in zip(chunk, planes, strict=True):
            cache.keep("triplane", inputs(frame_key), {"triplane": triplane.clone()}, share)
            found[frame_key] = triplane
            seconds += share
    triplanes = torch.empty(len(frames), *next(iter(found.values())).shape)
    for frame_key, numbers in places.items():
        triplanes[numbers] = found.pop(frame_key)
    return Encoded(triplanes, len(places), cached, seconds)


def straight_alpha(frames: Tensor) -> Tensor:
    """Premultiplied bytes to straight alpha, in [0, 1].

    Args:
        frames: Premultiplied RGBA. uint8 [T, H, W, 4]

    Returns:
        RGBA. [T, 4, H, W]
    """
    whole = frames.movedim(-1, 1).float() / 255
    alpha = whole[:, 3:]
    colour = torch.where(alpha > 0, whole[:, :3] / alpha.clamp_min(1e-6), 0.0).clamp(0, 1)
    return torch.cat([colour, alpha], dim=1)
