"""The X-Planes field: three space planes, up to six space-time planes, one decoder."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from xplanes.fields.background import Background
from xplanes.fields.base import RadianceField
from xplanes.fields.decoder import Decoder
from xplanes.fields.lookup import Rows, plane_features

PLANE_SETS: dict[str, Rows] = {
    "three": (),
    "six": ((0, 1), (0, 2), (1, 2)),
    "nine": ((0, 1), (2, 3), (4, 5)),
}
"""For each of xy, xz, yz: the two time planes whose product is added.

six: xt, yt, zt, each shared by two space planes. nine: xt, yt | xt', zt | yt', zt'. three: none,
for a static scene.
"""

SPACE_PLANES = ("xy", "xz", "yz")

FINE_PLANES = ("xy_fine", "xz_fine", "yz_fine")

TIME_PLANES: dict[str, tuple[str, ...]] = {
    "three": (),
    "six": ("xt", "yt", "zt"),
    "nine": ("xt", "yt", "xt'", "zt", "yt'", "zt'"),
}


class XPlanes(RadianceField):
    """A dynamic radiance field: products of space-time planes are added to space planes.

    The field covers the cube [-1, 1]^3. Outside it the planes are zero, and renderers take no
    samples.

    Args:
        planes: Initial values by name: space planes xy, xz, yz [C, H, H] and the plane set's time
            planes [C, T, H'] with time along the rows. Axis "a" of plane "ab" runs along the
            columns. Fine planes xy_fine, xz_fine, yz_fine [C', F, F] may be among them, C' <= C:
            they are added to the first C' channels of the space planes' features.
        decoder: Maps features [N, 3 C] to colour [N, 3] and density [N].
        plane_set: "six" (as in K-Planes), "nine" (as in Tensor4D) or "three" (no time planes).
        background: Model of the background outside the cube; None: the renderer's constant colour.

    Raises:
        ValueError: If the plane set is unknown, a plane is missing or superfluous, or shapes
            disagree.

    Source: X-Planes, Eq. 14 and 15.
    """

    def __init__(
        self,
        *,
        planes: Mapping[str, Tensor],
        decoder: Decoder,
        plane_set: str = "six",
        background: Background | None = None,
    ) -> None:
        super().__init__()
        if plane_set not in PLANE_SETS:
            raise ValueError(f"plane_set={plane_set!r}: must be one of {', '.join(PLANE_SETS)}")
        self.plane_set = plane_set
        self.rows = PLANE_SETS[plane_set]
        names = TIME_PLANES[plane_set]
        fine = bool(set(FINE_PLANES) & set(planes))
        if set(planes) != {*SPACE_PLANES, *names, *(FINE_PLANES if fine else ())}:
            raise ValueError(
                f"planes are {', '.join(sorted(planes))}: plane_set={plane_set!r} needs "
                f"{', '.join((*SPACE_PLANES, *names))}, and may have {', '.join(FINE_PLANES)}"
            )
        self.space = nn.Parameter(_stack(planes, SPACE_PLANES))
        self.time = nn.Parameter(_stack(planes, names)) if names else None
        self.fine = nn.Parameter(_stack(planes, FINE_PLANES)) if fine else None
        self.is_fine = True
        """Whether fine planes are read; False saves time while they are zero."""
        for stack, name in ((self.space, "xy"), (self.fine, "xy_fine")):
            if stack is not None and stack.shape[1] != stack.shape[2]:
                raise ValueError(f"plane {name} is {list(planes[name].shape)}: must be [C, H, H]")
        if self.time is not None and self.time.shape[3] != self.space.shape[3]:
            raise ValueError(
                f"time planes have {self.time.shape[3]} channels, space planes "
                f"{self.space.shape[3]}: must be equal"
            )
        if self.fine is not None and self.fine.shape[3] > self.space.shape[3]:
            raise ValueError(
                f"fine planes have {self.fine.shape[3]} channels, more than the space planes' "
                f"{self.space.shape[3]}"
            )
        self.decoder = decoder
        self.background = background

    @property
    def planes(self) -> dict[str, Tensor]:
        """The planes by name, as views of the parameters. [C, rows, columns] each"""
        stacks: list[tuple[tuple[str, ...], Tensor]] = [(SPACE_PLANES, self.space)]
        if self.time is not None:
            stacks.append((TIME_PLANES[self.plane_set], self.time))
        if self.fine is not None:
            stacks.append((FINE_PLANES, self.fine))
        return {
            name: plane.permute(2, 0, 1)
            for names, stack in stacks
            for name, plane in zip(names, stack, strict=True)
        }

    @property
    def moves(self) -> bool:
        return self.time is not None

    @property
    def precision(self) -> str:
        return self.decoder.precision

    @property
    def outline(self) -> str:
        behind = "" if self.background is None else " · a background"
        coarse = (*SPACE_PLANES, *TIME_PLANES[self.plane_set])
        sizes = f"{self.space.shape[2]} texels"
        if self.fine is not None:
            sizes += f" and {self.fine.shape[2]}"
        return f"({' '.join(coarse)}) · {sizes} · {self.space.shape[3]} channels{behind}"

    def snapshot(self, time: float) -> RadianceField:
        """The field at one time as three space planes, equal up to rounding and faster to read.

        At a fixed time each time plane is a line. The outer product of two lines is a plane whose
        bilinear interpolation equals the product of the two linear ones.

        Args:
            time: From 0 to 1.

        Returns:
            A field with static planes; this field if it does not move, if its time planes have
            another resolution than its space planes, or if its class is derived from this one.
        """
        if self.time is None or self.time.shape[2] != self.space.shape[2]:
            return self
        if type(self) is not XPlanes:  # A derived class may override how planes are combined.
            return self
        rows = self.time.shape[1]
        place = min(max(time, 0.0), 1.0) * (rows - 1)
        lower = min(int(place), max(rows - 2, 0))
        moving = self.time.detach()
        lines = torch.lerp(moving[:, lower], moving[:, min(lower + 1, rows - 1)], place - lower)
        planes = {
            name: (plane + lines[line, :, None] * lines[column]).permute(2, 0, 1)
            for name, plane, (column, line) in zip(
                SPACE_PLANES, self.space.detach(), self.rows, strict=True
            )
        }
        planes |= {name: plane for name, plane in self.planes.items() if name in FINE_PLANES}
        return XPlanes(
            planes=planes, decoder=self.decoder, plane_set="three", background=self.background
        )

    def features(self, points: Tensor, times: Tensor) -> Tensor:
        """Input of the decoder. [N, 3], [N] -> [N, 3 C]"""
        fine = self.fine if self.is_fine else None
        return plane_features(self.space, self.time, points, times, self.rows, fine).flatten(1)

    def forward(self, points: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        """Colour and density at points and times.

        Args:
            points: Positions in the field's frame, the cube [-1, 1]^3. [N, 3]
            times: Times from 0 to 1. [N]

        Returns:
            Colour in [0, 1], widened by the decoder's ``colour_margin``, and density per unit
            length of the field's frame. [N, 3], [N]
        """
        return self.decoder(self.features(points, times))


def _stack(planes: Mapping[str, Tensor], names: Sequence[str]) -> Tensor:
    """Named planes [C, rows, columns] as one tensor, channels last. [P, rows, columns, C]"""
    shapes = {name: list(planes[name].shape) for name in names}
    first = shapes[names[0]]
    if len(first) != 3 or any(shape != first for shape in shapes.values()):
        raise ValueError(f"planes {shapes}: must all have one shape [C, rows, columns]")
    if 0 in first:
        raise ValueError(f"planes {shapes}: must have at least one channel, row and column")
    return torch.stack([planes[name].permute(1, 2, 0) for name in names]).contiguous()


def random_planes(
    plane_set: str,
    *,
    channels: int,
    resolution: int,
    time_resolution: int,
    time_texels: int | None = None,
    space_scale: float,
    time_scale: float,
    generator: torch.Generator,
) -> dict[str, Tensor]:
    """Random initialisation for a field without an LRM: small noise around zero.

    Time planes must not be initialised to zero: a product of two zeros has no gradient.

    Args:
        plane_set: A key of `PLANE_SETS`.
        channels: Channels C of each plane.
        resolution: Texels along each space axis.
        time_resolution: Rows of the time planes.
        time_texels: Texels of the time planes along space; ``resolution`` when None.
        space_scale: Standard deviation of the space planes.
        time_scale: Standard deviation of the time planes.
        generator: Source of randomness.

    Returns:
        Planes by name. [C, rows, columns] each
    """
    square = (channels, resolution, resolution)
    planes = {name: space_scale * torch.randn(square, generator=generator) for name in SPACE_PLANES}
    strip = (channels, time_resolution, time_texels or resolution)
    for name in TIME_PLANES[plane_set]:
        planes[name] = time_scale * torch.randn(strip, generator=generator)
    return planes
