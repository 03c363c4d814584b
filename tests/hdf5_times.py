"""Objects of an HDF5 file that store the time of their last change, by the library's own account."""

import h5py


def timed_objects(path):
    """Return the names of the groups and data sets that store a time, the root among them."""
    with h5py.File(path, "r") as file:
        names = ["/"]
        file.visit(names.append)
        return [name for name in names if h5py.h5g.get_objinfo(file.id, name.encode()).mtime]
