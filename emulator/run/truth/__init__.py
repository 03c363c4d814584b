"""Truth beside the events of a run, in one HDF5 file: light, depth, flow, poses, labels, origins, clean events."""
