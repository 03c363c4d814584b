"""Transports of bytes between a camera and the device under test: links, pacing, and a fake for each."""

from abc import ABC, abstractmethod
from typing import Self


class Closing(ABC):
    """Base of what is closed at the end of its `with` block."""

    @abstractmethod
    def close(self) -> None:
        """Give back what it holds."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
