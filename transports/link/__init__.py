"""Links: an event device, its endpoint, and the process that they run in."""
