"""Files of torch.save read as data: the same numbers as torch.load gives, and nothing that a file says is ever done."""

from __future__ import annotations

import argparse
import builtins
import collections
import functools
import io
import os
import pickle
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from pipeline import torch_file
from pipeline.torch_file import Inert, Machine, StoredTensor, TorchFile, TorchFileError, read_bytes


def saved(value, **options) -> bytes:
    buffer = io.BytesIO()
    torch.save(value, buffer, **options)
    return buffer.getvalue()


def read(value, **options) -> TorchFile:
    return TorchFile(saved(value, **options), "a.ckpt")


def zipped(pickled: bytes, entries: dict[str, bytes] | None = None, compression: int = zipfile.ZIP_STORED) -> bytes:
    """A file of torch.save with a pickle of our own."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, content in ({"data.pkl": pickled} | (entries or {})).items():
            archive.writestr(f"archive/{name}", content)
    return buffer.getvalue()


def run(pickled: bytes):
    return Machine().run(pickled)


def refused(data: bytes, match: str) -> None:
    with pytest.raises(TorchFileError, match=match) as caught:
        TorchFile(data, "a.ckpt")
    assert str(caught.value).startswith("a.ckpt")


# Plain values and tensors


@pytest.mark.parametrize("protocol", range(6))
def test_plain_values_come_back(protocol):
    value = {"a": [1, -2, 3.5, None, True, 2**80], "b": ("x", (1,), (1, 2)), "c": {}, "d": (), "e": [[], {"f": "ü"}]}
    assert run(pickle.dumps(value, protocol)) == value
    if protocol >= 2:
        assert read(value, pickle_protocol=protocol).content == value


@settings(deadline=None, max_examples=50)
@given(
    value=st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=4),
        max_leaves=12,
    ),
    protocol=st.integers(0, 5),
)
def test_any_plain_value_comes_back(value, protocol):
    assert run(pickle.dumps(value, protocol)) == value


def test_values_that_are_shared_or_lie_in_themselves_are_read():
    shared = [1]
    loop: list = [shared, shared]
    loop.append(loop)
    found = run(pickle.dumps(loop, 2))
    assert found[0] is found[1]
    assert found[2] is found


def test_sets_become_lists_and_keys_that_are_no_text_become_inert():
    found = run(pickle.dumps({"s": {4}, "f": frozenset([5]), 7: "seven", (1, 2): "pair"}, 4))
    assert (found["s"], found["f"]) == ([4], [5])
    assert sorted((key.name, value) for key, value in found.items() if isinstance(key, Inert)) == [
        ("int", "seven"),
        ("tuple", "pair"),
    ]


@pytest.mark.parametrize(
    "dtype", [torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.int64, torch.int32]
)
def test_tensors_come_back_to_the_bit(dtype):
    values = {
        "matrix": torch.arange(12).view(3, 4).to(dtype),
        "scalar": torch.tensor(7).to(dtype),
        "empty": torch.zeros(0, 5).to(dtype),
    }
    file = read(values)
    for name, value in values.items():
        found = file.tensor(file.content[name])
        assert found.dtype == dtype
        assert torch.equal(found, value), name


def test_views_of_one_storage_come_back():
    base = torch.arange(24.0).view(4, 6)
    values = [base, base.t(), base[1:3, ::2], base[3, 5]]
    file = read(values)
    for value, stored in zip(values, file.content, strict=True):
        assert torch.equal(file.tensor(stored), value)
    assert len(file.storages) == 1


def test_a_state_dict_with_its_parameters_comes_back():
    module = nn.Sequential(nn.Linear(3, 2), nn.BatchNorm2d(2))
    file = read({"state": module.state_dict(), "parameter": module[0].weight})
    assert type(file.content["state"]) is dict
    for name, value in module.state_dict().items():
        assert torch.equal(file.tensor(file.content["state"][name]), value), name
    assert torch.equal(file.tensor(file.content["parameter"]), module[0].weight)
    assert file.named == []


def test_an_ordered_dict_that_is_made_from_pairs_comes_back():
    pickled = b"ccollections\nOrderedDict\n(((lS'b'\nI1\natR."  # OrderedDict((["b", 1],)): no pair in it, left out
    assert run(b"ccollections\nOrderedDict\n((l(lS'b'\naI1\naa(lS'a'\naI2\naatR.") == {"b": 1, "a": 2}
    with pytest.raises(ValueError, match="not there"):
        run(pickled)


# What is not data


class Callback:
    def __init__(self) -> None:
        self.best = 3


def test_objects_become_their_names():
    file = read(
        {
            "hyper_parameters": argparse.Namespace(N_vocab=1500, img_wh=[320, 240]),
            "folder": Path("/somewhere"),
            "counts": collections.Counter("aab"),
            "callbacks": {Callback: Callback()},
            "dtype": torch.float32,
            "complex": torch.zeros(2, dtype=torch.complex64),
            "last": 1,
        }
    )
    assert file.content["last"] == 1
    assert file.content["hyper_parameters"].name == "argparse.Namespace"
    assert isinstance(file.content["complex"], Inert)
    (callback,) = file.content["callbacks"].values()
    assert callback.name.endswith(".Callback")
    assert not hasattr(callback, "best")
    assert {"argparse.Namespace", "collections.Counter", callback.name} < set(file.named)


class Call:
    """Pickles as a call, and goes on with items that are set."""

    def __init__(self, function, *arguments, items=()) -> None:
        self.parts = (function, arguments, None, None, iter(items))

    def __reduce__(self):
        return self.parts


class Bomb:
    """Goes off when it is given its state, as an unpickler does."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __setstate__(self, state) -> None:
        Path(state["target"]).touch()


def attacks(target: Path) -> dict[str, object]:
    """Objects whose unpickling makes `target`. A hubconf.py that does the same lies beside it."""
    touch, code = f"touch {target}", f"open({str(target)!r}, 'w')"
    return {
        "os.system": Call(os.system, touch),
        "subprocess": Call(subprocess.check_call, ["touch", str(target)]),
        "eval": Call(builtins.eval, code),
        "exec": Call(builtins.exec, code),
        "open": Call(builtins.open, str(target), "w"),
        "bound method": Call(target.touch),
        "state": Bomb(target),
        "hub": Call(functools.partial(torch.hub.load, source="local"), str(target.parent), "entry"),
        "pickle in a pickle": Call(pickle.loads, pickle.dumps(Call(os.system, touch))),
        "storage": Call(functools.partial(torch.load, weights_only=False), io.BytesIO(saved(Call(os.system, touch)))),
        "item of a dictionary": Call(collections.OrderedDict, items=[("a", Call(os.system, touch))]),
        "key of a dictionary": {Callback: {"a": [Call(os.system, touch)]}},
    }


@pytest.fixture
def target(tmp_path):
    (tmp_path / "hubconf.py").write_text(f"def entry():\n    open({str(tmp_path / 'proof')!r}, 'w')\n")
    return tmp_path / "proof"


@pytest.mark.parametrize("protocol", [2, 4])
@pytest.mark.parametrize("name", attacks(Path("x")))
def test_an_attack_does_nothing(name, protocol, target):
    file = read(
        {"state_dict": {"w": torch.ones(2)}, "attack": attacks(target)[name], "last": 1}, pickle_protocol=protocol
    )
    assert not target.exists()
    assert file.named
    assert file.content["last"] == 1
    assert torch.equal(file.tensor(file.content["state_dict"]["w"]), torch.ones(2))


@pytest.mark.parametrize("name", attacks(Path("x")))
def test_the_attacks_are_real(name, target):
    """An unpickler falls for each of them, so that the test above can fail."""
    torch.load(io.BytesIO(saved(attacks(target)[name])), weights_only=False)
    assert target.exists()


@pytest.mark.parametrize(
    "pickled",
    [
        b"cos\nsystem\n(S'touch TARGET'\ntR.",  # REDUCE
        b"(S'touch TARGET'\nios\nsystem\n.",  # INST
        b"(cos\nsystem\nS'touch TARGET'\no.",  # OBJ
        b"\x80\x02cos\nsystem\n(S'touch TARGET'\nt\x81.",  # NEWOBJ
        b"\x80\x04cos\nsystem\n(S'touch TARGET'\nt}\x92.",  # NEWOBJ_EX
        b"\x80\x04S'os'\nS'system'\n\x93(S'touch TARGET'\ntR.",  # STACK_GLOBAL
        b"cos\nsystem\n(S'touch TARGET'\ntRS'a'\nb.",  # and BUILD on the result
        b"cos\nsystem\n(S'touch TARGET'\ntRS'a'\nI1\ns.",  # and SETITEM
        b"cos\nsystem\n(S'touch TARGET'\ntRI1\na.",  # and APPEND
        b"c__builtin__\nmap\n(cos\nsystem\n(lS'touch TARGET'\natR.",
        b"Ptouch TARGET\n.",  # PERSID
        b"(S'storage'\ncos\nsystem\nS'0'\nS'cpu'\nI1\ntQ.",  # BINPERSID
        b"ctorch._utils\n_rebuild_tensor_v2\n(cos\nsystem\nS'touch TARGET'\nI1\nI1\ntR.",
    ],
)
def test_by_hand_in_every_instruction_that_can_call(pickled, target):
    found = run(pickled.replace(b"TARGET", str(target).encode()))
    assert isinstance(found, Inert)
    assert not target.exists()


def test_nothing_is_imported(tmp_path, monkeypatch):
    (tmp_path / "crossray_attack.py").write_text("raise SystemExit\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert run(b"ccrossray_attack\nThing\n)\x81.") is not None
    assert run(b"\x80\x04\x8c\x0fcrossray_attack\x8c\x05Thing\x93)R.").name == "crossray_attack.Thing"
    assert "crossray_attack" not in sys.modules


def test_names_are_made_printable():
    machine = Machine()
    machine.run(b"cos\n\x1b]0;owned\x07\n0cos\n" + b"x" * 5000 + b"\n.")
    assert all(name.isprintable() and len(name) < 200 for name in machine.named)


# Damage


@pytest.mark.parametrize(
    "pickled",
    [
        b"",
        b"garbage",
        b"]",  # never stops
        b".",  # nothing to give
        b"R.",
        b"(t(.",
        b"I1\n\x85\x86.",
        b"(I1\nd.",  # half a pair
        b"}(I1\nu.",
        b"h\x05.",  # recalls what it never remembered
        b"p-1\n.",
        b"I1\np99999999999999\n.",
        b"\x80\x04I1\nI2\n\x93.",  # a name that is no text
        b"\x82\x01.",  # EXT1
        b"\x97.",  # NEXT_BUFFER
        b"X\xff\xff\xff\x7fshort",
        b"\x8e" + struct.pack("<Q", 2**62) + b"short",
        b"\x96" + struct.pack("<Q", 2**40) + b"short",
        b"I" + b"9" * 10000 + b"\n.",
    ],
)
def test_a_damaged_pickle_is_refused(pickled):
    refused(zipped(pickled), "pickle is damaged")


def test_what_is_no_file_of_torch_save_is_refused(tmp_path):
    refused(b"", "not a file of torch.save")
    refused(b"<!DOCTYPE html><html>quota exceeded", "web page")
    refused(saved({"a": torch.ones(3)}, _use_new_zipfile_serialization=False), r"before 1\.6")
    refused(pickle.dumps({"a": 1}, 2), r"before 1\.6")
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("readme.txt", "hello")
    refused(buffer.getvalue(), "it has no one <name>/data.pkl")
    with pytest.raises(TorchFileError, match="no such file"):
        read_bytes(tmp_path / "missing.ckpt")
    with pytest.raises(TorchFileError, match="no such file"):
        read_bytes(tmp_path)


@pytest.mark.parametrize("share", [0.01, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused(share):
    data = saved({"a": torch.ones(300)})
    refused(data[: int(share * len(data))], "cut short")


def test_changed_numbers_are_noticed():
    data = bytearray(saved({"a": torch.full((300,), 1.5)}))
    at = data.index(struct.pack("<f", 1.5) * 300)
    data[at] ^= 1
    file = TorchFile(bytes(data), "a.ckpt")
    with pytest.raises(TorchFileError, match="data/0 cannot be read: Bad CRC"):
        file.tensor(file.content["a"])


def test_a_missing_or_short_storage_is_refused():
    pickled = zipfile.ZipFile(io.BytesIO(saved([torch.ones(4)]))).read("archive/data.pkl")
    for entries, match in (({}, "data/0 cannot be read"), ({"data/0": b"1234"}, "has 4 bytes, not the 16")):
        file = TorchFile(zipped(pickled, entries), "a.ckpt")
        with pytest.raises(TorchFileError, match=match):
            file.tensor(file.content[0])


def test_bombs_are_refused(monkeypatch):
    refused(zipped(b"0" * 10**6, compression=zipfile.ZIP_DEFLATED), "compressed or encrypted")

    data = bytearray(zipped(b"N.", {"data/0": b"0" * 100}))
    at = data.rindex(b"PK\x01\x02")  # the last entry of the directory; its size is 24 bytes in
    struct.pack_into("<L", data, at + 24, 2**31)
    refused(bytes(data), "entries claim 21474836.. bytes")

    monkeypatch.setattr(torch_file, "MOST_PICKLE", 100)
    refused(zipped(b"]" + b"]a" * 100 + b"."), "larger than 100 bytes")


def test_a_file_that_is_too_large_is_refused_before_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(torch_file, "MOST_BYTES", 100)
    path = tmp_path / "a.ckpt"
    path.write_bytes(bytes(101))
    with pytest.raises(TorchFileError, match="larger than 100 bytes"):
        read_bytes(path)
    path.write_bytes(bytes(100))
    assert len(read_bytes(path)) == 100


def test_another_byte_order_is_refused():
    refused(zipped(b"N.", {"byteorder": b"big"}), "little-endian")


@pytest.mark.parametrize(
    ("shape", "stride", "offset"),
    [
        ((5,), (1,), 0),
        ((4,), (1,), 1),
        ((2, 2), (3, 1), 0),
        ((2**30,), (0,), 0),
        ((2**39, 2**39), (0, 0), 0),
        ((-1,), (1,), 0),
        ((2,), (-1,), 1),
        ((2,), (1, 1), 0),
        ((True,), (1,), 0),
        ((2.0,), (1,), 0),
        ([2], (1,), 0),
        ((2,), (1,), -1),
        ((2**80,), (1,), 0),
        ("ab", (1,), 0),
        ((1,) * 100, (1,) * 100, 0),
    ],
)
def test_a_tensor_outside_its_storage_is_refused(shape, stride, offset):
    file = read([torch.ones(4)])
    storage = file.content[0].storage
    with pytest.raises(TorchFileError, match="describes a tensor"):
        file.tensor(StoredTensor(storage, offset, shape, stride))


def test_values_that_would_take_forever_to_hash_or_deep_ones_are_read():
    nested = b"\x80\x02K\x01q\x00" + b"h\x00h\x00\x86q\x00" * 200
    assert len(run(nested + b"}h\x00I1\ns.")) == 1  # as a key, the hash would take 2^200 steps
    assert isinstance(run(b"\x80\x02" + b"]" * 10**5 + b"a" * (10**5 - 1) + b"."), list)


DATA = saved(collections.OrderedDict(a=torch.ones(7), b=argparse.Namespace(c=[torch.zeros(2, 3)])))


@settings(deadline=None, max_examples=200)
@given(data=st.data())
def test_any_damage_is_refused_or_harmless(data):
    damaged = bytearray(DATA)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(DATA) - 1))] = data.draw(st.integers(0, 255))
    try:
        file = TorchFile(bytes(damaged), "a.ckpt")
        for value in file.content.values() if isinstance(file.content, dict) else ():
            if isinstance(value, StoredTensor):
                file.tensor(value)
    except TorchFileError:
        pass


PICKLE = zipfile.ZipFile(io.BytesIO(DATA)).read("archive/data.pkl")


@settings(deadline=None, max_examples=300)
@given(data=st.data())
def test_any_pickle_is_refused_or_harmless(data):
    """Under a checksum that agrees, so that the damage reaches the instructions."""
    damaged = bytearray(PICKLE)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(PICKLE) - 1))] = data.draw(st.integers(0, 255))
    try:
        file = TorchFile(zipped(bytes(damaged), {"data/0": bytes(28)}), "a.ckpt")
        for value in file.content.values() if isinstance(file.content, dict) else ():
            if isinstance(value, StoredTensor):
                file.tensor(value)
    except TorchFileError:
        pass
