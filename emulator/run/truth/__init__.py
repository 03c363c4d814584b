"""Truth beside events: what was true while a run's events were made, in one HDF5 file."""
