"""A file of torch.save, read as data: nothing in it is executed.

Such a file is a zip of a pickle (`<name>/data.pkl`) and one entry a storage (`<name>/data/0`, ...). A pickle is a
program: an unpickler runs it, and it may call whatever it names. No unpickler runs here. The instructions are read one
by one, and only what makes plain values is done: numbers, text, lists, tuples, dictionaries, descriptions of tensors.
Anything else that a file names becomes an `Inert`, which holds the name and nothing more; calling it, or giving it a
state or items, is read and has no effect. Nothing is imported.

Sizes are checked before memory is taken: entries are not compressed (torch.save compresses nothing), together they are
no larger than the file, and a tensor has no more elements than its storage.
"""

from __future__ import annotations

import io
import math
import pickletools
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pipeline.errors import CrossrayError

MOST_BYTES = 2**30  # of a file; a released checkpoint has about 60 MB
MOST_PICKLE = 2**23  # bytes of its pickle; a released checkpoint's has about 0.1 MB
LEGACY = b"\x80"  # a bare pickle begins so: torch before 1.6

DTYPES = {
    "torch.DoubleStorage": torch.float64,
    "torch.FloatStorage": torch.float32,
    "torch.HalfStorage": torch.float16,
    "torch.BFloat16Storage": torch.bfloat16,
    "torch.LongStorage": torch.int64,
    "torch.IntStorage": torch.int32,
}
TENSOR = ("torch._utils._rebuild_tensor_v2", "torch._utils._rebuild_tensor")
PARAMETER = "torch._utils._rebuild_parameter"
DICTIONARY = "collections.OrderedDict"
UNDERSTOOD = {*DTYPES, *TENSOR, PARAMETER, DICTIONARY}

VALUES = {"INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"} | {
    *("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"),
    *("BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"),
}
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
MARK = object()


class TorchFileError(CrossrayError):
    """A file that cannot be read as data."""


@dataclass(frozen=True, eq=False)
class Inert:
    """What a file names and what is not made: a class, a function, or an object of them."""

    name: str


@dataclass(frozen=True, eq=False)
class Storage:
    """Numbers of one kind in an entry of the zip."""

    key: str
    dtype: torch.dtype
    length: int


@dataclass(frozen=True, eq=False)
class StoredTensor:
    """A tensor as the file describes it; nothing of it has been checked or read."""

    storage: Storage
    offset: Any
    shape: Any
    stride: Any


class TorchFile:
    """A file of torch.save.

    Args:
        data: the whole file.
        source: what messages call it.

    Attributes:
        content: what was saved, of dict, list, tuple, text, bytes, numbers, None, StoredTensor and Inert. Sets are
            lists; a key of a dict that is no text is an Inert.
        named: what else the file names, sorted, in printable form; none of it was made or called.

    Raises:
        TorchFileError: the file is damaged, too large, or not of torch.save's present format.
    """

    def __init__(self, data: bytes, source: str) -> None:
        self.source = source
        self.zip = open_zip(data, source)
        self.folder = self.find_folder()
        self.check_entries()
        self.storages: dict[str, Tensor] = {}
        machine = Machine()
        try:
            self.content = machine.run(self.read("data.pkl"))
        except (ValueError, TypeError, OverflowError) as error:
            raise TorchFileError(f"{source}: its pickle is damaged, or not one of torch.save: {error}") from error
        self.named = sorted(machine.named)

    def find_folder(self) -> str:
        """What the names of all entries begin with."""
        folders = [name.removesuffix("data.pkl") for name in self.zip.namelist() if name.endswith("/data.pkl")]
        if len(folders) != 1 or folders[0].count("/") != 1:
            raise TorchFileError(f"{self.source}: a zip, but not of torch.save: it has no one <name>/data.pkl")
        return folders[0]

    def check_entries(self) -> None:
        """TorchFileError for a pickle that is too large, or for numbers in the other byte order."""
        if self.zip.getinfo(f"{self.folder}data.pkl").file_size > MOST_PICKLE:
            raise TorchFileError(f"{self.source}: its data.pkl is larger than {MOST_PICKLE} bytes; no checkpoint's is")
        if f"{self.folder}byteorder" in self.zip.namelist() and self.read("byteorder") != b"little":
            raise TorchFileError(f"{self.source}: its numbers are not little-endian; save it again on another machine")

    def read(self, entry: str) -> bytes:
        """One entry, its checksum verified."""
        try:
            return self.zip.read(self.folder + entry)
        except Exception as error:  # zipfile raises half a dozen kinds on a damaged file
            raise TorchFileError(f"{self.source}: its entry {printable(entry)} cannot be read: {error}") from error

    def tensor(self, stored: StoredTensor) -> Tensor:
        """The numbers of a tensor.

        Raises:
            TorchFileError: they are not in the file, or it describes a tensor that does not lie within its storage.
        """
        storage, shape, stride, offset = stored.storage, stored.shape, stored.stride, stored.offset
        if not (is_sizes(shape) and is_sizes(stride) and is_sizes((offset,)) and len(shape) == len(stride)):
            raise TorchFileError(f"{self.source}: it describes a tensor with a shape or strides that are no numbers")
        if 0 in shape:
            if math.prod(n for n in shape if n) >= MOST_BYTES:
                raise TorchFileError(f"{self.source}: it describes a tensor of an impossible shape, {shape}")
            return torch.empty(shape, dtype=storage.dtype)
        last = offset + sum((n - 1) * step for n, step in zip(shape, stride, strict=True))
        if math.prod(shape) > storage.length or last >= storage.length:
            raise TorchFileError(f"{self.source}: it describes a tensor {shape} beyond its {storage.length} numbers")
        if storage.key not in self.storages:
            self.storages[storage.key] = self.numbers(storage)
        numbers = self.storages[storage.key]
        if numbers.dtype != storage.dtype or len(numbers) != storage.length:
            raise TorchFileError(f"{self.source}: it describes the storage {printable(storage.key)} in two ways")
        return numbers.as_strided(shape, stride, offset)

    def numbers(self, storage: Storage) -> Tensor:
        """A whole storage (length,)."""
        data = bytearray(self.read(f"data/{storage.key}"))
        if len(data) != storage.length * storage.dtype.itemsize:
            raise TorchFileError(
                f"{self.source}: its entry data/{printable(storage.key)} has {len(data)} bytes, not the "
                f"{storage.length * storage.dtype.itemsize} of {storage.length} {storage.dtype}"
            )
        return torch.frombuffer(data, dtype=storage.dtype) if data else torch.empty(0, dtype=storage.dtype)


def read_bytes(path: Path) -> bytes:
    """A whole file; TorchFileError where it is none, or larger than a checkpoint can be."""
    if not path.is_file():
        raise TorchFileError(f"{path}: there is no such file")
    with path.open("rb") as file:
        data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise TorchFileError(f"{path}: larger than {MOST_BYTES} bytes; a released checkpoint has about 60 MB")
    return data


def open_zip(data: bytes, source: str) -> zipfile.ZipFile:
    """The zip whose entries can be read without taking more memory than the file."""
    if data.startswith(LEGACY):
        raise TorchFileError(
            f"{source}: in torch's format before 1.6, a bare pickle, which is not read here. Where you trust the file, "
            "load and save it once with torch 1.6 or newer"
        )
    if not data.startswith(b"PK"):
        raise TorchFileError(f"{source}: not a file of torch.save (nor a zip at all); was a web page downloaded?")
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
        entries = archive.infolist()
    except Exception as error:  # zipfile raises half a dozen kinds on a damaged file
        raise TorchFileError(f"{source}: not a whole zip ({error}); was its download cut short?") from error
    if any(entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1 for entry in entries):
        raise TorchFileError(f"{source}: has compressed or encrypted entries, which torch.save never writes")
    total = sum(entry.file_size for entry in entries)
    if total > len(data):
        raise TorchFileError(f"{source}: its entries claim {total} bytes, but the file has {len(data)}")
    return archive


class Machine:
    """What a pickle's instructions do to a stack and a memory, as far as they make plain values."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.memory: dict[int, Any] = {}
        self.named: set[str] = set()

    def run(self, pickle: bytes) -> Any:
        """The value that a pickle describes; ValueError, TypeError or OverflowError for one that is damaged."""
        for instruction, argument, _ in pickletools.genops(pickle):
            if instruction.name == "STOP":
                return self.pop()
            self.step(instruction.name, argument)
        raise ValueError("it does not end")

    def step(self, name: str, argument: Any) -> None:
        """One instruction; its names are those of `pickletools`."""
        match name:
            case "PROTO" | "FRAME":
                pass
            case _ if name in VALUES:
                self.stack.append(argument)
            case _ if name in CONSTANTS:
                self.stack.append(CONSTANTS[name])
            case "MARK":
                self.stack.append(MARK)
            case "POP":
                del self.stack[-1:]
            case "POP_MARK":
                self.pop_to_mark()
            case "DUP":
                self.stack.append(self.top())
            case "GET" | "BINGET" | "LONG_BINGET":
                self.recall(argument)
            case "PUT" | "BINPUT" | "LONG_BINPUT":
                self.remember(argument)
            case "MEMOIZE":
                self.remember(len(self.memory))
            case "GLOBAL" | "STACK_GLOBAL" | "INST" | "OBJ" | "NEWOBJ" | "NEWOBJ_EX" | "REDUCE" | "BUILD":
                self.object(name, argument)
            case "PERSID" | "BINPERSID":
                self.stack.append(storage_of(argument if name == "PERSID" else self.pop()))
            case _:
                self.container(name)

    def container(self, name: str) -> None:
        """Instructions that make and fill lists, tuples and dictionaries."""
        match name:
            case "EMPTY_LIST" | "EMPTY_SET":
                self.stack.append([])
            case "LIST" | "FROZENSET":
                self.stack.append(self.pop_to_mark())
            case "TUPLE":
                self.stack.append(tuple(self.pop_to_mark()))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                items = [self.pop() for _ in range(int(name[-1]))]
                self.stack.append(tuple(reversed(items)))
            case "EMPTY_DICT":
                self.stack.append({})
            case "DICT":
                self.stack.append(dictionary(self.pop_to_mark()))
            case "APPEND":
                self.fill(list, [self.pop()])
            case "APPENDS" | "ADDITEMS":
                self.fill(list, self.pop_to_mark())
            case "SETITEM":
                value = self.pop()
                self.fill(dict, [self.pop(), value])
            case "SETITEMS":
                self.fill(dict, self.pop_to_mark())
            case _:
                raise ValueError(f"it has the instruction {name}")

    def object(self, name: str, argument: Any) -> None:
        """Instructions that name, call or change objects. None of it happens; what is understood is described."""
        match name:
            case "GLOBAL":
                self.stack.append(self.inert(argument.replace(" ", ".")))
            case "STACK_GLOBAL":
                last, first = self.pop(), self.pop()
                self.stack.append(self.inert(f"{text(first)}.{text(last)}"))
            case "INST":
                self.pop_to_mark()
                self.stack.append(self.inert(argument.replace(" ", ".")))
            case "OBJ":
                called = (self.pop_to_mark() or [None])[0]
                self.stack.append(described(called, ()))
            case "REDUCE" | "NEWOBJ":
                arguments = self.pop()
                self.stack.append(described(self.pop(), arguments))
            case "NEWOBJ_EX":
                self.pop()
                arguments = self.pop()
                self.stack.append(described(self.pop(), arguments))
            case "BUILD":
                self.pop()
                self.top()

    def inert(self, name: str) -> Inert:
        """A stand-in, noted."""
        if name not in UNDERSTOOD:
            self.named.add(printable(name))
        return Inert(name)

    def pop(self) -> Any:
        if not self.stack or self.stack[-1] is MARK:
            raise ValueError("it takes what is not there")
        return self.stack.pop()

    def top(self) -> Any:
        value = self.pop()
        self.stack.append(value)
        return value

    def pop_to_mark(self) -> list[Any]:
        items: list[Any] = []
        while self.stack:
            item = self.stack.pop()
            if item is MARK:
                return items[::-1]
            items.append(item)
        raise ValueError("it takes what is not there")

    def remember(self, index: int) -> None:
        if not 0 <= index < 2**32:
            raise ValueError(f"it remembers under the number {index}")
        self.memory[index] = self.top()

    def recall(self, index: int) -> None:
        if index not in self.memory:
            raise ValueError("it recalls what it never remembered")
        self.stack.append(self.memory[index])

    def fill(self, kind: type, items: list[Any]) -> None:
        """Put items into the container on top of the stack; where that is an Inert, nothing happens."""
        target = self.top()
        if kind is list and isinstance(target, list):
            target.extend(items)
        elif kind is dict and isinstance(target, dict):
            target.update(dictionary(items))


def dictionary(items: list[Any]) -> dict[Any, Any]:
    """[key, value, key, value, ...] -> dict.

    Keys that are no text are replaced: the hash of a nested tuple can take forever, and numbers can be made to collide.
    """
    pairs = zip(items[::2], items[1::2], strict=True)
    return {key if isinstance(key, str) else Inert(type(key).__name__): value for key, value in pairs}


def described(called: Any, arguments: Any) -> Any:
    """What calling something would give: a tensor's description, a dictionary, or an Inert."""
    name = called.name if isinstance(called, Inert) else type(called).__name__
    first = arguments[0] if isinstance(arguments, tuple) and arguments else None
    if name in TENSOR and isinstance(first, Storage) and len(arguments) >= 4:
        return StoredTensor(*arguments[:4])
    if name == PARAMETER and isinstance(first, StoredTensor):
        return first
    if name == DICTIONARY and isinstance(called, Inert):
        return dictionary(list(flat_pairs(first)))
    return Inert(name)


def flat_pairs(pairs: Any) -> Iterator[Any]:
    """[[key, value], ...] -> key, value, ...; whatever is no pair is left out."""
    for pair in pairs if isinstance(pairs, list) else ():
        if isinstance(pair, list | tuple) and len(pair) == 2:
            yield from pair


def storage_of(name: Any) -> Storage | Inert:
    """The storage that a persistent name of torch.save stands for: ("storage", kind, key, device, length)."""
    if isinstance(name, tuple) and len(name) == 5 and name[0] == "storage" and isinstance(name[1], Inert):
        kind, key, length = name[1].name, name[2], name[4]
        if kind in DTYPES and isinstance(key, str) and is_sizes((length,)):
            return Storage(key, DTYPES[kind], length)
        return Inert(kind)
    return Inert("a persistent name")


def is_sizes(value: Any) -> bool:
    """Whether a value is a tuple of numbers that can be sizes."""
    return isinstance(value, tuple) and all(type(n) is int and 0 <= n < 2**40 for n in value) and len(value) <= 8


def text(value: Any) -> str:
    """TypeError for what is no text."""
    if not isinstance(value, str):
        raise TypeError("it names something that is no text")
    return value


def printable(name: str) -> str:
    """A name of the file as it can be shown: short, and without what a terminal would act upon."""
    name = name if len(name) <= 100 else name[:100] + "..."
    return name if name.isprintable() else ascii(name)
