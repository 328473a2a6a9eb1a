"""The record of losses: appended, cut, and read back as the bits that it was given."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipeline.errors import CrossrayError
from pipeline.record import LossRecord, read_losses, read_record, record_path

NAMES = ("fine", "gradient_norm")


def row(step: int) -> dict[str, torch.Tensor]:
    return {name: torch.tensor(step + i / 7) for i, name in enumerate(NAMES)}


def filled(path, first: int, last: int) -> LossRecord:
    record = LossRecord(path, first)
    for step in range(first, last):
        record.add(row(step))
    assert record.look() is None
    record.save()
    return record


def expected(*steps: int) -> np.ndarray:
    return np.array([[float(v) for v in row(s).values()] for s in steps], np.float32)


def test_rows_come_back_to_the_bit(tmp_path):
    record = filled(record_path(tmp_path, 3), 0, 5)
    record.add(row(5))
    record.look()
    record.save()
    (found,) = read_losses(tmp_path).values()
    assert read_losses(tmp_path).keys() == {3}
    assert found.names == NAMES
    assert found.rows.tobytes() == expected(*range(6)).tobytes()


def test_a_resumed_record_replaces_what_came_after(tmp_path):
    path = tmp_path / "rank-0.f32"
    filled(path, 0, 9)
    with path.open("ab") as file:
        file.write(b"tor")  # a write that was cut off
    filled(path, 4, 6)
    assert read_record(path).rows.tobytes() == expected(*range(6)).tobytes()


@pytest.mark.parametrize("there", [None, b"", b"something else\n1234", b'{"names": ["other"]}\n1234'])
def test_steps_that_were_not_recorded_are_nan(tmp_path, there):
    path = tmp_path / "rank-0.f32"
    if there is not None:
        path.write_bytes(there)
    filled(path, 2, 4)
    rows = read_record(path).rows
    assert np.isnan(rows[:2]).all()
    assert rows[2:].tobytes() == expected(2, 3).tobytes()


def test_a_step_that_is_left_out_is_nan_and_not_bad(tmp_path):
    path = tmp_path / "rank-0.f32"
    record = LossRecord(path, 0)
    record.leave_out()
    record.add(row(1))
    record.leave_out()
    assert record.look() is None
    record.save()
    rows = read_record(path).rows
    assert np.isnan(rows[[0, 2]]).all()
    assert rows[1].tobytes() == expected(1).tobytes()


def test_all_steps_left_out_are_written_once_there_is_a_name(tmp_path):
    path = tmp_path / "rank-0.f32"
    record = LossRecord(path, 0)
    record.leave_out()
    record.look()
    record.save()
    assert not path.exists()
    record.add(row(1))
    record.look()
    record.save()
    assert len(read_record(path).rows) == 2


def test_the_first_bad_step_is_found_once(tmp_path):
    record = LossRecord(tmp_path / "rank-0.f32", 10)
    record.add(row(10))
    record.add({"fine": torch.tensor(1.0), "gradient_norm": torch.tensor(torch.inf)})
    record.add({"fine": torch.tensor(torch.nan), "gradient_norm": torch.tensor(torch.nan)})
    assert record.look() == (11, ("gradient_norm",))
    assert record.look() is None  # nothing new


def test_a_failed_save_keeps_the_rows(tmp_path):
    blocked = tmp_path / "losses"
    blocked.write_text("a file where the folder should be")
    record = LossRecord(blocked / "rank-0.f32", 0)
    record.add(row(0))
    record.look()
    with pytest.raises(OSError, match="losses"):
        record.save()
    blocked.unlink()
    record.save()
    assert read_record(record.path).rows.tobytes() == expected(0).tobytes()


@pytest.mark.parametrize("content", [b"", b"not json\n", b"[1]\n", b'{"name": []}\n'])
def test_another_file_is_refused_by_name(tmp_path, content):
    path = tmp_path / "rank-0.f32"
    path.write_bytes(content)
    with pytest.raises(CrossrayError, match=r"rank-0\.f32: is not a record of losses"):
        read_record(path)
