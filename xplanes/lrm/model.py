"""Base class of the Large Reconstruction Models."""

import copy
from typing import Any

from torch import Tensor, nn

from xplanes.errors import LRMError
from xplanes.fields.decoder import Decoder
from xplanes.lrm.canonical import CanonicalView
from xplanes.lrm.config import LRMConfig
from xplanes.lrm.images import prepare
from xplanes.lrm.vit import VisionTransformer


class LRM(nn.Module):
    """Predicts a triplane from one image; its decoder maps features to colour and density.

    Args:
        config: Sizes of the model.
        view: The model's canonical camera and bounding cube.
        **decoder: Options of the decoder beyond its size.

    Attributes:
        config: Sizes of the model.
        view: The model's canonical camera and bounding cube.
        decoder: Maps features [N, 3 C] to colour [N, 3] and density per unit length of the model's
            frame [N].
        encoder: The image encoder.
    """

    def __init__(self, config: LRMConfig, view: CanonicalView, **decoder: Any) -> None:
        super().__init__()
        sizes = {"width": config.decoder_width, "hidden": config.decoder_hidden}
        last = Decoder(config.channels, **sizes, **decoder)
        self.config = config
        self.view = view
        self.encoder = VisionTransformer(config.encoder)
        self.upsample = nn.ConvTranspose2d(config.width, config.channels, kernel_size=2, stride=2)
        self.decoder = last

    @property
    def image_size(self) -> int:
        """Side of the training images in pixels."""
        return self.config.image_size

    @property
    def half_side(self) -> float:
        """Half the side of the field's cube, in the model's frame."""
        return self.view.half_side

    @property
    def background(self) -> float:
        """Grey value of the background of input images, in [0, 1]."""
        return self.view.background

    def encode(self, images: Tensor, camera: Tensor | None = None) -> Tensor:
        """Predict triplanes from images.

        Args:
            images: RGB from 0 to 1, composited on `background`. OpenLRM requires S to be a multiple
                of its patch size. [N, 3, S, S]
            camera: Camera vectors of OpenLRM; the canonical camera when None. TripoSR has no camera
                input. [N, 16]

        Returns:
            Planes xy, xz, yz, the first axis along the columns. [N, 3, C, H, H]

        Raises:
            LRMError: If a shape does not fit, images are not floating-point, or TripoSR is given a
                camera.
        """
        raise NotImplementedError

    def prepare(self, rgba: Tensor) -> Tensor:
        """Preprocess RGBA images for the model.

        Args:
            rgba: Images with straight (not premultiplied) alpha; uint8, or floats in [0, 1].
                [N, 4, H, W]

        Returns:
            RGB from 0 to 1. [N, 3, S, S]

        Raises:
            LRMError: If the shape is wrong.
        """
        return prepare(rgba, self.config.architecture, self.image_size)

    def field_decoder(self, half_side: float | None = None) -> Decoder:
        """A trainable copy of the decoder for a field in the cube [-1, 1]^3.

        Its densities refer to the unit of length of that cube.

        Args:
            half_side: Half the side of that cube in the model's frame; the model's own when None.
        """
        decoder = copy.deepcopy(self.decoder).requires_grad_(True)
        decoder.density_scale *= self.half_side if half_side is None else half_side
        return decoder

    def planes(self, tokens: Tensor) -> Tensor:
        """Triplane tokens, plane by plane and row by row, as planes of twice the resolution.

        Args:
            tokens: Tokens of side R. [N, 3 R R, D]

        Returns:
            Planes in the model's layout. [N, 3, C, 2 R, 2 R]
        """
        side = self.config.low_resolution
        grid = tokens.transpose(1, 2).unflatten(2, (3, side, side)).transpose(1, 2)
        return self.upsample(grid.flatten(0, 1)).unflatten(0, (len(tokens), 3))

    def check_images(self, images: Tensor) -> None:
        """Check that a tensor is a batch of square images.

        Raises:
            LRMError: If not; the message names the shape or type.
        """
        if images.ndim != 4 or images.shape[1] != 3 or images.shape[2] != images.shape[3]:
            raise LRMError(f"images have the shape {list(images.shape)}: must be [N, 3, S, S]")
        if not images.is_floating_point():
            raise LRMError(f"images are {images.dtype}: must be floating point, from 0 to 1")
