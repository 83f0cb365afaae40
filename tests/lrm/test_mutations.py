"""Deliberate mistakes: each must make at least one comparison with the published code fail."""

import importlib
import re
import sys
from pathlib import Path

import pytest

import xplanes.lrm
from tests.lrm.checks import CHECKS

SOURCES = Path(xplanes.lrm.__file__).parent

MISTAKES = [
    # Image encoders
    ("no normalisation of RGB", "config.py", "        mean=mean,\n", "        mean=None,\n"),
    ("mean for standard deviation", "config.py", "        std=std,\n", "        std=mean,\n"),
    ("encoder norm epsilon", "config.py", '("layer_norm_eps", 1e-12)', '("absent", 1e-2)'),
    ("DINOv2 norm epsilon", "config.py", "norm_epsilon=1e-6", "norm_epsilon=1e-2"),
    ("no layer scale", "vit.py", "scaled = config.layer_scale", "scaled = False"),
    (
        "layer scale of the other branch",
        "vit.py",
        "else self.scale1 * change",
        "else self.scale2 * change",
    ),
    (
        "no class position",
        "vit.py",
        "head, patches = position[:, :1],",
        "head, patches = 0 * position[:, :1],",
    ),
    ("no antialias", "vit.py", ", antialias=True)", ")"),
    ("no 0.1 in the position factor", "vit.py", "factor = (side + 0.1)", "factor = (side + 0.0)"),
    ("positions transposed", "vit.py", "permute(0, 3, 1, 2)", "permute(0, 3, 2, 1)"),
    (
        "registers kept",
        "vit.py",
        "tokens[:, 1 + config.registers :]], dim=1)\n        return",
        "tokens[:, 1 : -config.registers]], dim=1)\n        return",
    ),
    (
        "registers last",
        "vit.py",
        "[tokens[:, :1], registers, tokens[:, 1:]]",
        "[tokens[:, :1], tokens[:, 1:], registers]",
    ),
    (
        "registers get positions",
        "vit.py",
        "registers = self.registers.expand",
        "registers = (self.registers + self.position[:, :1]).expand",
    ),
    ("no final encoder norm", "vit.py", "        tokens = self.norm(tokens)\n", ""),
    (
        "encoder residual lost",
        "vit.py",
        "return tokens + (change if self.scale2",
        "return (change if self.scale2",
    ),
    # Attention and feed-forward
    ("tanh GELU", "attention.py", "nn.GELU()", 'nn.GELU(approximate="tanh")'),
    ("tanh GELU in the gate", "attention.py", "F.gelu(gate)", 'F.gelu(gate, approximate="tanh")'),
    ("gate and value swapped", "attention.py", "value, gate =", "gate, value ="),
    ("SiLU in the gate", "attention.py", "F.gelu(gate)", "F.silu(gate)"),
    (
        "query and key swapped",
        "attention.py",
        "product_attention(query, key",
        "product_attention(key, query",
    ),
    (
        "attention scale",
        "attention.py",
        "attention(query, key, value)",
        "attention(query, key, value, scale=0.2)",
    ),
    (
        "heads interleaved",
        "attention.py",
        "unflatten(-1, (self.heads, -1)).transpose(1, 2)",
        "unflatten(-1, (-1, self.heads)).transpose(2, 3).transpose(1, 2)",
    ),
    (
        "packed order",
        "keys.py",
        'QKV = ("query", "key", "value")',
        'QKV = ("key", "query", "value")',
    ),
    # OpenLRM
    (
        "no SiLU before the modulation",
        "openlrm.py",
        "nn.Sequential(nn.SiLU(), nn.Linear(",
        "nn.Sequential(nn.Identity(), nn.Linear(",
    ),
    ("shift and scale swapped", "openlrm.py", "shift, scale =", "scale, shift ="),
    ("scale without one", "openlrm.py", "(1 + scale)", "scale"),
    ("norm epsilon", "openlrm.py", "EPSILON = 1e-6", "EPSILON = 1e-2"),
    (
        "ReLU in the camera embedding",
        "openlrm.py",
        "            nn.SiLU(),\n",
        "            nn.ReLU(),\n",
    ),
    (
        "attention to itself first",
        "openlrm.py",
        "tokens = tokens + self.image_attention(self.norm1(tokens, camera), image)\n"
        "        tokens = tokens + self.self_attention(self.norm2(tokens, camera))",
        "tokens = tokens + self.self_attention(self.norm2(tokens, camera))\n"
        "        tokens = tokens + self.image_attention(self.norm1(tokens, camera), image)",
    ),
    ("no final norm", "openlrm.py", "return self.norm(tokens)\n\n", "return tokens\n\n"),
    ("third plane not turned", "openlrm.py", "third.transpose(-2, -1)", "third"),
    ("first plane turned", "openlrm.py", "[xy, xz, third", "[xy.transpose(-2, -1), xz, third"),
    ("planes exchanged", "openlrm.py", "[xy, xz, third", "[xz, xy, third"),
    ("decoder activation", "openlrm.py", 'activation="relu"', 'activation="silu"'),
    ("density activation", "openlrm.py", 'density="softplus"', 'density="exp"'),
    ("no colour margin", "openlrm.py", "colour_margin=0.001", "colour_margin=0.0"),
    # TripoSR
    (
        "attention to the image first",
        "triposr.py",
        "tokens = tokens + self.self_attention(self.norm1(tokens))\n"
        "        tokens = tokens + self.image_attention(self.norm2(tokens), image)",
        "tokens = tokens + self.image_attention(self.norm2(tokens), image)\n"
        "        tokens = tokens + self.self_attention(self.norm1(tokens))",
    ),
    (
        "group norm per token",
        "triposr.py",
        "self.norm(start.transpose(1, 2)).transpose(1, 2)",
        "self.norm(start.flatten(0, 1)).view_as(start)",
    ),
    ("group norm epsilon", "triposr.py", "width, eps=1e-6", "width, eps=1e-1"),
    ("number of groups", "triposr.py", "GroupNorm(32,", "GroupNorm(16,"),
    (
        "layer norm epsilon",
        "triposr.py",
        "self.norm2 = nn.LayerNorm(width)",
        "self.norm2 = nn.LayerNorm(width, eps=1e-2)",
    ),
    ("no outer residual", "triposr.py", "return start + self", "return self"),
    ("tokens transposed", "triposr.py", "permute(0, 2, 3, 1)", "permute(0, 3, 2, 1)"),
    ("chord for the radius", "triposr.py", "CHORD = 2 * 0.999 *", "CHORD = 0.999 *"),
    ("exp for softplus", "triposr.py", 'density="exp"', 'density="softplus"'),
    ("decoder activation", "triposr.py", 'activation="silu"', 'activation="relu"'),
    ("colour margin", "triposr.py", "colour_margin=0.0", "colour_margin=0.01"),
    # Both
    (
        "upsampled planes by columns",
        "model.py",
        "(3, side, side)).transpose(1, 2)",
        "(3, side, side)).transpose(1, 2).transpose(3, 4)",
    ),
    (
        "tokens by position, then plane",
        "model.py",
        "unflatten(2, (3, side, side)).transpose(1, 2)",
        "unflatten(2, (side, side, 3)).permute(0, 4, 1, 2, 3)",
    ),
    # Pictures
    ("black behind OpenLRM", "canonical.py", "background=1.0", "background=0.0"),
    ("white behind TripoSR", "canonical.py", "background=0.5", "background=1.0"),
    ("align_corners", "images.py", 'mode="bicubic", align_corners=True', 'mode="bicubic"'),
    ("bilinear for bicubic", "images.py", 'mode="bicubic"', 'mode="bilinear"'),
    ("no clamp", "images.py", "resized.clamp(0, 1)", "resized"),
    ("no antialias in pictures", "images.py", 'mode="bilinear", antialias=True', 'mode="bilinear"'),
    ("rounded, not cut off", "images.py", "(colour * 255).floor()", "(colour * 255).round()"),
    (
        "last row kept",
        "images.py",
        "top, bottom = int(rows.min()), int(rows.max())",
        "top, bottom = int(rows.min()), int(rows.max()) + 1",
    ),
    ("share of the foreground", "images.py", "FOREGROUND_RATIO = 0.85", "FOREGROUND_RATIO = 0.8"),
    # Cameras and alignment
    ("distance of the camera", "canonical.py", "distance=2.0", "distance=1.9"),
    ("TripoSR's distance", "canonical.py", "distance=1.9", "distance=2.0"),
    (
        "y up",
        "canonical.py",
        "rotation=((1, 0, 0), (0, 0, -1), (0, 1, 0))",
        "rotation=((1, 0, 0), (0, 1, 0), (0, 0, 1))",
    ),
    (
        "TripoSR looks from -x",
        "canonical.py",
        "rotation=((0, 0, 1), (1, 0, 0)",
        "rotation=((0, 0, -1), (-1, 0, 0)",
    ),
    ("focal length", "canonical.py", "focal=0.75", "focal=0.5"),
    ("pose by columns", "canonical.py", "[:, :3].flatten(1)", "[:, :3].transpose(1, 2).flatten(1)"),
    ("no focal factor in the scale", "alignment.py", "* share / (depth * view.focal)", "/ depth"),
    (
        "focal factor inverted",
        "alignment.py",
        "* share / (depth * view.focal)",
        "* view.focal / (depth * share)",
    ),
    ("rotation inverted", "alignment.py", "pose[:3, :3].T\n", "pose[:3, :3]\n"),
    ("box ignored in field units", "alignment.py", "return self.half_side", "return 1.0"),
]


@pytest.mark.parametrize("mistake", MISTAKES, ids=[f"{m[1]}: {m[0]}" for m in MISTAKES])
def test_mistake_is_noticed(mistake, tmp_path, monkeypatch):
    _, file, right, wrong = mistake
    name = re.sub(r"\W", "_", tmp_path.name)
    folder = tmp_path / name
    folder.mkdir()
    for source in SOURCES.glob("*.py"):
        text = source.read_text(encoding="utf-8")
        if source.name == file:
            assert text.count(right) == 1, f"{right!r} is {text.count(right)} times in {file}"
            text = text.replace(right, wrong)
        (folder / source.name).write_text(text.replace("xplanes.lrm", name), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    try:
        package = importlib.import_module(name)
        noticed = any(not passes(check, package) for _, check in CHECKS)
    finally:
        for module in [m for m in sys.modules if m.split(".")[0] == name]:
            del sys.modules[module]
    assert noticed


def passes(check, package):
    try:
        check(package)
    except (AssertionError, package.LRMError):
        return False
    return True
