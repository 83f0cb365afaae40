"""Triplane sequences, which every source of an initialisation supplies, and their files."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from xplanes.errors import ConfigError
from xplanes.fields.decoder import DECODER_OPTIONS, Decoder
from xplanes.files import replacing, stand_in
from xplanes.scenes.frame import Frame, check_frame, frame_content, read_frame
from xplanes.settings import check_arguments, flatten

MARK = "xplanes"
"""Metadata key of a safetensors file for values that are not tensors."""


def write_content(path: Path, content: dict[str, Any]) -> None:
    """Write a nested dict of tensors and builtins atomically.

    Args:
        path: Output file; the suffix ``.safetensors`` selects that format.
        content: The dict; keys have no dots.
    """
    with replacing(path) as temporary:
        if path.suffix != ".safetensors":
            torch.save(content, temporary)
            return
        from safetensors.torch import save_file

        flat = flatten(content).items()
        tensors = {name: value.contiguous() for name, value in flat if isinstance(value, Tensor)}
        rest = _without_tensors(content)
        save_file(tensors, temporary, metadata={MARK: json.dumps(rest)})


def read_content(path: Path) -> Any:
    """Read a file of `write_content`; errors are not converted."""
    if path.suffix != ".safetensors":
        return torch.load(path, map_location="cpu", weights_only=True)
    from safetensors import safe_open

    with safe_open(path, "pt") as file:
        content = json.loads((file.metadata() or {}).get(MARK, "{}"))
        for name in file.keys():  # noqa: SIM118, the file is not a dict
            node = content
            *groups, last = name.split(".", 1)
            for group in groups:
                node = node.setdefault(group, {})
            node[last] = file.get_tensor(name)
    return content


def _without_tensors(content: dict[str, Any]) -> dict[str, Any]:
    return {
        name: _without_tensors(value) if isinstance(value, dict) else value
        for name, value in content.items()
        if not isinstance(value, Tensor)
    }


_KEYS = {"triplanes", "decoder", "decoder_config", "frame"}


@dataclass(frozen=True)
class TriplaneSequence:
    """One triplane per timestep of a scene, with decoder and frame.

    Attributes:
        triplanes: Planes xy, xz, yz of timesteps evenly spaced over [0, 1]; plane "ab" has axis a
            along the columns and b along the rows, texels as in the field. Any floating type.
            [T, 3, C, H, H]
        decoder: Weights of their decoder, ``Decoder.state_dict()``; None if there is none.
        decoder_config: Its options, the keys of ``DECODER_OPTIONS``; given with ``decoder``.
        frame: Map from the world into the triplanes' cube; None for the scene's own frame.
    """

    triplanes: Tensor
    decoder: Mapping[str, Tensor] | None = None
    decoder_config: Mapping[str, Any] | None = None
    frame: Frame | None = None


def save_triplanes(path: Path, sequence: TriplaneSequence) -> None:
    """Write a sequence for ``lrm=file lrm.triplanes=PATH`` atomically.

    The suffix .safetensors selects that format; any other suffix selects torch.save. Keys:
    ``triplanes``, and optionally ``decoder``, ``decoder_config`` and ``frame`` {scale, rotation
    [3, 3], centre [3]}.

    Raises:
        ConfigError, SceneError: If the sequence is invalid.
    """
    check_sequence(sequence, str(path))
    content: dict[str, Any] = {"triplanes": sequence.triplanes.detach().cpu().clone()}
    if sequence.decoder is not None:
        content["decoder"] = {k: v.detach().cpu().clone() for k, v in sequence.decoder.items()}
        content["decoder_config"] = dict(sequence.decoder_config or {})
    if sequence.frame is not None:
        content["frame"] = frame_content(sequence.frame)
    write_content(Path(path), content)


def load_triplanes(path: Path) -> TriplaneSequence:
    """Read a file of `save_triplanes`.

    Raises:
        ConfigError, SceneError: If it is missing, damaged or invalid.
    """
    if not path.is_file():
        raise ConfigError(f"{path}: there is no such file; save_triplanes writes one")
    if (other := stand_in(path)) is not None:
        raise ConfigError(f"{path} {other}")
    try:
        content = read_content(path)
    except Exception as error:  # A damaged file raises many kinds of errors.
        # The original message advises loading the file as code.
        raise ConfigError(
            f"{path} cannot be read ({type(error).__name__}): it is damaged, or not written by "
            "save_triplanes"
        ) from error
    if not isinstance(content, dict) or "triplanes" not in content:
        found = ", ".join(map(str, content)) if isinstance(content, dict) else type(content)
        raise ConfigError(f"{path} holds {found}: it must be a dict with the key triplanes")
    if unknown := set(content) - _KEYS:
        names = ", ".join(sorted(map(str, unknown)))
        raise ConfigError(f"{path}: unknown keys {names}; allowed are {', '.join(sorted(_KEYS))}")
    frame = content.get("frame")
    sequence = TriplaneSequence(
        triplanes=content["triplanes"],
        decoder=content.get("decoder"),
        decoder_config=content.get("decoder_config"),
        frame=None if frame is None else read_frame(frame, str(path)),
    )
    check_sequence(sequence, str(path))
    return sequence


def check_sequence(sequence: TriplaneSequence, name: str) -> None:
    """Refuse a sequence that cannot initialise a field.

    Args:
        sequence: The sequence.
        name: Its name in messages.

    Raises:
        ConfigError, SceneError: For wrong types or shapes, values that are not finite, a decoder
            that does not fit, or an invalid frame.
    """
    planes = sequence.triplanes
    if not isinstance(planes, Tensor) or not planes.is_floating_point():
        kind = planes.dtype if isinstance(planes, Tensor) else type(planes).__name__
        raise ConfigError(f"{name}: triplanes are {kind}, but must be a floating-point tensor")
    shape = list(planes.shape)
    if len(shape) != 5 or shape[1] != 3 or 0 in shape or shape[3] != shape[4]:
        raise ConfigError(
            f"{name}: triplanes are {shape}, but must be [T, 3, C, H, H]: timesteps, planes xy, xz "
            "and yz, channels, and equally many rows and columns"
        )
    for number, frame in enumerate(planes):
        if not frame.float().isfinite().all():  # Checked in the computation type.
            raise ConfigError(f"{name}: triplane {number} of {len(planes)} holds NaN or infinity")
    if sequence.frame is not None:
        check_frame(sequence.frame, name)
    _check_decoder(sequence, name)


def _check_decoder(sequence: TriplaneSequence, name: str) -> None:
    state, options = sequence.decoder, sequence.decoder_config
    if state is None and options is None:
        return
    if not isinstance(state, Mapping) or not isinstance(options, Mapping):
        raise ConfigError(f"{name}: decoder and decoder_config must be dicts, given together")
    if set(options) != set(DECODER_OPTIONS):
        raise ConfigError(
            f"{name}: decoder_config has the keys {', '.join(map(str, options)) or '(none)'}, but "
            f"must have {', '.join(DECODER_OPTIONS)}"
        )
    try:
        check_arguments(Decoder.__init__, options)
    except ConfigError as error:
        raise ConfigError(f"{name}: decoder_config.{error}") from error
    # The settings classes check further constraints when these options replace theirs.
    if not (1 <= options["width"] <= 65536 and 0 <= options["hidden"] <= 256):
        raise ConfigError(
            f"{name}: decoder_config.width={options['width']}, hidden={options['hidden']}: out of "
            "range"
        )
    try:
        decoder = Decoder(
            sequence.triplanes.shape[2], width=options["width"], hidden=options["hidden"]
        )
        decoder.load_state_dict(dict(state))
    except (RuntimeError, TypeError, AttributeError) as error:
        raise ConfigError(
            f"{name}: decoder does not fit decoder_config and {sequence.triplanes.shape[2]} "
            f"channels: {error}"
        ) from error
    broken = [key for key, value in state.items() if not value.isfinite().all()]
    if broken:
        raise ConfigError(f"{name}: decoder.{broken[0]} holds NaN or infinity")
