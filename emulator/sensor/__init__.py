"""Sensor: from light to events.

`sensor` runs a step: the pixels (`pixels`, with `noise` inside), then reads of active pixels (`row_kicks`), latency and
read-out (`chip`). `presets` are the parameters of known sensors.
"""
