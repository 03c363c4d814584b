"""Sensor: from light to events.

`sensor` runs a step: a pixel method (`methods`, `pixels`), then reads of active pixels (`aps`), latency and read-out
(`chip`), with `noise` and defects on the way. `presets` are the parameters of known sensors.
"""
