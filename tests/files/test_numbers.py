"""Numbers of a text beside other threads."""

from __future__ import annotations

import threading
import time
import warnings

import numpy as np

from voxtool.errors import DeviceWarning
from voxtool.files.numbers import numbers_in


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
