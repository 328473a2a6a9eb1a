"""Where there is no terminal: a line now and then, with the time that is left."""

from __future__ import annotations

import pytest

from pipeline import progress as module
from pipeline.progress import Progress, shown


@pytest.fixture
def clock(monkeypatch):
    """A clock that a test turns by hand."""
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    return now


@pytest.fixture
def lines(monkeypatch):
    said: list[str] = []
    monkeypatch.setattr(module.log, "info", lambda text, *values: said.append(text % values))
    return said


def test_a_line_every_now_and_then_says_the_share_and_the_time_left(clock, lines):
    progress = Progress("training x")
    clock[0] += module.LINE_EVERY / 2
    progress.update(0.1)
    assert lines == []
    clock[0] = 120.0
    progress.update(0.25, "PSNR 20.0")
    assert lines == ["training x: 25 %, 60 s left  PSNR 20.0"]  # 20 s for a quarter
    progress.update(0.26)
    assert len(lines) == 1
    progress.close()


def test_the_time_left_of_a_resumed_run_counts_from_where_it_started(clock, lines):
    progress = Progress("training x", start=0.5)
    clock[0] = 120.0
    progress.update(0.75)
    assert "75 %, 20 s left" in lines[0]


def test_without_progress_no_time_is_promised(clock, lines):
    progress = Progress("training x")
    clock[0] = 120.0
    progress.update(0.0)
    assert lines == ["training x: 0 %  "]


def test_other_ranks_say_nothing(clock, lines):
    progress = Progress("training x", enabled=False)
    clock[0] = 200.0
    progress.update(0.5)
    progress.close()
    assert lines == []


def test_a_shown_mapper_gives_what_the_mapper_gives_and_hides_no_error():
    assert list(shown(map, "work")(abs, iter([-1, 2, -3]))) == [1, 2, 3]
    with pytest.raises(TypeError):
        list(shown(map, "work")(abs, [1, "no number"]))
