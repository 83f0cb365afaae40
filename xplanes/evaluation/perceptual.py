"""LPIPS, where its network is at hand.

Kept apart from the model: its network is neither trained nor saved with anything.
"""

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from xplanes.files import is_there
from xplanes.optional import require

WEIGHTS = {
    "vgg": ("VGG16_Weights", "528 MB"),
    "alex": ("AlexNet_Weights", "233 MB"),
}
"""Name in torchvision and size of the backbone's weights, by the network's name."""

SMALLEST = 32
"""Pixels a side below which the networks have nothing left to compare."""

Metric = Callable[[Tensor, Tensor], float]
"""From a prediction and the truth, in [0, 1], to a distance. [H, W, 3], [H, W, 3]"""


class UnavailableError(Exception):
    """LPIPS cannot be computed; the message is the reason."""


def lpips(network: str, side: int, device: str, *, download: bool) -> Metric:
    """The LPIPS distance; lower is better.

    Args:
        network: ``vgg`` or ``alex``: their numbers cannot be compared.
        side: Pixels of the shorter side of the images.
        device: Where to compute.
        download: Fetch the backbone's weights if they are not on this machine.

    Raises:
        UnavailableError: If anything is missing; the message says what.
    """
    if side < SMALLEST:
        raise UnavailableError(f"images of {side} pixels are below {SMALLEST}")
    try:
        models = require("torchvision.models", extra="lpips")
    except ImportError as error:
        raise UnavailableError(str(error)) from error
    name, size = WEIGHTS[network]
    url = getattr(models, name).DEFAULT.url
    file = Path(torch.hub.get_dir()) / "checkpoints" / Path(url).name
    if not is_there(file) and not download:
        raise UnavailableError(f"{file} is missing: --lpips {network} downloads its {size}")
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    try:
        if is_there(file):
            # torchvision would read the file as a pickle, which may run code.
            torch.load(file, map_location="cpu", weights_only=True)
        metric = LearnedPerceptualImagePatchSimilarity(
            net_type=network,  # type: ignore[arg-type]
            normalize=True,
        ).to(device)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise UnavailableError(
            f"its weights cannot be loaded ({reason}): put {url} at {file}"
        ) from error

    @torch.no_grad()
    def measure(prediction: Tensor, truth: Tensor) -> float:
        images = [t.clamp(0, 1).float().permute(2, 0, 1)[None] for t in (prediction, truth)]
        return float(metric(*(image.to(device) for image in images)))

    return measure
