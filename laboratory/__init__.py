"""Judges of the emulator: truths, scores, public measurements, other simulators and speeds.

    accuracy           events beside a truth and beside other simulators, against the cost of each
    characterise       a sensor measured as a laboratory measures one
    validation         public measurements of real cameras, repeated
    realtime, bench    speed of whole runs, and of single parts; programs: python -m laboratory.bench.NAME
    methods            pixels by other means: a circuit, noise on a grid, the rules of other simulators
    verbs              the commands of `evstim` for all this

No other package imports it. A rig that selects a method of `methods` by name loads it then.
"""
