"""Numbers of a text, and beside other threads."""

from __future__ import annotations

import threading
import time
import warnings

import numpy as np
import pytest

from voxtool.errors import DeviceWarning
from voxtool.files.storage.numbers import MOST_DIGITS, _decimals_in, numbers_in


def decimal(random: np.random.Generator, whole: int, places: int) -> str:
    digits = "".join(random.choice(list("0123456789"), whole + places))
    point = "." * (places > 0)
    return f"{random.choice(['', '-'])}{digits[:whole]}{point}{digits[whole:]}"


@pytest.mark.parametrize("places", [0, 1, 6, 8, 9, 14, 15])
def test_decimals_are_read_as_python_reads_them(places: int) -> None:
    """To the bit, by the quick way if they have at most MOST_DIGITS digits: also -0.0, and leading
    zeros."""
    random = np.random.default_rng(places)
    most = max(MOST_DIGITS - places, 1)
    words = [decimal(random, int(random.integers(1, most + 1)), places) for _ in range(500)]
    text = "  ".join(words)
    letters = np.frombuffer(f" {text}\n".encode(), np.uint8)
    numbers, begins = numbers_in(letters, np.float64)
    assert numbers.tobytes() == np.array([float(word) for word in words]).tobytes()
    assert [text[at - 1 :].split()[0] for at in begins] == words
    assert (_decimals_in(letters, np.float64) is not None) == (places < MOST_DIGITS)
    if not places:
        assert numbers_in(letters, np.int64)[0].tolist() == [int(word) for word in words]


@pytest.mark.parametrize(
    "word",
    [
        "1e5",
        "+1",
        "1.",
        ".5",
        "-.5",
        "1-2",
        "1.5-2",
        "1.2.3",
        "1.-5",
        "--1",
        "- 1",
        "-",
        "5..",
        ".",
    ],
)
@pytest.mark.parametrize("others", ["", "1 -2", "1.5 -2.5"])
def test_other_words_are_no_decimals(word: str, others: str) -> None:
    for text in (f"{word} {others}", f"{others} {word}"):
        letters = np.frombuffer(text.encode(), np.uint8)
        assert _decimals_in(letters, np.float64) is None
        assert _decimals_in(letters, np.int64) is None


@pytest.mark.filterwarnings("ignore::voxtool.errors.DeviceWarning")
def test_a_warning_of_another_thread_is_no_error() -> None:
    words = np.frombuffer(b"0.5 " * 100_000, np.uint8)
    raised: list[Warning] = []
    end = threading.Event()

    def warn() -> None:  # as the thread that opens the device does
        while not end.is_set():
            try:
                warnings.warn("the folder cannot be written", DeviceWarning, stacklevel=1)
            except DeviceWarning as error:
                raised.append(error)
            time.sleep(1e-3)

    other = threading.Thread(target=warn)
    other.start()
    for _ in range(5):
        assert len(numbers_in(words, np.float64)[0]) == 100_000
    end.set()
    other.join()
    assert not raised
