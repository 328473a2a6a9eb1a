"""Checkpoints: what comes back is what was saved, and what is damaged is never used."""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_run import assert_same_bits

from pipeline import checkpoint as module
from pipeline.checkpoint import (
    META,
    MODEL,
    TRAINING,
    CheckpointError,
    committed,
    folder_name,
    latest_checkpoint,
    prune,
    read_checkpoint,
    save_checkpoint,
)

FILES = [MODEL, TRAINING, META]
IDENTITY = {"shards": "a" * 64, "job": "b" * 64, "seconds": 1.5, "finished": False, "world_size": 1}


def trained(seed: int = 0) -> tuple[dict[str, torch.Tensor], dict]:
    """Weights with every kind of tensor that a model has, and the state of an optimiser that has stepped."""
    torch.manual_seed(seed)
    layer = torch.nn.Linear(5, 3)
    optimiser = torch.optim.Adam(
        [{"params": [layer.weight], "part": "field", "base_lr": 0.1}, {"params": [layer.bias]}]
    )
    layer(torch.randn(7, 5)).square().sum().backward()
    optimiser.step()
    model = dict(layer.state_dict())
    model["count"] = torch.tensor(7)
    model["scalar"] = torch.zeros(())
    model["turned"] = torch.randn(4, 6).t()  # not contiguous
    return model, optimiser.state_dict()


def save(folder: Path, step: int, seed: int | None = None) -> Path:
    return save_checkpoint(folder, step, *trained(step if seed is None else seed), IDENTITY)


@pytest.fixture
def warnings(monkeypatch):
    """What the project's log warns of."""
    said: list[str] = []
    monkeypatch.setattr(module.log, "warning", lambda text, *values: said.append(text % values))
    return said


def flip(path: Path, position: int) -> None:
    content = bytearray(path.read_bytes())
    content[position] ^= 0x01
    path.write_bytes(content)


def test_what_comes_back_is_what_was_saved(tmp_path):
    model, optimiser = trained()
    target = save_checkpoint(tmp_path, 12, model, optimiser, IDENTITY)
    assert target == tmp_path / "step-00000012"
    assert sorted(p.name for p in target.iterdir()) == sorted(FILES)
    found = latest_checkpoint(tmp_path)
    assert found is not None
    assert (found.folder, found.step) == (target, 12)
    assert_same_bits(dict(found.model), {k: v.contiguous() for k, v in model.items()})
    assert_same_bits(found.optimiser(), optimiser)
    assert {key: found.meta[key] for key in IDENTITY} == IDENTITY


def test_the_optimiser_is_read_without_running_what_is_in_it(tmp_path):
    torch.load(save(tmp_path, 1) / TRAINING, weights_only=True)


def test_the_same_state_gives_the_same_files(tmp_path):
    a, b = save(tmp_path / "a", 3), save(tmp_path / "b", 3)
    for name in FILES:
        assert (a / name).read_bytes() == (b / name).read_bytes()


def test_no_checkpoint_is_none(tmp_path):
    assert latest_checkpoint(tmp_path / "absent") is None
    assert latest_checkpoint(tmp_path) is None
    assert committed(tmp_path) == []


def test_the_newest_is_taken(tmp_path):
    for step in (20, 3, 100):
        save(tmp_path, step)
    assert [p.name for p in committed(tmp_path)] == ["step-00000003", "step-00000020", "step-00000100"]
    newest = latest_checkpoint(tmp_path)
    assert newest is not None
    assert newest.step == 100


@pytest.mark.parametrize("name", [MODEL, TRAINING])
@pytest.mark.parametrize("place", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_a_flipped_byte_is_noticed_and_the_one_before_is_used(tmp_path, warnings, name, place):
    save(tmp_path, 1)
    path = save(tmp_path, 2) / name
    flip(path, int(place * (path.stat().st_size - 1)))
    found = latest_checkpoint(tmp_path)
    assert found is not None
    assert found.step == 1
    assert_same_bits(dict(found.model), {k: v.contiguous() for k, v in trained(1)[0].items()})
    assert len(warnings) == 1
    assert str(path) in warnings[0]
    with pytest.raises(CheckpointError, match=name):
        read_checkpoint(path.parent)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("left", [0, 10, -1])
def test_a_truncated_file_is_noticed(tmp_path, warnings, name, left):
    save(tmp_path, 1)
    path = save(tmp_path, 2) / name
    path.write_bytes(path.read_bytes()[:left])
    found = latest_checkpoint(tmp_path)
    assert found is not None
    assert found.step == 1
    assert len(warnings) == 1


@pytest.mark.parametrize("name", [MODEL, TRAINING])
def test_a_missing_file_is_noticed(tmp_path, warnings, name):
    save(tmp_path, 1)
    (save(tmp_path, 2) / name).unlink()
    found = latest_checkpoint(tmp_path)
    assert found is not None
    assert found.step == 1
    assert name in warnings[0]


def test_without_meta_it_was_never_committed(tmp_path, warnings):
    save(tmp_path, 1)
    (save(tmp_path, 2) / META).unlink()
    found = latest_checkpoint(tmp_path)
    assert found is not None
    assert found.step == 1
    assert warnings == []  # an interrupted save is no damage
    with pytest.raises(CheckpointError, match=r"meta\.json.*not completed"):
        read_checkpoint(tmp_path / "step-00000002")


def test_training_does_not_start_over_when_all_are_damaged(tmp_path, warnings):
    for step in (1, 2):
        flip(save(tmp_path, step) / MODEL, 100)
    with pytest.raises(CheckpointError, match="all 2 checkpoints are damaged"):
        latest_checkpoint(tmp_path)
    assert len(warnings) == 2


def test_a_flipped_byte_of_meta_is_noticed_or_harmless(tmp_path, warnings):
    """A wrong step or a wrong clock would be resumed from without a word."""
    path = save(tmp_path, 12) / META
    whole, expected = path.read_bytes(), read_checkpoint(path.parent).meta
    unnoticed = []
    digits = [i for i, c in enumerate(whole) if chr(c) in "0123456789" and b'"sha256"' not in whole[:i]]
    for position in sorted({*digits, *range(0, len(whole), 7)}):
        flip(path, position)
        try:
            meta = read_checkpoint(path.parent).meta
        except CheckpointError:
            pass
        else:
            if meta != expected:
                unnoticed.append(whole[max(0, position - 12) : position + 3].decode())
        path.write_bytes(whole)
    assert unnoticed == []


def test_a_checkpoint_under_another_steps_name_is_refused(tmp_path):
    shutil.move(save(tmp_path, 1), tmp_path / "step-00000009")
    with pytest.raises(CheckpointError):
        read_checkpoint(tmp_path / "step-00000009")


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=5,
)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    return save(tmp_path_factory.mktemp("fuzz"), 1)


@given(content=st.binary(max_size=40) | json_values.map(lambda v: json.dumps(v).encode()))
@settings(deadline=None, max_examples=30)
def test_any_other_meta_is_a_checkpoint_error(saved, content):
    (saved / META).write_bytes(content)
    with pytest.raises(CheckpointError, match="step-00000001"):
        read_checkpoint(saved)


@pytest.mark.parametrize(
    "change",
    [
        {"step": "many"},
        {"step": None},
        {"step": float("inf")},
        {"format": 3},
        {"format": None},
        {"sha256": {}},
        {"sha256": None},
        {"sha256": {"../../secret": "0" * 64}},
    ],
    ids=str,
)
def test_a_meta_with_a_wrong_entry_is_a_checkpoint_error(tmp_path, change):
    target = save(tmp_path, 1)
    meta = json.loads((target / META).read_text())
    (target / META).write_text(json.dumps(meta | change))
    with pytest.raises(CheckpointError, match="step-00000001"):
        read_checkpoint(target)


@pytest.mark.parametrize("entry", ["format", "step", "sha256"])
def test_a_meta_without_an_entry_is_a_checkpoint_error(tmp_path, entry):
    target = save(tmp_path, 1)
    meta = json.loads((target / META).read_text())
    del meta[entry]
    (target / META).write_text(json.dumps(meta))
    with pytest.raises(CheckpointError, match="step-00000001"):
        read_checkpoint(target)


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("again", [False, True], ids=["first_try", "same_step_again"])
def test_a_crash_while_saving_commits_nothing(tmp_path, monkeypatch, file, again):
    """Also where an older try at the same step was committed: its meta must not vouch for new files."""
    save(tmp_path, 1)
    if again:
        save(tmp_path, 2, seed=77)
    write = module.atomic_write

    def crash(path, content):
        if path.name == file:
            raise KeyboardInterrupt
        write(path, content)

    monkeypatch.setattr(module, "atomic_write", crash)
    with pytest.raises(KeyboardInterrupt):
        save(tmp_path, 2)
    monkeypatch.undo()
    assert [p.name for p in committed(tmp_path)] == ["step-00000001"]
    save(tmp_path, 2)  # the next try succeeds over the remains
    found = latest_checkpoint(tmp_path)
    assert found is not None
    assert_same_bits(dict(found.model), {k: v.contiguous() for k, v in trained(2)[0].items()})


def test_prune_keeps_the_newest(tmp_path):
    for step in (1, 2, 3, 4, 5):
        save(tmp_path, step)
    (tmp_path / "step-00000003" / META).unlink()  # an interrupted save, older than the newest
    remains = tmp_path / "step-00000009"  # one that may be under way
    remains.mkdir()
    prune(tmp_path, 2)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["step-00000004", "step-00000005", "step-00000009"]
    assert read_checkpoint(tmp_path / "step-00000004").step == 4


def test_prune_without_checkpoints_does_nothing(tmp_path):
    prune(tmp_path, 2)
    (tmp_path / "step-00000009").mkdir()
    prune(tmp_path, 2)
    assert [p.name for p in tmp_path.iterdir()] == ["step-00000009"]


def test_a_crash_while_pruning_leaves_no_half_checkpoint(tmp_path, monkeypatch):
    for step in (1, 2, 3):
        save(tmp_path, step)

    def crash(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(module.shutil, "rmtree", crash)
    with pytest.raises(KeyboardInterrupt):
        prune(tmp_path, 2)
    monkeypatch.undo()
    assert [p.name for p in committed(tmp_path)] == ["step-00000002", "step-00000003"]
    prune(tmp_path, 2)
    assert not (tmp_path / "step-00000001").exists()


def test_the_warning_names_what_is_used_instead(tmp_path, caplog):
    """Through the real logger: a user sees the file and that an older one is used."""
    save(tmp_path, 1)
    path = save(tmp_path, 2) / MODEL
    flip(path, 50)
    logger = logging.getLogger("crossray")
    logger.propagate = True
    with caplog.at_level(logging.WARNING, logger="crossray"):
        latest_checkpoint(tmp_path)
    assert str(path) in caplog.text
    assert "damaged" in caplog.text
    assert "checkpoint before it" in caplog.text


def test_damaged_checkpoints_that_training_passed_over_do_not_push_out_good_ones(tmp_path):
    for step in (1000, 2000, 3000):
        (tmp_path / folder_name(step)).mkdir()
        (tmp_path / folder_name(step) / "meta.json").write_text("damaged" if step > 1000 else "{}")
    (tmp_path / folder_name(1100)).mkdir()
    (tmp_path / folder_name(1100) / "meta.json").write_text("{}")
    prune(tmp_path, keep=2, newest=1100)
    assert {folder_name(1000), folder_name(1100)} <= {path.name for path in committed(tmp_path)}
