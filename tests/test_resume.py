"""Training that was stopped twice and resumed in new processes is, to the bit, training that was not stopped."""

import random

import pytest

from tests.resume_cases import CASES, begin, further_piece, in_new_process, stopped_piece


def differences(expected, found):
    """Names of what differs."""
    return [name for name in {**expected, **found} if expected.get(name, "absent") != found.get(name, "absent")]


def joined(pieces):
    """
    :param pieces: Rows of the log of each piece of a training, and the step at which the next one goes on
    :return: The rows of the whole
    """
    return [row for rows, end in pieces for row in rows if row[0] <= end]


@pytest.mark.parametrize("name", CASES)
def test_is_as_if_it_had_not_been_stopped(tmp_path, name):
    case = CASES[name]
    if case.package is not None:
        pytest.importorskip(case.package)
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    whole.mkdir()
    stopped.mkdir()
    expected, expected_rows = begin(case, whole, 10**9)

    rng = random.Random(name)
    first, second = (int(case.total * rng.uniform(*shares)) for shares in ((0.3, 0.5), (0.65, 0.8)))
    nothing, first_rows = in_new_process(stopped_piece, name, stopped, case.save_freq, (first, case.ends[0]))
    assert nothing is None
    nothing, second_rows, first_end = in_new_process(further_piece, name, stopped, (second, case.ends[1]))
    assert nothing is None
    found, third_rows, second_end = in_new_process(further_piece, name, stopped, None)

    assert 0 < first_end < second_end < case.total
    assert differences(expected, found) == []
    assert joined([(first_rows, first_end), (second_rows, second_end), (third_rows, case.total * 2)]) == expected_rows
    if case.continual:
        returns = (whole / "returns.csv").read_bytes()
        assert returns == (stopped / "returns.csv").read_bytes() and returns.count(b"\n") > 3
    for name in ("task_returns.csv", "evaluations.csv"):
        if (whole / name).exists():
            assert (whole / name).read_bytes() == (stopped / name).read_bytes()
