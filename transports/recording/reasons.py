"""Why a library could not write or read a file, in one line for people."""

from __future__ import annotations

import re

__all__ = ["reason"]

_MOST = 300


def reason(error: BaseException) -> str:
    """Return what an error says: for the operating system's errors its own words, such as "No space left on device"."""
    if isinstance(error, MemoryError):
        return "it needs more memory than a sound file of its kind does"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if "failed to fill whole buffer" in str(error) or "FileDataTable" in str(error):
        return "it is cut short; for AEDAT 4.0 `evstim recover IN OUT` makes a file that others read"
    text = " ".join(str(error).split()) or type(error).__name__
    told = re.search(r"([A-Z][A-Za-z ,']+) \(os error \d+\)", text) or re.search(r"error message = '([^']+)'", text)
    return told[1] if told else text[:_MOST]
