"""Device: the interface that every emulated camera has, its items, their fates and its clock."""
