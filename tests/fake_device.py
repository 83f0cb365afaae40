"""A device without hardware: it computes on the CPU, and behaves as a GPU where that matters.

Its tensors do not mix with those of the CPU, random numbers come from its own generators alone, and
every operation, every wait for a value and every copy between host and device is counted. What a
GPU rounds otherwise, and how fast it is, cannot be seen here.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.utils import backend_registration
from torch.utils._pytree import tree_map_only

aten = torch.ops.aten

NAME = "fake"

FREE = {
    aten.detach.default,
    aten.alias.default,
    aten.lift_fresh.default,
    aten.empty_like.default,
    aten.new_empty.default,
    aten.new_empty_strided.default,
    aten.set_.source_Tensor,
    aten._unsafe_view.default,
    aten._reshape_alias.default,
}
"""What launches nothing, beside views."""

WAITING = {
    aten._local_scalar_dense,
    aten.nonzero,
    aten.masked_select,
    aten.repeat_interleave,
    aten.unique_dim,
    aten._unique2,
    aten.unique_consecutive,
    aten.bincount,
    aten.equal,
    aten.is_nonzero,
    aten._linalg_svd,
    aten._linalg_eigh,
    aten._linalg_check_errors,
    aten.linalg_cholesky_ex,
}
"""What a GPU cannot answer without the host's waiting for it."""


@dataclass
class Counts:
    """What was asked of the device.

    Attributes:
        operations: By name; on a GPU each launches a kernel at least.
        waits: What waited for the device, by name.
        copies: Copies of tensors from the host, by shape and type.
    """

    operations: Counter[str] = field(default_factory=Counter)
    waits: Counter[str] = field(default_factory=Counter)
    copies: Counter[str] = field(default_factory=Counter)

    @property
    def totals(self) -> tuple[int, int, int]:
        return self.operations.total(), self.waits.total(), self.copies.total()


_counts: list[Counts] = []
_libraries: list[Any] = []
_seeds: set[int] = set()
"""Of the generators of the device."""


@contextmanager
def counted() -> Iterator[Counts]:
    """Count what is asked of the device inside."""
    counts = Counts()
    _counts.append(counts)
    try:
        yield counts
    finally:
        _counts.remove(counts)


def count(kind: str, name: str) -> None:
    """Count an operation, a wait or a copy."""
    for counts in _counts:
        getattr(counts, kind)[name] += 1


class FakeTensor(torch.Tensor):
    """A tensor of the device; ``raw`` holds its values."""

    raw: Tensor

    @staticmethod
    def __new__(cls, raw: Tensor) -> "FakeTensor":
        made = torch.Tensor._make_wrapper_subclass(
            cls,
            raw.shape,
            strides=raw.stride(),
            storage_offset=raw.storage_offset(),
            dtype=raw.dtype,
            device=torch.device(NAME, 0),
        )
        made.raw = raw
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl

    def __repr__(self, **_: Any) -> str:
        return f"FakeTensor({self.raw})"

    def tolist(self) -> Any:
        return self.cpu().tolist()

    @property
    def data(self) -> Tensor:
        return self.detach()

    @data.setter
    def data(self, value: "FakeTensor") -> None:
        torch.Tensor.data.__set__(self, value)
        self.raw = value.raw

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        found = _copied(func, args, kwargs)
        if found is not None:
            return found
        _require_one_device(func, args, kwargs)
        _count(func, args)
        if "device" in kwargs:
            kwargs["device"] = torch.device("cpu")
        kwargs.pop("pin_memory", None)
        raw_args = tree_map_only(FakeTensor, lambda t: t.raw, args)
        raw_kwargs = tree_map_only(FakeTensor, lambda t: t.raw, kwargs)
        with torch.no_grad():
            result = func(*raw_args, **raw_kwargs)
        own = {id(t.raw): t for t in _tensors(args, kwargs)}
        return tree_map_only(
            torch.Tensor, lambda raw: own[id(raw)] if id(raw) in own else FakeTensor(raw), result
        )


def _tensors(*trees: Any) -> list[FakeTensor]:
    found: list[FakeTensor] = []
    tree_map_only(FakeTensor, found.append, trees)
    return found


def _copied(func: Any, args: Any, kwargs: Any) -> Any:
    """The result of copies between host and device; None for anything else."""
    packet = func.overloadpacket
    if packet is aten._to_copy and torch.device(kwargs.get("device") or NAME).type == "cpu":
        count("waits", "to the CPU")
        kwargs.pop("non_blocking", None)
        return func(args[0].raw, **kwargs)
    if packet is not aten.copy_:
        return None
    target, source = args[:2]
    if not isinstance(target, FakeTensor):
        count("waits", "to the CPU")
        return target.copy_(source.raw)
    if isinstance(source, FakeTensor):
        return None
    return _from_host(target, source)


def _from_host(target: FakeTensor, source: Tensor) -> FakeTensor:
    count("copies", f"{list(source.shape)} {source.dtype}")
    target.raw.copy_(source)
    return target


def _require_one_device(func: Any, args: Any, kwargs: Any) -> None:
    def check(tensor: Tensor) -> None:
        if not isinstance(tensor, FakeTensor) and tensor.dim():
            raise RuntimeError(
                f"{func} on tensors of two devices, {NAME} and {tensor.device} {list(tensor.shape)}"
            )

    tree_map_only(torch.Tensor, check, (args, kwargs))
    generator = kwargs.get("generator")
    # Torch hands over a new object for the same generator.
    if generator is not None and generator.initial_seed() not in _seeds:
        raise RuntimeError(f"{func} with a generator of the CPU")


def _count(func: Any, args: Any) -> None:
    name = func.overloadpacket.__name__
    if func.is_view or func in FREE:
        return
    count("operations", name)
    if func.overloadpacket in WAITING or _selects(func, args):
        count("waits", name)


def _selects(func: Any, args: Any) -> bool:
    """Whether an index is a mask, whose true entries have to be counted."""
    if func.overloadpacket not in (aten.index, aten.index_put, aten.index_put_):
        return False
    masked = any(t is not None and t.dtype in (torch.bool, torch.uint8) for t in args[1])
    # One number behind a mask is a fill, which counts nothing.
    return masked and not (func.overloadpacket is not aten.index and args[2].numel() == 1)


class _Module(getattr(backend_registration, "_DummyBackendModule", object)):
    """What ``torch.fake`` answers, and torch's stand-in does not."""

    @staticmethod
    def is_available() -> bool:
        return False  # Nobody else is to choose it.

    @staticmethod
    def synchronize(device: object = None) -> None:
        count("waits", "synchronize")

    @staticmethod
    def get_amp_supported_dtype() -> list[torch.dtype]:
        return [torch.bfloat16]


SETUP = getattr(backend_registration, "_setup_privateuseone_for_python_backend", None)
"""None in versions of torch that take no devices written in Python."""


def register() -> None:
    """Make the device known to torch, once in a process, before its first backward pass."""
    if _libraries or SETUP is None:
        return
    SETUP(NAME, backend_module=_Module())
    library = torch.library.Library("aten", "IMPL")

    def empty(size: Any, *, dtype: Any = None, memory_format: Any = None, **_: Any) -> Tensor:
        dtype = dtype or torch.get_default_dtype()
        return FakeTensor(torch.empty(size, dtype=dtype, memory_format=memory_format))

    def empty_strided(size: Any, stride: Any, *, dtype: Any = None, **_: Any) -> Tensor:
        return FakeTensor(torch.empty_strided(size, stride, dtype=dtype))

    def copy_from(source: Tensor, target: FakeTensor, non_blocking: bool = False) -> Tensor:
        return _from_host(target, source)  # ``torch.tensor`` calls this without dispatch.

    library.impl("_copy_from", copy_from, "PrivateUse1")
    library.impl("empty.memory_format", empty, "PrivateUse1")
    library.impl("empty_strided", empty_strided, "PrivateUse1")
    _libraries.append(library)


class FakeGenerator(torch.Generator):
    """Stands in for `torch.Generator`; those of the device draw other numbers than the CPU's."""

    def __new__(cls, device: Any = "cpu") -> "FakeGenerator":
        on_device = torch.device(device).type == NAME
        made = super().__new__(cls, "cpu" if on_device else device)
        made.on_device = on_device
        return made

    def __init__(self, device: Any = "cpu") -> None:
        super().__init__()

    def manual_seed(self, seed: int) -> "FakeGenerator":
        if self.on_device:
            seed ^= 0x5BF03635
            _seeds.add(seed)
        super().manual_seed(seed)
        return self
