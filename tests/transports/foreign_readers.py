"""Readers of files that give, fail and end in every way; a child process imports them, which takes time."""

import os
import signal
import time

import numpy as np

from transports.guarded_reader import ForeignFileError

RECORDS = np.array([(1, 2.5), (3, 4.5)], [("a", "<u2"), ("b", "<f4")])


def mixed(path, factor, text):
    return {"a": np.arange(6.0).reshape(2, 3) * factor, "r": RECORDS, "none": np.zeros((0, 4)), "text": text}


def pieces(path):
    for k in range(3):
        yield {"k": k, "content": path.read_text()}
    raise ValueError("the fourth piece is damaged")


def printing(path):
    os.write(1, b"a library prints")
    os.write(2, b"and complains")
    return {"k": 1}


def endless(path):
    while True:
        pass


def asleep(path):
    time.sleep(1000)


def hungry(path):
    return {"a": np.ones(1 << 30)}


def killed(path):
    os.kill(os.getpid(), signal.SIGSEGV)


def without_library(path):
    import faery_that_is_not_installed  # noqa: F401


def raised_anew(path):
    raise ModuleNotFoundError("No module named 'networkx'")


def with_advice(path):
    raise ImportError("missing `pip install pycollada`")


def without_name(path):
    raise ImportError("none of them is here")


def own_error(path):
    raise ForeignFileError("row 3 has no columns")
