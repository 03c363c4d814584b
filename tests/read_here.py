"""Files of others read in the process of the tests, where no limit and no end of a child process is tested."""

import json
from collections.abc import Mapping
from contextlib import closing, nullcontext
from importlib import import_module

from transports.guarded_reader import ForeignFileError, GuardedReader, Limits, _error_of

__all__ = ["ReadHere", "read_here"]


class ReadHere:
    """Reader in the place of `GuardedReader`, whose errors are told as those of its child."""

    def __init__(self, reader, path, *args, limits=None):
        if not path.exists():
            GuardedReader(reader, path)
        self._values = None
        self._order = {"path": str(path), "limits": vars(limits or Limits.of(path))}
        module, _, name = reader.partition(":")
        self._read, self._args = getattr(import_module(module), name), (path, *json.loads(json.dumps(args)))

    def values(self):
        """Yield what the reader returns or yields."""
        self._values = self._all()
        return self._values

    def _all(self):
        try:
            made = self._read(*self._args)
            with nullcontext([made]) if isinstance(made, Mapping) else closing(made) as all_values:
                yield from all_values
        except Exception as error:  # noqa: BLE001 as the child does
            told = _error_of(error, self._order)
            raise ForeignFileError(told["@error"], lacks=told["lacks"]) from None

    def close(self):
        """Close the reader's files."""
        if self._values is not None:
            self._values.close()


def read_here(reader, path, limits=None):
    """Return the values of a reader as `read_guarded` does."""
    return next(ReadHere(reader, path, limits=limits).values())
