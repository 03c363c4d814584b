"""The rules of other simulators, as pixel methods beside our own: to reproduce what they published, and to compare."""
