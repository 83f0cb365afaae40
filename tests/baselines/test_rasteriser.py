"""Gaussian splatting: values and gradients against the formulas, and what is at the edges."""

import dataclasses
import functools
import math
import sys

import numpy as np
import pytest
import torch

from tests.baselines import gaussian_oracle as oracle
from xplanes.backend import threads
from xplanes.baselines import networks
from xplanes.baselines.gaussians import rasteriser_cuda
from xplanes.baselines.gaussians.camera import Camera
from xplanes.baselines.gaussians.harmonics import spherical_harmonics
from xplanes.baselines.gaussians.rasteriser import GaussianError, rasterise
from xplanes.baselines.gaussians.reference import Splats
from xplanes.optional import MissingExtraError
from xplanes.scenes.cameras import camera_around

NAMES = ("means", "quaternions", "scales", "opacities", "colours")
KINDS = ("loops", "float32", "float64")
"""The compiled loops, and plain torch in two precisions."""

TOLERANCE = {"loops": 5e-6, "float32": 5e-6, "float64": 1e-9}


def camera_of(width=23, height=18, distance=4.0, near=0.01, far=100.0):
    focal, centre = (1.3 * width, 1.25 * width), (0.5 * width + 0.7, 0.5 * height - 0.4)
    options = {"width": width, "height": height, "near": near, "far": far}
    return Camera.from_pose(camera_around(40, 25, distance), focal=focal, centre=centre, **options)


def gaussians(count, *, seed=0, channels=3, size=0.15, spread=0.8):
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=draw, dtype=torch.float64)

    return [
        spread * normal(count, 3),
        normal(count, 4),
        size * (0.7 * normal(count, 3)).exp(),
        torch.rand(count, generator=draw, dtype=torch.float64),
        torch.rand(count, channels, generator=draw, dtype=torch.float64),
    ]


def at_float32(given):
    """The numbers that float32 holds, so that all precisions draw the same Gaussians."""
    return [t.float().double() for t in given]


@pytest.fixture(params=("loops", "float64"))
def kind(request, monkeypatch):
    monkeypatch.setenv("XPLANES_CPU_LOOPS", str(int(request.param == "loops")))
    return request.param


def drawn(kind, given, camera, **options):
    dtype = torch.float64 if kind == "float64" else torch.float32
    given = [t.detach().to(dtype, copy=True).requires_grad_() for t in given]
    image = rasterise(*given, camera, **options)
    if len(given[0]):
        image.means2d.retain_grad()
    return image, given


def close(ours, theirs, most):
    """Difference as a share of the largest expected value."""
    ours, theirs = ours.detach().double().numpy(), np.asarray(theirs)
    assert ours.shape == theirs.shape
    if theirs.size:
        scale = max(np.abs(theirs).max(), 1e-9)
        worst = np.abs(ours - theirs).max() / scale
        assert worst <= most, f"error {worst:.1e} of {scale:.1e}"


def weighed(image):
    """A loss of colour, opacity and depth, with the same weights for the same sizes."""
    draw, total = torch.Generator().manual_seed(5), 0
    for output in (image.colour, image.opacity, image.depth):
        weights = torch.randn(output.shape, generator=draw, dtype=torch.float64)
        total = total + (output * weights.to(output)).sum()
    return total


@pytest.mark.parametrize("kind", KINDS, indirect=True)
@pytest.mark.parametrize("antialiased", [False, True])
def test_images_are_those_of_the_formulas(kind, antialiased):
    # Several tiles, Gaussians across their edges and beyond the image's, behind, and too near.
    for channels, size in ((3, 0.15), (1, 0.5), (7, 0.02), (0, 0.1)):
        given = at_float32(gaussians(60, channels=channels, size=size))
        camera = camera_of(45, 70, distance=2.5, near=1.0, far=4.0)
        background = torch.linspace(0, 1, channels)
        options = {"background": background, "antialiased": antialiased}
        image, _ = drawn(kind, given, camera, **options)
        expected = oracle.splat(given, camera, **options)
        outputs = (image.colour, image.opacity, image.depth)
        for ours, theirs in zip(outputs, expected, strict=True):
            close(ours, theirs, TOLERANCE[kind])
        assert 0 < (image.radii > 0).sum() < 60


@pytest.mark.parametrize("kind", ["float64"], indirect=True)
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("channels", [3, 5])
def test_gradients_of_plain_torch_are_slopes_of_its_values(kind, channels, antialiased):
    background = torch.linspace(0.2, 1, channels, dtype=torch.float64)

    def loss(*given, camera):
        return weighed(rasterise(*given, camera, background=background, antialiased=antialiased))

    given, camera = gaussians(5, seed=3, channels=channels, size=0.3), camera_of()
    leaves = [t.requires_grad_() for t in given]
    seen = functools.partial(loss, camera=camera)
    assert torch.autograd.gradcheck(seen, leaves, atol=1e-6, rtol=1e-6)
    image, _ = drawn(kind, given, camera, background=background, antialiased=antialiased)
    weighed(image).backward()
    # Moving the principal point moves all projected means alike, and nothing else.
    for axis, name in enumerate(("cx", "cy")):
        ends = [getattr(camera, name) + step for step in (1e-6, -1e-6)]
        values = [loss(*given, camera=dataclasses.replace(camera, **{name: e})) for e in ends]
        slope = float((values[0] - values[1]).detach()) / 2e-6
        assert float(image.means2d.grad[:, axis].sum()) == pytest.approx(slope, rel=2e-5)


@pytest.mark.parametrize(("antialiased", "channels"), [(False, 3), (True, 5)])
def test_loops_and_plain_torch_agree_on_many_gaussians(monkeypatch, antialiased, channels):
    found, options = [], {"background": torch.ones(channels), "antialiased": antialiased}
    for kind in ("loops", "float64"):
        monkeypatch.setenv("XPLANES_CPU_LOOPS", str(int(kind == "loops")))
        given = at_float32(gaussians(1500, size=0.04, channels=channels))
        image, leaves = drawn(kind, given, camera_of(90, 75), **options)
        weighed(image).backward()
        gradients = [image.means2d.grad, *(t.grad for t in leaves)]
        found.append([image.colour, image.opacity, image.depth, image.radii, *gradients])
    for ours, theirs in zip(*found, strict=True):
        close(ours, theirs.detach().double(), 1e-5)


def test_the_same_bits_on_any_number_of_threads(monkeypatch):
    monkeypatch.setenv("XPLANES_CPU_LOOPS", "1")
    found = []
    for count in (1, 2, 2):
        with threads(count):
            image, given = drawn("loops", gaussians(800, size=0.05), camera_of(100, 80))
            weighed(image).backward()
        tensors = (image.colour, image.opacity, image.depth, image.means2d.grad)
        found.append([*tensors, *(t.grad for t in given)])
    for first, *others in zip(*found, strict=True):
        assert all(torch.equal(first, other) for other in others)


def in_front(camera, across=0.0, distance=0.0):
    """A point on the camera's axis, ``distance`` beyond the origin, moved to its right."""
    local = torch.tensor([across, 0.0, 4.0 + distance, 1.0], dtype=torch.float64)
    return (torch.linalg.inv(camera.world_to_camera.double()) @ local)[:3]


def single(camera, scale=(0.1, 0.1, 0.1), opacity=0.8, quaternion=(1, 0, 0, 0), **where):
    return [
        in_front(camera, **where)[None],
        torch.tensor([quaternion], dtype=torch.float64),
        torch.tensor([scale], dtype=torch.float64),
        torch.tensor([opacity], dtype=torch.float64),
        torch.tensor([[0.2, 0.5, 0.9]], dtype=torch.float64),
    ]


@pytest.mark.parametrize(
    "scale", [(0, 0, 0), (0, 0.3, 0.3), (0, 0, 0.5), (1e-9, 1e-9, 1), (1e-4, 3, 3), (5, 5, 5)]
)
def test_points_needles_discs_and_giants(kind, scale):
    camera = camera_of()
    given = at_float32(single(camera, scale, quaternion=(0.3, 0.8, -0.2, 0.5)))
    for antialiased in (False, True):
        image, leaves = drawn(kind, given, camera, antialiased=antialiased)
        expected = oracle.splat(given, camera, antialiased=antialiased)
        # Compensation of a needle is a difference of squares in the oracle.
        most = max(TOLERANCE[kind], 1e-6 if antialiased else 0)
        close(image.opacity, expected[1], most)
        close(image.colour, expected[0], most)
        weighed(image).backward()
        assert all(leaf.grad.isfinite().all() for leaf in leaves)


def test_thousands_of_layers_stop_at_the_cut_off(kind):
    camera, layers = camera_of(20, 20), 3000
    given = [t.repeat(layers, *[1] * (t.ndim - 1)) for t in single(camera, (2, 2, 2), 0.006)]
    given[4] = torch.linspace(0, 1, 3 * layers, dtype=torch.float64).view(layers, 3)
    image, leaves = drawn(kind, given, camera)
    expected = oracle.splat(given, camera)
    close(image.opacity, expected[1], 10 * TOLERANCE[kind])
    close(image.colour, expected[0], 10 * TOLERANCE[kind])
    assert (1 - image.opacity > 0.9e-4).all()
    weighed(image).backward()
    # Behind the cut-off nothing is seen, and nothing is learnt.
    assert (leaves[4].grad[-500:] == 0).all()
    assert (leaves[4].grad[:500] != 0).all()


def test_gaussians_of_equal_depth_keep_their_order(kind):
    camera = camera_of()
    pair = [t.repeat(2, *[1] * (t.ndim - 1)) for t in single(camera, opacity=0.999)]
    pair[4] = torch.tensor([[1.0, 0, 0], [0, 1, 0]], dtype=torch.float64)
    image, _ = drawn(kind, pair, camera)
    swapped, _ = drawn(kind, [t.flip(0) for t in pair], camera)
    row, column = int(camera.cy), int(camera.cx)
    assert image.colour[row, column, 0] > 2 * image.colour[row, column, 1]
    assert torch.equal(image.colour[..., 0], swapped.colour[..., 1])


@pytest.mark.parametrize(
    "change",
    [
        {"distance": -5.0},  # Behind the camera.
        {"distance": -3.995},  # Nearer than near.
        {"across": 40.0},
        {"opacity": 0.0},
        {"opacity": 0.0039},
        {"scale": (1e30, 1.0, 1e25), "distance": 1e12},  # Beyond far.
    ],
)
def test_what_is_not_seen_changes_nothing(kind, change):
    camera = camera_of()
    seen = single(camera)
    both = [torch.cat(pair) for pair in zip(seen, single(camera, **change), strict=True)]
    alone, given = drawn(kind, seen, camera)
    weighed(alone).backward()
    image, leaves = drawn(kind, both, camera)
    weighed(image).backward()
    assert torch.equal(alone.colour, image.colour)
    assert image.radii.tolist() == [*alone.radii.tolist(), 0]
    for leaf, lone in zip(leaves, given, strict=True):
        torch.testing.assert_close(leaf.grad[:1], lone.grad)
        assert (leaf.grad[1:] == 0).all()


def test_no_gaussians_show_the_background(kind):
    given, background = [t[:0] for t in single(camera_of())], torch.tensor([0.25, 0.5, 1.0])
    image, leaves = drawn(kind, given, camera_of(), background=background)
    assert (image.colour == background.to(image.colour)).all()
    assert (image.opacity == 0).all()
    assert (image.depth == 0).all()
    image.colour.sum().backward()
    assert leaves[0].grad is None or leaves[0].grad.shape == (0, 3)


def test_numbers_and_shapes_that_cannot_be_are_named():
    for name, row, value, words in (
        *((name, 3, math.nan, "of Gaussian 3 of 5 are .*finite") for name in NAMES),
        *((name, 3, math.inf, "of Gaussian 3 of 5 are .*finite") for name in NAMES),
        ("scales", 2, -0.1, "of Gaussian 2 are .*-0.1"),
        ("opacities", 2, 1.1, "of Gaussian 2 are .*1.1"),
    ):
        given = dict(zip(NAMES, gaussians(5), strict=True))
        given[name][row] = value
        with pytest.raises(GaussianError, match=f"^{name} {words}"):
            rasterise(*given.values(), camera_of())
    for position, name in enumerate(NAMES):
        given = gaussians(5)
        given[position] = given[position][:4] if position else given[position][:, :2]
        with pytest.raises(GaussianError, match=rf"^{name} are \[.*must be \["):
            rasterise(*given, camera_of())
    with pytest.raises(GaussianError, match=r"^background is \[2\], but must be \[3\]"):
        rasterise(*gaussians(5), camera_of(), torch.ones(2))


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        *((name, value, f"={value}") for name, value in
          (("fx", 0.0), ("width", -1), ("near", 0.0), ("far", 0.001))),
        ("world_to_camera", torch.zeros(3, 4), r" is \[3, 4\]"),
        ("world_to_camera", torch.full((4, 4), math.nan), " is not finite"),
    ],
)  # fmt: skip
def test_cameras_that_cannot_be_are_refused(name, value, words):
    with pytest.raises(ValueError, match=rf"^camera\.{name}{words}"):
        dataclasses.replace(camera_of(), **{name: value})


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spherical_harmonics_are_those_of_legendre(degree):
    draw = np.random.default_rng(0)
    directions = draw.standard_normal((6, 3)) * 3
    coefficients = draw.standard_normal((6, 16, 3))
    found = spherical_harmonics(degree, torch.tensor(coefficients), torch.tensor(directions))
    pairs = [(d, order) for d in range(degree + 1) for order in range(-d, d + 1)]
    basis = np.array([[oracle.harmonic(*pair, to) for pair in pairs] for to in directions])
    expected = np.einsum("nk,nkc->nc", basis, coefficients[:, : len(pairs)])
    np.testing.assert_allclose(found, expected, atol=1e-12)
    units = torch.nn.functional.normalize(torch.tensor(directions), dim=1)
    inputs = networks.spherical_harmonics(units)[:, : len(pairs)]
    np.testing.assert_allclose(inputs, basis, atol=1e-12)


def test_cuda_says_what_brings_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(MissingExtraError, match=r"xplanes\[gaussians\]"):
        rasteriser_cuda.draw(Splats(*gaussians(3)), camera_of(), False)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("antialiased", [False, True])
def test_gsplat_draws_what_plain_torch_draws(antialiased):
    pytest.importorskip("gsplat", reason="needs the extra gaussians")
    given, camera = at_float32(gaussians(300, size=0.1)), camera_of(120, 90)
    found = []
    for device, dtype in (("cuda", torch.float32), ("cpu", torch.float64)):
        leaves = [t.to(device, dtype).requires_grad_() for t in given]
        image = rasterise(*leaves, camera, antialiased=antialiased)
        image.means2d.retain_grad()
        weighed(image).backward()
        tensors = (image.colour, image.opacity, image.depth, image.means2d.grad)
        found.append([t.detach().cpu() for t in (*tensors, *(t.grad for t in leaves))])
    for ours, theirs in zip(*found, strict=True):
        close(ours, theirs, 2e-3)  # gsplat's exponential is approximate.
