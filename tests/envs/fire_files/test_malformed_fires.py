"""Tests that a damaged file gives a one-line error or the same grid as the valid file."""

import re
import signal
import time
import warnings

import numpy as np
import pytest
import torch
from malformed_fires import cases, keys_of, wholes

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.reader import read_fires

GRID, HORIZON = (12, 10), 50
LONGEST = 5.0
"""maximum time to read a file, seconds"""


def read(path, **keys):
    """Returns the fires of a file on few cells."""
    return read_fires(FileFireConfig(path=str(path), **keys), GRID, HORIZON)


@pytest.fixture(scope="module")
def alarm():
    """Interrupts a reader that hangs."""

    def stop(*_):
        raise TimeoutError(f"no end after {3 * LONGEST} seconds")

    before = signal.signal(signal.SIGALRM, stop)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, before)


def outcome(case) -> str:
    """Returns the reader's fault, or an empty string."""
    signal.setitimer(signal.ITIMER_REAL, 3 * LONGEST)
    began = time.perf_counter()
    try:
        fires = read(case.path, **case.keys)
    except ValueError as error:
        message = str(error)
        shown = case.path.name if len(case.path.name) < 60 else case.path.name[-15:]
        if "\n" in message or shown not in message:
            return f"does not name the file in one line: {message!r}"
        if len(message) > 600:
            return f"a line of {len(message)} characters: {message[:100]!r}"
        if case.cause and not re.search(case.cause, message.replace("\n", " ")):
            return f"says {message!r}, not {case.cause!r}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    else:
        if case.whole is None:
            return f"was read: {torch.isfinite(fires).sum()} cells burn"
        kind = "asc" if case.whole.suffix == ".asc" else case.whole.suffix[1:]
        whole = read(case.whole, **keys_of(kind))
        burnt = [torch.isfinite(bank).sum().item() for bank in (fires, whole)]
        if kind == "txt":
            if ((fires != whole) & torch.isfinite(fires)).any():
                return "has other times than the whole file"
        elif not torch.equal(fires, whole):
            return f"was read, and differently: {burnt[0]} cells burn, of the whole file {burnt[1]}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    took = time.perf_counter() - began
    return f"took {took:.1f} s" if took > LONGEST else ""


def test_malformed_files(tmp_path, alarm, capfd):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the libraries that write the files
        all_cases = list(cases(tmp_path))
    capfd.readouterr()
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        failures = {case.name: problem for case in all_cases if (problem := outcome(case))}
    assert not failures, "\n".join(f"{name}: {problem}" for name, problem in failures.items())
    assert len(all_cases) >= 300
    assert len({case.name for case in all_cases}) == len(all_cases)
    assert not warned
    assert capfd.readouterr() == ("", "")


def test_valid_files_are_read(tmp_path):
    for kind, path in wholes(tmp_path / "whole").items():
        fires = read(path, **keys_of(kind))
        assert fires.dtype == torch.float32
        assert fires.shape[1:] == GRID
        assert 4 < torch.isfinite(fires[0]).sum() <= np.prod(GRID)


@pytest.mark.parametrize(
    ("name", "most"), [("fire.geojson", 100_000_000), ("fire.kml", 300_000_000)]
)
def test_text_that_is_too_long_is_not_read(tmp_path, name, most):
    path = tmp_path / name
    path.write_bytes(b"{" if name.endswith("json") else b"<")
    with path.open("r+b") as file:
        file.truncate(most + 1)  # a hole, which takes no space
    with pytest.raises(ValueError, match=f"{most + 1} bytes; .* has at most {most}"):
        read(path)
